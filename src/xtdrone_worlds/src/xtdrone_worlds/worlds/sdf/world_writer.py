"""Writer of SDF worlds; ``read_world`` restores the same world bit for bit."""

from __future__ import annotations

from collections.abc import Iterable
from decimal import Decimal
from xml.sax.saxutils import escape, quoteattr

from xtdrone_common.poses import Pose
from xtdrone_worlds.worlds.sdf.geometries.visuals_and_collisions import write_collision, write_visual
from xtdrone_worlds.worlds.sdf.models.joints import write_joint
from xtdrone_worlds.worlds.sdf.models.rigid_links import INERTIA
from xtdrone_worlds.worlds.sdf.world_reader import DECLINATION, GROUND, SPEED
from xtdrone_worlds.worlds.sdf.world_records import SdfActor, SdfLink, SdfModel, SdfWorld, Trajectory
from xtdrone_worlds.worlds.sdf.xml_elements import write_pose
from xtdrone_worlds.worlds.urdf import Inertial


def write_world(world: SdfWorld) -> str:
    """Write a world as SDF 1.7; file paths are absolute, except in the ROS package xtdrone_sim."""
    lines = [
        "<?xml version='1.0'?>",
        "<sdf version='1.7' xmlns:xtdrone='urn:xtdrone'>",
        f"  <world name={quoteattr(world.name)}>",
        *_indent(_write_surroundings(world), 4),
        *_indent((line for model in world.models for line in _write_model(model)), 4),
        *_indent((line for joint in world.joints for line in write_joint(joint)), 4),
        *_indent((line for actor in world.actors for line in _write_actor(actor)), 4),
        "  </world>",
        "</sdf>",
        "",
    ]
    return "\n".join(lines)


def write_model(model: SdfModel) -> str:
    """Write a model as SDF 1.7, as the file model.sdf of a folder with its name."""
    lines = ["<?xml version='1.0'?>", "<sdf version='1.7'>", *_indent(_write_model(model), 2), "</sdf>", ""]
    return "\n".join(lines)


def _indent(lines: Iterable[str], by: int) -> list[str]:
    return [" " * by + line for line in lines]


def _words(values: Iterable[float]) -> str:
    return " ".join(map(repr, values))


def _flag(value: bool) -> str:
    return "true" if value else "false"


def _write_surroundings(world: SdfWorld) -> list[str]:
    light, datum = world.light, world.datum
    tesla = " ".join(str(Decimal(repr(value)).scaleb(-4)) for value in world.magnetic_field)
    return [
        f"<gravity>0 0 {-world.gravity!r}</gravity>",
        f"<wind><linear_velocity>{_words(world.wind)}</linear_velocity></wind>",
        f"<magnetic_field>{tesla}</magnetic_field>",
        f"<{DECLINATION}>{world.declination!r}</{DECLINATION}>",
        f"<{GROUND}><friction>{world.friction!r}</friction><restitution>{world.restitution!r}</restitution></{GROUND}>",
        "<spherical_coordinates>",
        "  <surface_model>EARTH_WGS84</surface_model>",
        "  <world_frame_orientation>ENU</world_frame_orientation>",
        f"  <latitude_deg>{datum.latitude!r}</latitude_deg>",
        f"  <longitude_deg>{datum.longitude!r}</longitude_deg>",
        f"  <elevation>{datum.altitude!r}</elevation>",
        "</spherical_coordinates>",
        "<scene>",
        f"  <ambient>{_words(light.ambient)} 1</ambient>",
        f"  <background>{_words(light.background)} 1</background>",
        f"  <shadows>{_flag(light.shadows)}</shadows>",
        "</scene>",
        '<light name="sun" type="directional">',
        f"  <diffuse>{_words(light.diffuse)} 1</diffuse>",
        f"  <direction>{_words(light.direction)}</direction>",
        "</light>",
    ]


def _write_model(model: SdfModel) -> list[str]:
    return [
        f"<model name={quoteattr(model.name)}>",
        f"  <static>{_flag(model.static)}</static>",
        *_write_pose(model.pose),
        *_indent((line for link in model.links for line in _write_link(link)), 2),
        "</model>",
    ]


def _write_pose(pose: Pose) -> list[str]:
    return [] if pose == Pose() else [f"  {write_pose(pose)}"]


def _write_link(link: SdfLink) -> list[str]:
    shapes = [line for k, visual in enumerate(link.visuals) for line in write_visual(visual, f"visual_{k}")]
    shapes += [line for k, shape in enumerate(link.collisions) for line in write_collision(shape, f"collision_{k}")]
    mass = [] if link.inertial is None else _write_inertial(link.inertial)
    weight = [] if link.gravity else ["<gravity>false</gravity>"]
    inside = _indent([*mass, *weight, *shapes], 2)
    return [f"<link name={quoteattr(link.name)}>", *_write_pose(link.pose), *inside, "</link>"]


def _write_inertial(inertial: Inertial) -> list[str]:
    values = zip(INERTIA, inertial.inertia, strict=True)
    inertia = "".join(f"<{tag}>{value!r}</{tag}>" for tag, value in values)
    mass, pose = f"<mass>{inertial.mass!r}</mass>", "".join(_write_pose(inertial.pose)).strip()
    return [f"<inertial>{pose}{mass}<inertia>{inertia}</inertia></inertial>"]


def _write_actor(actor: SdfActor) -> list[str]:
    skin = [f"  <skin><filename>{escape(actor.skin)}</filename></skin>"] if actor.skin else []
    script = [] if actor.trajectory is None else _indent(_write_script(actor.trajectory), 2)
    return [
        f"<actor name={quoteattr(actor.name)}>",
        *skin,
        *_write_pose(actor.pose),
        f"  <{SPEED}>{actor.speed!r}</{SPEED}>",
        *script,
        "</actor>",
    ]


def _write_script(trajectory: Trajectory) -> list[str]:
    return [
        "<script>",
        f"  <loop>{_flag(trajectory.loop)}</loop>",
        f"  <delay_start>{trajectory.delay_start!r}</delay_start>",
        f"  <auto_start>{_flag(trajectory.auto_start)}</auto_start>",
        '  <trajectory id="0" type="walk">',
        *(
            f"    <waypoint><time>{point.time!r}</time>{write_pose(point.pose)}</waypoint>"
            for point in trajectory.waypoints
        ),
        "  </trajectory>",
        "</script>",
    ]
