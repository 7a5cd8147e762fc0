"""Visuals and collisions of SDF links: reading, writing and bounding boxes."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from xml.sax.saxutils import escape

import numpy as np
from numpy.typing import NDArray

from xtdrone_control.bounded_file import MB, read_text
from xtdrone_sim.vehicles.poses import compose, rotate
from xtdrone_sim.vehicles.visual import Box, Collision, Colour, Cylinder, Geometry, Mesh, Pose, Sphere, Visual
from xtdrone_sim.worlds.sdf.elements import Element, read_pose, resolve, uri_of, write_pose
from xtdrone_sim.worlds.sdf.types import SdfError

Array = NDArray[np.float64]

TEXTURE = "xtdrone:texture"
LARGEST_MESH = 64 * MB

_FORMS = ("box", "cylinder", "sphere", "mesh", "plane")
_THIN = 0.002  # m, thickness of the box that represents a plane
_GREY = (0.7, 0.7, 0.7, 1.0)
# plain materials of Gazebo
_COLOURS = {
    "Gazebo/Grey": (0.7, 0.7, 0.7, 1.0),
    "Gazebo/DarkGrey": (0.175, 0.175, 0.175, 1.0),
    "Gazebo/White": (1.0, 1.0, 1.0, 1.0),
    "Gazebo/Black": (0.0, 0.0, 0.0, 1.0),
    "Gazebo/FlatBlack": (0.1, 0.1, 0.1, 1.0),
    "Gazebo/Red": (1.0, 0.0, 0.0, 1.0),
    "Gazebo/Green": (0.0, 1.0, 0.0, 1.0),
    "Gazebo/Blue": (0.0, 0.0, 1.0, 1.0),
    "Gazebo/Yellow": (1.0, 1.0, 0.0, 1.0),
    "Gazebo/Orange": (1.0, 0.5088, 0.0468, 1.0),
    "Gazebo/Purple": (1.0, 0.0, 1.0, 1.0),
    "Gazebo/Turquoise": (0.0, 1.0, 1.0, 1.0),
    "Gazebo/Gold": (0.8, 0.64869, 0.12076, 1.0),
    "Gazebo/Wood": (0.56, 0.4, 0.24, 1.0),
    "Gazebo/Bricks": (0.62, 0.34, 0.27, 1.0),
    "Gazebo/Grass": (0.33, 0.48, 0.2, 1.0),
}


def is_plane(element: Element) -> bool:
    """Return whether a visual or collision is a <plane>."""
    geometry = element.one("geometry")
    return geometry is not None and geometry.one("plane") is not None


def read_visual(element: Element) -> Visual | None:
    """Read a <visual>; None, with a warning, for an unsupported shape.

    Raises:
        SdfError: invalid value.
    """
    element.warn_unknown(
        ("pose", "geometry", "material", "transparency"),
        ("cast_shadows", "laser_retro", "visibility_flags", "meta", "lighting"),
    )
    pose = read_pose(element)
    geometry = _read_geometry(element.required("geometry"))
    if geometry is None:
        return None
    if is_plane(element):
        pose = compose(pose, Pose((0.0, 0.0, -0.5 * _THIN)))
    material, transparency = element.one("material"), element.one("transparency")
    visual = Visual(geometry, pose, _GREY) if material is None else _painted(Visual(geometry, pose, _GREY), material)
    if transparency is not None:
        red, green, blue, opacity = visual.colour
        visual = replace(visual, colour=(red, green, blue, opacity * (1.0 - transparency.number(0.0, 1.0))))
    return visual


def read_collision(element: Element) -> Collision | None:
    """Read a <collision>; None, with a warning, for an unsupported shape.

    Raises:
        SdfError: invalid value.
    """
    element.warn_unknown(("pose", "geometry"), ("surface", "max_contacts", "laser_retro"))
    pose = read_pose(element)
    geometry = _read_geometry(element.required("geometry"))
    return None if geometry is None else Collision(geometry, pose)


def _read_geometry(element: Element) -> Geometry | None:
    if not element.children:
        raise element.error(f"is empty, needs one of {', '.join(_FORMS)}")
    form = element.children[0]
    if len(element.children) > 1:
        raise element.children[1].error("is not allowed, a <geometry> has one form")
    if form.tag == "box":
        form.warn_unknown(("size",))
        return Box(_triple(form.required("size").numbers((3,), 0.0)))
    if form.tag == "cylinder":
        form.warn_unknown(("radius", "length"))
        return Cylinder(form.required("radius").number(0.0), form.required("length").number(0.0))
    if form.tag == "sphere":
        form.warn_unknown(("radius",))
        return Sphere(form.required("radius").number(0.0))
    if form.tag == "plane":
        return _read_plane(form)
    if form.tag == "mesh":
        return _read_mesh(form)
    form.warn_ignored()
    return None


def _read_plane(element: Element) -> Geometry:
    element.warn_unknown(("normal", "size"))
    normal, size = element.one("normal"), element.one("size")
    if normal is not None and normal.numbers((3,))[:2] != (0.0, 0.0):
        raise normal.error(f"{normal.text.strip()!r} is not allowed, 0 0 1; turn the plane by its pose")
    x, y = (1.0, 1.0) if size is None else size.numbers((2,), 0.0)
    return Box((x, y, _THIN))


def _read_mesh(element: Element) -> Geometry | None:
    element.warn_unknown(("uri", "scale"))
    uri, scale = element.required("uri"), element.one("scale")
    if not uri.string().lower().endswith(".obj"):
        uri.warn_ignored(f"{uri.string()} is not supported and left out, meshes are Wavefront files (.obj)")
        return None
    path = resolve(uri)
    return Mesh(path) if scale is None else Mesh(path, _triple(scale.numbers((3,))))


def _painted(visual: Visual, material: Element) -> Visual:
    material.warn_unknown(
        ("ambient", "diffuse", "script", TEXTURE, "pbr"),
        ("specular", "emissive", "lighting", "shader", "shininess", "double_sided", "render_order"),
    )
    colour = _read_colour(material)
    texture = material.one(TEXTURE) or _albedo(material)
    path = None if texture is None else resolve(texture)
    if colour is None:
        colour = _GREY if path is None else (1.0, 1.0, 1.0, 1.0)
    return replace(visual, colour=colour, texture=path)


def _read_colour(material: Element) -> Colour | None:
    for tag in ("diffuse", "ambient"):
        element = material.one(tag)
        if element is not None:
            values = element.numbers((3, 4), 0.0, 1.0)
            red, green, blue, opacity = (*values, 1.0)[:4]
            return (red, green, blue, opacity)
    script = material.one("script")
    if script is None:
        return None
    name = script.one("name")
    known = None if name is None else _COLOURS.get(name.text.strip())
    if known is None:
        script.warn_ignored("is not supported and ignored, but for Gazebo's plain colours (docs/worlds.md)")
    return known


def _albedo(material: Element) -> Element | None:
    pbr = material.one("pbr")
    metal = None if pbr is None else pbr.one("metal") or pbr.one("specular")
    return None if metal is None else metal.one("albedo_map")


def _triple(values: tuple[float, ...]) -> tuple[float, float, float]:
    x, y, z = values
    return (x, y, z)


def write_visual(visual: Visual, name: str) -> list[str]:
    """Write a <visual> as lines."""
    texture = [] if visual.texture is None else [f"<{TEXTURE}>{escape(uri_of(visual.texture))}</{TEXTURE}>"]
    colour = " ".join(map(repr, visual.colour))
    return [
        f'<visual name="{name}">',
        *_write_placed(visual.pose, visual.geometry),
        f"  <material><diffuse>{colour}</diffuse>{''.join(texture)}</material>",
        "</visual>",
    ]


def write_collision(collision: Collision, name: str) -> list[str]:
    """Write a <collision> as lines."""
    return [f'<collision name="{name}">', *_write_placed(collision.pose, collision.geometry), "</collision>"]


def _write_placed(pose: Pose, geometry: Geometry) -> list[str]:
    lines = [] if pose == Pose() else [f"  {write_pose(pose)}"]
    return [*lines, f"  <geometry>{_write_geometry(geometry)}</geometry>"]


def _write_geometry(geometry: Geometry) -> str:
    if isinstance(geometry, Box):
        return f"<box><size>{' '.join(map(repr, geometry.size))}</size></box>"
    if isinstance(geometry, Cylinder):
        return f"<cylinder><radius>{geometry.radius!r}</radius><length>{geometry.length!r}</length></cylinder>"
    if isinstance(geometry, Sphere):
        return f"<sphere><radius>{geometry.radius!r}</radius></sphere>"
    scale = " ".join(map(repr, geometry.scale))
    return f"<mesh><uri>{escape(uri_of(geometry.path))}</uri><scale>{scale}</scale></mesh>"


# bounding boxes


def box_of(geometry: Geometry, pose: Pose) -> tuple[Array, Array]:
    """Return the lowest and the highest corner (3,), m, of the axis-aligned bounding box of a shape at ``pose``.

    Raises:
        SdfError: a mesh file cannot be read.
    """
    if isinstance(geometry, Sphere):
        middle = np.asarray(pose.position)
        return middle - geometry.radius, middle + geometry.radius
    if isinstance(geometry, Box):
        low, high = -0.5 * np.asarray(geometry.size), 0.5 * np.asarray(geometry.size)
    elif isinstance(geometry, Cylinder):
        high = np.array([geometry.radius, geometry.radius, 0.5 * geometry.length])
        low = -high
    else:
        scaled = _mesh_bounds(geometry.path) * np.asarray(geometry.scale)
        low, high = scaled.min(axis=0), scaled.max(axis=0)
    columns = [rotate(pose.orientation, axis) for axis in ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))]
    turn = np.array(columns).T
    middle = turn @ (0.5 * (low + high)) + np.asarray(pose.position)
    reach = np.abs(turn) @ (0.5 * (high - low))
    return middle - reach, middle + reach


@lru_cache(maxsize=1024)
def _mesh_bounds(path: Path) -> Array:
    """Return the lowest and the highest corner (2, 3) of the vertices in a Wavefront file."""
    try:
        text = read_text(path, LARGEST_MESH)
        rows = [line.split(None, 4)[1:4] for line in text.splitlines() if line.startswith("v ")]
        points = np.array(rows, float).reshape(-1, 3)
    except (OSError, ValueError) as error:
        raise SdfError(f"{path}: not a Wavefront file: {error}") from error
    if not len(points):
        raise SdfError(f"{path}: not a Wavefront file: it has no points")
    return np.array([points.min(axis=0), points.max(axis=0)])
