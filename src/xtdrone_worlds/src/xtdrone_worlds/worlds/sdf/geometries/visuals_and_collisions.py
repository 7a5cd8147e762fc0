"""Visuals and collisions of SDF links with their geometries: reading, writing and bounding boxes."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from xml.sax.saxutils import escape

import numpy as np
from numpy.typing import NDArray

from xtdrone_common.files import read_text
from xtdrone_common.poses import Pose, compose, rotate
from xtdrone_common.rotation import Vector
from xtdrone_worlds.shapes.visual import Box, Collision, Colour, Cylinder, Geometry, Mesh, Sphere, Visual
from xtdrone_worlds.worlds.sdf.geometries.heightmaps import read_heightmap
from xtdrone_worlds.worlds.sdf.geometries.materials import GREY, paint, write_material
from xtdrone_worlds.worlds.sdf.geometries.mesh_files import (
    ENDINGS,
    LARGEST_MESH,
    MeshPart,
    check_wavefront,
    extrude,
    read_mesh,
)
from xtdrone_worlds.worlds.sdf.models.model_uris import ForbiddenError, resolve, uri_of
from xtdrone_worlds.worlds.sdf.world_records import SdfError
from xtdrone_worlds.worlds.sdf.xml_elements import Element, read_pose, write_pose

Array = NDArray[np.float64]


_FORMS = ("box", "cylinder", "sphere", "mesh", "heightmap", "plane", "polyline")
_MOST_CORNERS = 1000  # of a polyline
_TERRAIN_TEXTURE = 10.0  # m, side of a texture of terrain, as in SDF
_THIN = 0.002  # m, thickness of the box that represents a plane


def is_plane(element: Element) -> bool:
    """Return whether a visual or collision is a <plane>."""
    geometry = element.one("geometry")
    return geometry is not None and geometry.one("plane") is not None


def read_visuals(element: Element) -> list[Visual]:
    """Read a <visual>: one shape, or one for each material of a mesh; none, with a warning, for an unsupported shape.

    Raises:
        SdfError: invalid value.
    """
    element.warn_unknown(
        ("pose", "geometry", "material", "transparency"),
        ("cast_shadows", "laser_retro", "visibility_flags", "meta", "lighting", "plugin"),
    )
    pose = read_pose(element)
    if is_plane(element):
        pose = compose(pose, Pose((0.0, 0.0, -0.5 * _THIN)))
    material, opacity = element.one("material"), 1.0 - element.number_of("transparency", 0.0, 0.0, 1.0)
    visuals = []
    for geometry, part in _read_shapes(element.required("geometry")):
        visual = Visual(geometry, pose, *look_of(part))
        if material is not None:
            visual = paint(visual, material)
        visuals.append(replace(visual, colour=(*visual.colour[:3], visual.colour[3] * opacity)))
    return visuals


def look_of(part: MeshPart | None) -> tuple[Colour, Path | None]:
    """Return the colour and the texture that a mesh file gives one of its parts; grey without either."""
    if part is None:
        return GREY, None
    return ((1.0, 1.0, 1.0, 1.0), part.texture) if part.texture is not None else (part.colour or GREY, None)


def read_collisions(element: Element) -> list[Collision]:
    """Read a <collision>; none, with a warning, for an unsupported shape.

    Raises:
        SdfError: invalid value.
    """
    element.warn_unknown(("pose", "geometry"), ("surface", "max_contacts", "laser_retro"))
    pose = read_pose(element)
    return [Collision(geometry, pose) for geometry, _ in _read_shapes(element.required("geometry"), is_solid=True)]


def _read_shapes(element: Element, is_solid: bool = False) -> list[tuple[Geometry, MeshPart | None]]:
    """Read a <geometry>; a mesh file has one shape for each material, solid terrain one for each tile."""
    if not element.children:
        raise element.error(f"is empty, needs one of {', '.join(_FORMS)}")
    form = element.children[0]
    if len(element.children) > 1 and form.tag != "polyline":
        raise element.children[1].error("is not allowed, a <geometry> has one form")
    if form.tag == "mesh":
        return _read_mesh(form)
    if form.tag == "heightmap":
        return _read_heightmap(form, is_solid)
    geometry = _read_primitive(form, element)
    return [] if geometry is None else [(geometry, None)]


def _read_primitive(form: Element, geometry: Element) -> Geometry | None:
    if form.tag == "box":
        form.warn_unknown(("size",))
        return Box(triple(form.required("size").numbers((3,), 0.0)))
    if form.tag == "cylinder":
        form.warn_unknown(("radius", "length"))
        return Cylinder(form.required("radius").number(0.0), form.required("length").number(0.0))
    if form.tag == "sphere":
        form.warn_unknown(("radius",))
        return Sphere(form.required("radius").number(0.0))
    if form.tag == "plane":
        return _read_plane(form)
    if form.tag == "polyline":
        return _read_polyline(geometry)
    form.warn_ignored()
    return None


def _read_polyline(geometry: Element) -> Geometry | None:
    """Read the <polyline>s of a <geometry>: outlines of one extruded polygon."""
    outlines, height = [], 0.0
    for line in geometry.children:
        if line.tag != "polyline":
            raise line.error("is not allowed beside a <polyline>")
        line.warn_unknown(("point", "height"))
        corners = [point.numbers((2,), -1e5, 1e5) for point in line.all("point")]
        if not 3 <= len(corners) <= _MOST_CORNERS:
            raise line.error(f"has {len(corners)} <point>s, 3 to {_MOST_CORNERS} are allowed")
        outlines.append([(x, y) for x, y in corners])
        height = line.required("height").number(1e-6, 1e4)
    try:
        return Mesh(extrude(outlines, height))
    except ValueError as error:
        geometry.children[0].warn_ignored(f"is left out: {error}")
        return None


def _read_plane(element: Element) -> Geometry:
    element.warn_unknown(("normal", "size"))
    normal, size = element.one("normal"), element.one("size")
    if normal is not None and normal.numbers((3,))[:2] != (0.0, 0.0):
        raise normal.error(f"{normal.text.strip()!r} is not allowed, 0 0 1; turn the plane by its pose")
    x, y = (1.0, 1.0) if size is None else size.numbers((2,), 0.0)
    return Box((x, y, _THIN))


def has_heightmap(link: Element) -> bool:
    """Return whether a shape of a <link> is a <heightmap>."""
    shapes = [shape.one("geometry") for shape in link.children if shape.tag in {"visual", "collision"}]
    return any(geometry is not None and geometry.one("heightmap") is not None for geometry in shapes)


def _read_heightmap(element: Element, is_solid: bool) -> list[tuple[Geometry, MeshPart | None]]:
    """Read a <heightmap>; one whose image is missing or cannot be read is left out with a warning."""
    element.warn_unknown(("uri", "size", "pos", "texture"), ("blend", "use_terrain_paging", "sampling"))
    uri, size, pos = element.required("uri"), element.one("size"), element.one("pos")
    extent = (1.0, 1.0, 1.0) if size is None else triple(size.numbers((3,), 1e-3, 1e5))
    middle = (0.0, 0.0, 0.0) if pos is None else triple(pos.numbers((3,), -1e5, 1e5))
    texture, side = _terrain_texture(element)
    try:
        whole, *tiles = read_heightmap(resolve(uri), extent, middle, side)
    except ForbiddenError:
        raise
    except SdfError as error:
        uri.warn_ignored(f"is left out: {error}")
        return []
    if is_solid:
        return [(Mesh(tile), None) for tile in tiles]
    return [(Mesh(whole), None if texture is None else MeshPart(whole, texture=texture))]


def _terrain_texture(element: Element) -> tuple[Path | None, float]:
    """Return the image of the first <texture> of a <heightmap>, and the side of one texture, m."""
    found = element.first("texture")
    if found is None:
        return None, _TERRAIN_TEXTURE
    found.warn_unknown(("diffuse", "size"), ("normal",))
    picture, side = found.one("diffuse"), found.number_of("size", _TERRAIN_TEXTURE, 0.01, 1e5)
    try:
        return (None if picture is None else resolve(picture)), side
    except ForbiddenError:
        raise
    except SdfError:
        found.warn_ignored("names an image that is not found: the terrain is plain")
        return None, side


def _read_mesh(element: Element) -> list[tuple[Geometry, MeshPart | None]]:
    """Read a <mesh>; one that is missing or cannot be read is left out with a warning."""
    element.warn_unknown(("uri", "scale", "submesh"))
    uri, scale, submesh = element.required("uri"), element.one("scale"), element.one("submesh")
    factors = (1.0, 1.0, 1.0) if scale is None else triple(scale.numbers((3,)))
    try:
        path = resolve(uri)
    except ForbiddenError:
        raise
    except SdfError:
        uri.warn_ignored(f"{uri.string()!r} is not found: the shape is left out")
        return []
    ending = path.suffix.lower()
    if ending == ".obj":
        if submesh is not None:
            submesh.warn_ignored("is not supported in Wavefront files and ignored")
        try:
            check_wavefront(path)
        except SdfError as error:
            uri.warn_ignored(f"is left out: {error}")
            return []
        return [(Mesh(path, factors), None)]
    if ending not in ENDINGS:
        uri.warn_ignored(f"{uri.string()!r} is left out: meshes are .obj, {', '.join(ENDINGS)}")
        return []
    try:
        parts = read_mesh(path, *_submesh(submesh))
    except SdfError as error:
        uri.warn_ignored(f"is left out: {error}")
        return []
    return [(Mesh(part.path, factors), part) for part in parts]


def _submesh(element: Element | None) -> tuple[str, bool]:
    """Return the name of the wanted geometry, empty for all, and whether it is centred."""
    if element is None:
        return "", False
    return element.required("name").string(), element.boolean_of("center", False)


def triple(values: tuple[float, ...]) -> Vector:
    """Return three numbers as a vector."""
    x, y, z = values
    return (x, y, z)


def write_visual(visual: Visual, name: str) -> list[str]:
    """Write a <visual> as lines."""
    return [
        f'<visual name="{name}">',
        *_write_placed(visual.pose, visual.geometry),
        f"  {write_material(visual)}",
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
