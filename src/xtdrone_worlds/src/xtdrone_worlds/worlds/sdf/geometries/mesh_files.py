"""COLLADA, STL and glTF meshes and extruded polygons as Wavefront files, which renderer and physics read.

The files are in the user's cache, named by a hash of their source. COLLADA and glTF contribute geometry, node
transforms, units, and plain colours and textures of the materials. <up_axis> of COLLADA is ignored, as in Gazebo
Classic. In glTF y is up (glTF 2.0 specification, 3.4); its meshes are turned so that z is up.
"""

from __future__ import annotations

import hashlib
import io
import itertools
import json
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from xtdrone_common.files import MB, load_json, read_bytes
from xtdrone_worlds.data_files import cached_folder
from xtdrone_worlds.shapes.visual import Colour
from xtdrone_worlds.worlds.sdf.world_records import SdfError

LARGEST_MESH = 64 * MB
MOST_TRIANGLES = 300_000
MOST_NODES = 2000
ENDINGS = (".dae", ".stl", ".gltf", ".glb")
"""File name endings of the meshes that ``read_mesh`` converts."""

_FORMAT = b"1"  # of the cached files; a new version invalidates them
_MOST_GLTF_VALUES = 10_000_000
_LARGEST_PICTURE = LARGEST_MESH
_UNIT = re.compile(rb"<unit\b[^>]*\bmeter\s*=\s*[\"']([^\"']+)[\"']")
_PARTS = "parts.json"
_UPRIGHT = np.array([[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])


@dataclass(frozen=True)
class MeshPart:
    """The triangles of one material.

    Attributes:
        path: Wavefront file, m.
        colour: red, green, blue, opacity, 0..1; None if the file gives none.
        texture: PNG file; None for plain colour.
    """

    path: Path
    colour: Colour | None = None
    texture: Path | None = None


def read_mesh(path: Path, submesh: str = "", centred: bool = False) -> tuple[MeshPart, ...]:
    """Return the parts of a COLLADA, STL or glTF file, one for each material; the first call for a file converts it.

    Args:
        path: file with one of ``ENDINGS``.
        submesh: name of the only geometry to use; empty for all.
        centred: whether to move the centre of the geometry to the origin.

    Raises:
        SdfError: the file cannot be read, is too large, or has no triangles.
    """
    try:
        data = read_bytes(path, LARGEST_MESH)
    except OSError as error:
        raise SdfError(f"{path}: {error.strerror or error}") from error
    content = data + _buffers(data, path) if path.suffix.lower() == ".gltf" else data
    key = hashlib.sha256(_FORMAT + f"{path.absolute()}\n{submesh}\n{centred}\n".encode() + content).hexdigest()[:24]
    try:
        return _parts_in(cached_folder("meshes", key, lambda folder: _convert(data, path, submesh, centred, folder)))
    except OSError as error:
        raise SdfError(f"{path}: cannot be converted: {error.strerror or error}") from error


@lru_cache(maxsize=1024)
def _parts_in(folder: Path) -> tuple[MeshPart, ...]:
    rows = json.loads((folder / _PARTS).read_text())
    return tuple(
        MeshPart(
            folder / row["file"],
            None if row["colour"] is None else tuple(row["colour"]),
            folder / row["texture"] if row["texture"] else None,
        )
        for row in rows
    )


def _convert(data: bytes, path: Path, submesh: str, centred: bool, folder: Path) -> None:
    """Write the parts of a mesh file into ``folder``."""
    meshes = _load(data, path)
    if submesh:
        meshes = [(name, mesh) for name, mesh in meshes if submesh in name]
        if not meshes:
            raise SdfError(f"{path}: it has no geometry {submesh!r}")
    _check_triangles(sum(len(mesh.faces) for _, mesh in meshes), path)
    corners = np.concatenate([mesh.vertices for _, mesh in meshes])
    if not np.isfinite(corners).all():
        raise SdfError(f"{path}: it has corners that are not finite")
    middle = 0.5 * (corners.min(axis=0) + corners.max(axis=0)) if centred else np.zeros(3)
    rows: list[dict[str, Any]] = []
    for number, (look, group) in enumerate(_by_look(meshes)):
        file = folder / f"part_{number}.obj"
        texture = _save_picture(look.picture, folder / f"part_{number}.png")
        file.write_text("".join(_wavefront(group, middle)))
        rows.append({"file": file.name, "colour": look.colour, "texture": texture})
    (folder / _PARTS).write_text(json.dumps(rows))


def _buffers(data: bytes, path: Path) -> bytes:
    """Return the files that hold the numbers of a .gltf file; the loader names those that are missing."""
    try:
        names = [str(buffer.get("uri", "")) for buffer in load_json(data.decode("utf-8")).get("buffers", [])]
    except (AttributeError, TypeError, ValueError) as error:
        raise SdfError(f"{path}: not a GLTF file: {error}") from error
    files = [path.parent / Path(name).name for name in names if not name.startswith("data:")]
    return b"".join(read_bytes(file, LARGEST_MESH) for file in files if file.is_file())


def _check_triangles(count: int, path: Path) -> None:
    if not 0 < count <= MOST_TRIANGLES:
        raise SdfError(f"{path}: it has {count} triangles, 1 to {MOST_TRIANGLES} are allowed")


def check_wavefront(path: Path) -> None:
    """Check the size of a Wavefront file before renderer and physics read it.

    Raises:
        SdfError: the file cannot be read, or has no or too many triangles.
    """
    try:
        status = path.stat()
        faces = _count_faces(path, status.st_mtime_ns, status.st_size)
    except (OSError, ValueError) as error:  # of a name with NUL
        raise SdfError(f"{path}: {getattr(error, 'strerror', None) or error}") from error
    _check_triangles(faces, path)


@lru_cache(maxsize=1024)
def _count_faces(path: Path, _modified: int, _size: int) -> int:
    return read_bytes(path, LARGEST_MESH).count(b"\nf ")


def _load(data: bytes, path: Path) -> list[tuple[str, Any]]:
    """Return names and triangles of a file, transformed to its root and scaled to metres."""
    import trimesh  # takes half a second; few worlds have such meshes

    kind = path.suffix.lower().removeprefix(".")
    if kind == "dae" and b"<!ENTITY" in data:
        raise SdfError(f"{path}: <!ENTITY is not allowed: write its text instead")
    _check_counts(data, kind, path)
    pictures: Any = _Pictures(path.parent)
    try:
        scene = trimesh.load_scene(io.BytesIO(data), file_type=kind, resolver=pictures, process=False)
        order = {name: number for number, name in enumerate(scene.geometry)}
        placed = [(order[name], str(node), name, matrix) for node, (matrix, name) in _nodes(scene)]
        placed = [row for row in placed if hasattr(scene.geometry[row[2]], "faces")]  # not points or lines
        # before they are copied for each node
        _check_triangles(sum(len(scene.geometry[name].faces) for _, _, name, _ in placed), path)
        found = []
        for _, _, name, matrix in sorted(placed, key=lambda row: row[:2]):
            _check_corners(scene.geometry[name], name, path)
            mesh = scene.geometry[name].copy()
            mesh.apply_transform(matrix)
            mesh.apply_scale(_metres(data) if kind == "dae" else 1.0)
            if kind in ("gltf", "glb"):
                mesh.apply_transform(_UPRIGHT)
            found.append((str(name), mesh))
    except SdfError:
        raise
    except Exception as error:  # any exception of the parsers
        raise SdfError(f"{path}: not a {kind.upper()} file: {type(error).__name__}: {str(error)[:200]}") from error
    return found


def _check_counts(data: bytes, kind: str, path: Path) -> None:
    """Check the numbers of nodes and of values before a parser, whose time grows with their square, reads them.

    Raises:
        SdfError: there are too many.
    """
    if kind == "dae":
        _check_nodes(data.count(b"<node"), path)
    if kind not in ("gltf", "glb"):
        return
    length = int.from_bytes(data[12:16], "little") if kind == "glb" else len(data)
    try:
        content = load_json((data[20 : 20 + length] if kind == "glb" else data).decode("utf-8"))
        _check_nodes(max(len(content.get(name) or ()) for name in ("nodes", "meshes", "accessors", "materials")), path)
        values = sum(int(accessor["count"]) for accessor in content.get("accessors") or ())
    except SdfError:
        raise
    except (AttributeError, KeyError, TypeError, ValueError, OverflowError) as error:
        raise SdfError(f"{path}: not a {kind.upper()} file: {str(error)[:200]}") from error
    if not 0 <= values <= _MOST_GLTF_VALUES:
        raise SdfError(f"{path}: its accessors have {values} values, 0 to {_MOST_GLTF_VALUES} are allowed")


def _check_nodes(count: int, path: Path) -> None:
    if count > MOST_NODES:
        raise SdfError(f"{path}: it has {count} nodes, meshes or accessors, at most {MOST_NODES} are allowed")


def _check_corners(mesh: Any, name: str, path: Path) -> None:
    """Check that the triangles of a mesh have corners."""
    faces = np.asarray(mesh.faces)
    if len(faces) and not (faces.min() >= 0 and faces.max() < len(mesh.vertices)):
        bad, count = int(faces.max()), len(mesh.vertices)
        raise SdfError(f"{path}: geometry {str(name)[:60]!r}: corner {bad} does not exist, it has {count}")


def _nodes(scene: Any) -> Iterator[tuple[Any, Any]]:
    """Yield the nodes of a scene with geometry: name, and pair of transform and name of the geometry."""
    yield from ((node, scene.graph[node]) for node in scene.graph.nodes_geometry)


def _metres(data: bytes) -> float:
    """Return the length unit of a COLLADA file, m."""
    match = _UNIT.search(data)
    unit = float(match[1]) if match else 1.0
    if not 1e-6 <= unit <= 1e6:
        raise ValueError(f"unit of {unit:g} m")
    return unit


class _Pictures:
    """Finds a file's textures and buffers beside it or among the model's textures, by name alone."""

    def __init__(self, folder: Path) -> None:
        self._folders = (folder, folder.parent / "materials" / "textures", folder / "textures", folder.parent)

    def get(self, name: str) -> bytes:
        """Return the content of a file; raise OSError if it is not there."""
        base = Path(str(name).replace("\\", "/")).name
        for folder in self._folders:
            if (folder / base).is_file():
                return read_bytes(folder / base, _LARGEST_PICTURE)
        raise FileNotFoundError(name)

    def __getitem__(self, name: str) -> bytes:
        return self.get(name)


@dataclass(frozen=True, eq=False)
class _Look:
    colour: list[float] | None
    picture: Any


def _by_look(meshes: Sequence[tuple[str, Any]]) -> Iterator[tuple[_Look, list[Any]]]:
    """Yield the triangles of each colour and texture, in the order of the file."""
    groups: dict[object, tuple[_Look, list[Any]]] = {}
    for _, mesh in meshes:
        look = _look_of(mesh)
        key = (None if look.colour is None else tuple(look.colour), id(look.picture))
        groups.setdefault(key, (look, []))[1].append(mesh)
    yield from groups.values()


def _look_of(mesh: Any) -> _Look:
    material = getattr(mesh.visual, "material", None)
    if material is None:
        return _Look(None, None)
    picture = getattr(material, "baseColorTexture", None)
    factor = getattr(material, "baseColorFactor", None)
    if picture is not None or factor is None:
        return _Look(None, picture)
    scaled = np.asarray(factor, float) / (255.0 if np.asarray(factor).dtype == np.uint8 else 1.0)
    return _Look(np.clip(scaled, 0.0, 1.0).round(4).tolist(), None)


def _save_picture(picture: Any, path: Path) -> str:
    """Save a texture as PNG and return its file name; "" if there is none, or it cannot be read."""
    if picture is None:
        return ""
    try:
        picture.convert("RGB").save(path)
    except Exception:  # a damaged image; the colour of the material remains
        path.unlink(missing_ok=True)
        return ""
    return path.name


def _wavefront(meshes: Sequence[Any], middle: NDArray[np.float64]) -> Iterator[str]:
    """Yield the lines of a Wavefront file of triangles with normals and texture points."""
    first = 1
    for mesh in meshes:
        uv = getattr(mesh.visual, "uv", None)
        points = np.asarray(mesh.vertices) - middle
        texture = np.zeros((len(points), 2)) if uv is None or len(uv) != len(points) else np.asarray(uv)[:, :2]
        yield from (f"v {x:.6g} {y:.6g} {z:.6g}\n" for x, y, z in points.tolist())
        yield from (f"vt {u:.6g} {v:.6g}\n" for u, v in np.nan_to_num(texture).tolist())
        yield from (f"vn {x:.4f} {y:.4f} {z:.4f}\n" for x, y, z in np.nan_to_num(mesh.vertex_normals).tolist())
        yield from (f"f {a}/{a}/{a} {b}/{b}/{b} {c}/{c}/{c}\n" for a, b, c in (mesh.faces + first).tolist())
        first += len(points)


# extruded polygons


def extrude(outlines: Sequence[Sequence[tuple[float, float]]], height: float) -> Path:
    """Return the Wavefront file of a polygon extruded from z = 0.

    Args:
        outlines: corners of each outline, m; a second outline inside the first is a hole.
        height: m, above 0.

    Raises:
        ValueError: the outlines enclose no area.
        OSError: the cache cannot be written.
    """
    key = hashlib.sha256(_FORMAT + repr((outlines, height)).encode()).hexdigest()[:24]
    return cached_folder("polylines", key, lambda folder: _extrude(outlines, height, folder)) / "polyline.obj"


def _extrude(outlines: Sequence[Sequence[tuple[float, float]]], height: float, folder: Path) -> None:
    import shapely

    area = shapely.Polygon()
    for outline in outlines:
        area = area.symmetric_difference(shapely.make_valid(shapely.Polygon(outline)))
    triangles = [
        list(shapely.geometry.polygon.orient(triangle).exterior.coords)[:3]
        for triangle in shapely.constrained_delaunay_triangles(area).geoms
    ]
    if not triangles:
        raise ValueError("the outlines enclose no area")
    faces: list[list[tuple[float, float, float]]] = []
    for a, b, c in triangles:
        faces.append([(*corner, height) for corner in (a, b, c)])
        faces.append([(*corner, 0.0) for corner in (a, c, b)])
    for part in getattr(area, "geoms", [area]):
        oriented = shapely.geometry.polygon.orient(part) if part.geom_type == "Polygon" else None
        for ring in () if oriented is None else (oriented.exterior, *oriented.interiors):
            corners = list(ring.coords)
            for p, q in itertools.pairwise(corners):
                faces.append([(*p, 0.0), (*q, 0.0), (*q, height)])
                faces.append([(*p, 0.0), (*q, height), (*p, height)])
    lines = [f"v {x!r} {y!r} {z!r}\n" for face in faces for x, y, z in face]
    lines += [f"f {3 * k + 1} {3 * k + 2} {3 * k + 3}\n" for k in range(len(faces))]
    (folder / "polyline.obj").write_text("".join(lines))
