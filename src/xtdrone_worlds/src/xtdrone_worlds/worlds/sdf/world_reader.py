"""Reader of SDF worlds; docs/worlds.md lists the supported elements."""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from dataclasses import replace
from decimal import Decimal
from pathlib import Path
from typing import Any

from xtdrone_common.files import read_bytes
from xtdrone_common.geodesy.projection import Datum
from xtdrone_common.poses import Pose
from xtdrone_worlds.shapes.visual import Collision, Visual
from xtdrone_worlds.worlds.sdf.geometries.visuals_and_collisions import is_plane, read_collisions, read_visuals
from xtdrone_worlds.worlds.sdf.models.joints import WORLD, divide, read_joint, read_joint_of_world
from xtdrone_worlds.worlds.sdf.models.model_uris import model_folders, resolve
from xtdrone_worlds.worlds.sdf.models.rigid_links import read_inertial, why_loose, why_standing
from xtdrone_worlds.worlds.sdf.world_records import (
    Light,
    SdfActor,
    SdfJoint,
    SdfLink,
    SdfModel,
    SdfWorld,
    Trajectory,
    Waypoint,
)
from xtdrone_worlds.worlds.sdf.xml_elements import LARGEST, Element, parse, pose_of, read_pose

EXTENDS = "xtdrone:extends"
DECLINATION = "xtdrone:declination"
GROUND = "xtdrone:ground"
SPEED = "xtdrone:speed"

_BUILT_IN = ("ground_plane", "sun")  # Gazebo's models, ignored: the ground always exists, the sun is the light
_MODEL_SILENT = ("self_collide", "allow_auto_disable", "enable_wind", "wind", "description", "author")
_LINK_SILENT = (
    *("inertial", "self_collide", "kinematic", "gravity", "enable_wind", "must_be_base_link"),
    "velocity_decay",
)


Jointed = tuple[SdfModel, tuple[SdfJoint, ...]]
"""A model with all its links, and the joints between them in its frame."""

Extended = Callable[[Element | None], SdfWorld]
"""Returns the world that another one extends, by the element that names it; None for the default world."""


def parse_world(text: str | bytes, path: Path, extended: Extended) -> SdfWorld:
    """Parse an SDF world.

    Args:
        text: content of the file.
        path: path of the file, for messages and relative paths.
        extended: returns the world that provides the defaults.

    Raises:
        SdfError: invalid content; the message names file, line, element, value and what is allowed.
    """
    root = _root(text, path)
    worlds = list(root.all("world"))
    if len(worlds) != 1:
        raise root.error(f"has {len(worlds)} <world>, one is needed")
    return _read_world(worlds[0], extended)


def parse_model(text: str | bytes, path: Path) -> SdfModel:
    """Parse an SDF with one <model> from a request; it may only name files of models and ROS packages.

    Args:
        text: SDF with one <model>, or an <include> of one.
        path: name of the request in messages.

    Raises:
        SdfError: invalid content; see ``parse_world``.
    """
    root = _root(text, path, is_foreign=True)
    worlds = list(root.all("world"))
    models = _models(worlds[0] if len(worlds) == 1 else root)
    if len(models) != 1 or len(worlds) > 1:
        raise root.error(f"has {len(models)} <model>, one is needed")
    ((model, joints),) = models
    if all(joint.kind == "fixed" for joint in joints):
        return divide(model, joints)[0][0]
    root.warn_ignored(f"{model.name!r} has joints that move, which only models of a world file can have: it is static")
    return replace(model, static=True)


def _root(text: str | bytes, path: Path, is_foreign: bool = False) -> Element:
    root = parse(text, path, is_foreign)
    if root.tag != "sdf":
        raise root.error("is not allowed as the outermost element, <sdf> is")
    version = root.attributes.get("version", "")
    if not version.startswith("1."):
        raise root.error(f"version {version!r} is not allowed, 1.5 to 1.7")
    return root


def _read_world(element: Element, extended: Extended) -> SdfWorld:
    element.warn_unknown(
        (
            *("include", "model", "joint", "actor", "light", "scene", "gravity", "magnetic_field", "wind"),
            *("spherical_coordinates", EXTENDS, DECLINATION, GROUND, "physics", "gui", "state"),
        ),
        ("atmosphere",),
    )
    for tag in ("physics", "gui", "state"):
        for found in element.all(tag):
            found.info("is ignored: the simulator has its own physics, no window, and its own initial state")
    world = replace(extended(element.one(EXTENDS)), name=element.name(), **_surroundings(element))
    world = replace(world, light=_light(element, world.light))
    models, joints = [*world.models], [*world.joints]
    for model in _models(element):
        parts, moving = divide(*model)
        models += parts
        joints += moving
    actors = [*world.actors, *(_read_actor(actor) for actor in element.all("actor"))]
    _check_names(element, [model.name for model in models] + [actor.name for actor in actors])
    joints += [read_joint_of_world(joint, [model.name for model in models]) for joint in element.all("joint")]
    return replace(world, models=tuple(models), actors=tuple(actors), joints=tuple(joints))


def _check_names(element: Element, names: list[str]) -> None:
    seen = {"ground_plane"}
    for name in names:
        if name in seen:
            raise element.error(f"two models or actors are called {name!r}; an <include> takes a <name>")
        seen.add(name)


# surroundings


def _surroundings(element: Element) -> dict[str, Any]:
    """Return the fields of ``SdfWorld`` that the file sets."""
    found: dict[str, Any] = {}
    gravity, wind, field = element.first("gravity"), element.first("wind"), element.first("magnetic_field")
    place, ground, declination = element.first("spherical_coordinates"), element.one(GROUND), element.one(DECLINATION)
    if gravity is not None:
        x, y, z = gravity.numbers((3,))
        if (x, y) != (0.0, 0.0) or not -100.0 <= z < 0.0:
            raise gravity.error(f"{gravity.text.strip()!r} is not allowed, 0 0 and a number under 0 and at least -100")
        found["gravity"] = -z
    if wind is not None:
        wind.warn_unknown(("linear_velocity",))
        velocity = wind.one("linear_velocity")
        if velocity is not None:
            found["wind"] = velocity.numbers((3,), -100.0, 100.0)
    if field is not None:
        found.update(_magnetic_field(field))
    if declination is not None:
        found["declination"] = declination.number(-180.0, 180.0)
    if place is not None:
        found["datum"] = _datum(place)
    if ground is not None:
        ground.warn_unknown(("friction", "restitution"))
        for tag, high in (("friction", 10.0), ("restitution", 1.0)):
            value = ground.one(tag)
            if value is not None:
                found[tag] = value.number(0.0, high)
    return found


def _magnetic_field(element: Element) -> dict[str, Any]:
    """Return the field, converted from tesla to gauss in decimal digits, and the declination."""
    values = element.numbers((3,), -1e-3, 1e-3)
    east, north, up = (float(Decimal(word).scaleb(4)) for word in element.text.split())
    if math.hypot(*values) < 1e-6:
        raise element.error(f"{element.text.strip()!r} is not allowed, a field of at least 1e-6 T")
    return {"magnetic_field": (east, north, up), "declination": math.degrees(math.atan2(east, north))}


def _datum(element: Element) -> Datum:
    element.warn_unknown(
        (*("latitude_deg", "longitude_deg", "elevation", "heading_deg"), *("surface_model", "world_frame_orientation"))
    )
    for tag, allowed in (("surface_model", "EARTH_WGS84"), ("world_frame_orientation", "ENU")):
        named = element.one(tag)
        if named is not None and named.string() != allowed:
            raise named.error(f"{named.string()!r} is not allowed, {allowed}")
    heading = element.one("heading_deg")
    if heading is not None and heading.number() != 0.0:
        raise heading.error(f"{heading.text.strip()!r} is not allowed, 0: x is east")
    return Datum(
        element.required("latitude_deg").number(-90.0, 90.0),
        element.required("longitude_deg").number(-180.0, 180.0),
        element.number_of("elevation", 0.0, -1000.0, 20000.0),
    )


def _light(element: Element, light: Light) -> Light:
    scene = element.first("scene")
    if scene is not None:
        scene.warn_unknown(("ambient", "background", "shadows"), ("grid", "origin_visual"))
        for tag in ("ambient", "background"):
            colour = scene.one(tag)
            if colour is not None:
                red, green, blue, *_ = colour.numbers((3, 4), 0.0, 1.0)
                rgb = (red, green, blue)
                light = replace(light, ambient=rgb) if tag == "ambient" else replace(light, background=rgb)
        light = replace(light, shadows=scene.boolean_of("shadows", light.shadows))
    suns = []
    for sun in element.all("light"):
        if sun.attributes.get("type") == "directional":
            suns.append(sun)
        else:
            kind = sun.attributes.get("type", "")
            sun.warn_ignored(f"of type {kind!r} is not supported and ignored; the renderer has a directional one")
    for sun in suns[1:]:
        sun.warn_ignored("beside the first directional one is not supported and ignored")
    return _sun(suns[0], light) if suns else light


def _sun(sun: Element, light: Light) -> Light:
    sun.warn_unknown(("direction", "diffuse", "cast_shadows"), ("pose", "specular", "attenuation", "spot", "intensity"))
    direction, diffuse = sun.one("direction"), sun.one("diffuse")
    if not sun.boolean_of("cast_shadows", True):
        light = replace(light, shadows=False)
    if direction is not None:
        x, y, z = direction.numbers((3,))
        if z >= 0.0:
            raise direction.error(f"{direction.text.strip()!r} is not allowed, the third number is under 0: downwards")
        light = replace(light, direction=(x, y, z))
    if diffuse is not None:
        red, green, blue = diffuse.numbers((3, 4), 0.0, 1.0)[:3]
        light = replace(light, diffuse=(red, green, blue))
    return light


# models


def _models(element: Element) -> list[Jointed]:
    """Return the models with their joints in document order."""
    models = []
    for child in element.children:
        if child.tag == "model":
            model = _read_model(child)
        elif child.tag == "include":
            model = _read_include(child)
        else:
            continue
        if model is not None:
            models.append(model)
    return models


def _read_include(element: Element) -> Jointed | None:
    element.warn_unknown(("uri", "name", "pose", "static"))
    uri = element.required("uri")
    name, static = element.one("name"), element.one("static")
    built_in = uri.string().removeprefix("model://").strip("/")
    known = any(os.path.exists(folder / built_in) for folder in model_folders(element.file.path.parent))
    if built_in in _BUILT_IN and not known:
        return None
    path = _model_file(uri, resolve(uri))
    found = list(_root(_content(uri, path), path).all("model"))
    if len(found) != 1:
        raise uri.error(f"{path} has {len(found)} <model>, one is needed")
    read = _read_model(found[0], None if static is None else static.boolean())
    if read is None:
        return None
    model, joints = read
    if element.one("pose") is not None:
        model = replace(model, pose=read_pose(element))
    return (model if name is None else replace(model, name=name.string())), joints


def _model_file(uri: Element, path: Path) -> Path:
    """Return the SDF file in a model's folder: the last one in ``model.config``, or ``model.sdf``."""
    if os.path.isfile(path):
        return path
    config, file = path / "model.config", path / "model.sdf"
    if config.is_file():
        named = list(parse(_content(uri, config), config).all("sdf"))
        if named:
            file = path / named[-1].string()
    if not os.path.isfile(file):
        raise uri.error(f"{uri.string()!r}: {file} does not exist")
    return file


def _content(uri: Element, path: Path) -> bytes:
    """Read the file that ``uri`` refers to."""
    try:
        return read_bytes(path, LARGEST)
    except OSError as error:
        raise uri.error(f"{path}: {error.strerror or error}") from error


def _read_model(element: Element, static: bool | None = None) -> Jointed | None:
    """Read a <model> with its joints, in its frame; None if it is only the ground, which always exists."""
    element.warn_unknown(("pose", "static", "link", "joint"), _MODEL_SILENT)
    name = element.name()
    if static is None:
        static = element.boolean_of("static", False)
    links = tuple(_read_link(link) for link in element.all("link"))
    pose = read_pose(element)
    is_built_in = name in _BUILT_IN
    if is_built_in and all(_is_plain_ground(link) for link in element.all("link")):
        return None
    if static:
        return SdfModel(name, pose, True, links), ()
    model = SdfModel(name, pose, False, links)
    joints: tuple[SdfJoint, ...] = ()
    reason = why_loose(element, links)
    if not reason:
        frames = {WORLD: Pose(), **{link.name: link.pose for link in links}}
        joints = tuple(read_joint(joint, frames) for joint in element.all("joint"))
        reason = why_standing(element, divide(model, joints)[0])
    if reason:
        element.warn_ignored(f"{name!r} is not static, but {reason}: it is treated as static")
        return replace(model, static=True), ()
    return model, joints


def _is_plain_ground(link: Element) -> bool:
    return all(is_plane(shape) for shape in link.children if shape.tag in {"visual", "collision"})


def _read_link(element: Element) -> SdfLink:
    element.warn_unknown(("pose", "visual", "collision"), _LINK_SILENT)
    visuals: list[Visual] = []
    collisions: list[Collision] = []
    for child in element.all("visual"):
        visuals += read_visuals(child)
    for child in element.all("collision"):
        if is_plane(child):
            child.info("of a <plane> is ignored: the ground z = 0 always exists")
            continue
        collisions += read_collisions(child)
    return SdfLink(
        element.name(),
        read_pose(element),
        tuple(visuals),
        tuple(collisions),
        read_inertial(element),
        element.boolean_of("gravity", True),
    )


# actors


def _read_actor(element: Element) -> SdfActor:
    element.warn_unknown(("skin", "pose", "script", "animation", SPEED), ("static", "link"))
    for animation in element.all("animation"):
        animation.info("is ignored: people walk and stand by themselves")
    skin, script = element.one("skin"), element.one("script")
    return SdfActor(
        element.name(),
        "" if skin is None else _skin(skin),
        read_pose(element),
        None if script is None else _trajectory(script),
        element.number_of(SPEED, 1.0, 0.0, 10.0),
    )


def _skin(element: Element) -> str:
    element.warn_unknown(("filename",), ("scale",))
    name = element.required("filename").string()
    if "." in name:
        element.warn_ignored(f"{name!r} is not supported, skins are names of people; another person is used instead")
        return ""
    return name


def _trajectory(script: Element) -> Trajectory | None:
    script.warn_unknown(("loop", "delay_start", "auto_start", "trajectory"))
    found = script.one("trajectory")
    if found is None:
        return None
    found.warn_unknown(("waypoint",))
    waypoints = []
    for element in found.all("waypoint"):
        time = element.required("time")
        waypoints.append(Waypoint(time.number(0.0), pose_of(element.required("pose"))))
        if len(waypoints) > 1 and waypoints[-1].time < waypoints[-2].time:
            raise time.error(f"{time.text.strip()!r} is not allowed, at least the one before ({waypoints[-2].time:g})")
    if not waypoints:
        raise found.error("needs at least one <waypoint>")
    return Trajectory(
        tuple(waypoints),
        script.boolean_of("loop", True),
        script.number_of("delay_start", 0.0, 0.0),
        script.boolean_of("auto_start", True),
    )
