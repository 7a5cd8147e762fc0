"""Shapes as triangles with normals and texture coordinates, and Wavefront files of triangles.

The renderer generates the triangles of every shape, because pybullet's spheres are coarse, its boxes support textures
in only one of its renderers, and one mesh is drawn faster than many.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from xtdrone_common.cameras import camera_pose
from xtdrone_common.files import MB, read_bytes
from xtdrone_common.poses import Pose
from xtdrone_worlds.shapes.visual import Box, Cylinder, Geometry, Mesh, Sphere

_AROUND = 24  # corners per circle
_RINGS = 12  # from pole to pole of a sphere
_LARGEST = 64 * MB  # of a Wavefront file

Array = NDArray[np.float64]


class MeshError(ValueError):
    """An invalid mesh file."""


@dataclass(frozen=True)
class Triangles:
    """Triangles, counter-clockwise as seen from outside.

    Attributes:
        points: corners, shape (n, 3, 3), m.
        normals: outward unit normals at the corners, shape (n, 3, 3).
        uv: texture coordinates, shape (n, 3, 2), with (0, 0) at the image's lower left corner.
    """

    points: Array
    normals: Array
    uv: Array

    def placed(self, pose: Pose) -> Triangles:
        """Return the triangles transformed by ``pose``."""
        turn = rotation_matrix(pose)
        return Triangles(self.points @ turn.T + pose.position, self.normals @ turn.T, self.uv)


def rotation_matrix(pose: Pose) -> Array:
    """Return the rotation matrix (3, 3) of a pose, from its frame to the parent frame.

    Raises:
        ValueError: the norm of the quaternion differs from 1 by more than 0.001.
    """
    w, x, y, z = pose.orientation
    length = math.sqrt(x * x + y * y + z * z + w * w)
    if not abs(length - 1.0) < 1e-3:
        raise ValueError(f"orientation: {pose.orientation!r} is not allowed, a quaternion (w, x, y, z) of length 1")
    return camera_pose.rotation_matrix((w / length, x / length, y / length, z / length))


def triangles_of(geometry: Geometry) -> Triangles:
    """Return the triangles of a shape in its frame.

    Raises:
        MeshError: a mesh file cannot be read.
    """
    if isinstance(geometry, Box):
        return _box(geometry)
    if isinstance(geometry, Cylinder):
        return _cylinder(geometry)
    if isinstance(geometry, Sphere):
        return _sphere(geometry)
    return _scale(read_obj(geometry.path), geometry)


def joined(parts: Iterable[Triangles]) -> Triangles:
    """Return all triangles as one object."""
    parts = list(parts)
    return Triangles(
        np.concatenate([part.points for part in parts]),
        np.concatenate([part.normals for part in parts]),
        np.concatenate([part.uv for part in parts]),
    )


def _box(box: Box) -> Triangles:
    """Return the six faces of a box, each with the whole texture, upright on the side faces."""
    half = 0.5 * np.asarray(box.size, float)
    corners = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    order = [0, 1, 2, 0, 2, 3]
    points, normals, uv = [], [], []
    sides = [  # outward, the texture's right, the texture's up
        ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
        ((-1, 0, 0), (0, -1, 0), (0, 0, 1)),
        ((0, 1, 0), (-1, 0, 0), (0, 0, 1)),
        ((0, -1, 0), (1, 0, 0), (0, 0, 1)),
        ((0, 0, 1), (1, 0, 0), (0, 1, 0)),
        ((0, 0, -1), (1, 0, 0), (0, -1, 0)),
    ]
    for out, right, up in np.array(sides, float):
        face = out + corners[:, :1] * right + corners[:, 1:] * up
        points.append((face * half)[order])
        normals.append(np.tile(out, (6, 1)))
        uv.append((0.5 + 0.5 * corners)[order])
    return Triangles(
        np.concatenate(points).reshape(-1, 3, 3),
        np.concatenate(normals).reshape(-1, 3, 3),
        np.concatenate(uv).reshape(-1, 3, 2),
    )


def _grid(points: Array, normals: Array, uv: Array) -> Triangles:
    """Return the triangles of a grid of corners (rows upwards, columns to the right as seen from outside)."""

    def corners(values: Array) -> Array:
        a, b, c, d = values[:-1, :-1], values[:-1, 1:], values[1:, 1:], values[1:, :-1]
        both = np.stack([np.stack([a, b, c], axis=2), np.stack([a, c, d], axis=2)], axis=2)
        return both.reshape(-1, 3, values.shape[-1])

    found = Triangles(corners(points), corners(normals), corners(uv))
    edges = np.cross(found.points[:, 1] - found.points[:, 0], found.points[:, 2] - found.points[:, 0])
    some = np.linalg.norm(edges, axis=1) > 0.0  # at the poles every second triangle is degenerate
    return Triangles(found.points[some], found.normals[some], found.uv[some])


def _cylinder(cylinder: Cylinder) -> Triangles:
    # The mean width equals that of the circle: corners lie outside by as much as edges lie inside.
    radius = cylinder.radius * 2.0 / (1.0 + math.cos(math.pi / _AROUND))
    turn = np.linspace(0.0, 2.0 * math.pi, _AROUND + 1)
    turn[-1] = 0.0
    ring = np.column_stack([np.cos(turn), np.sin(turn), np.zeros_like(turn)])
    along = np.linspace(0.0, 1.0, _AROUND + 1)
    top = np.array([0.0, 0.0, 0.5 * cylinder.length])
    up = np.array([0.0, 0.0, 1.0])
    side = _grid(
        np.stack([radius * ring - top, radius * ring + top]),
        np.stack([ring, ring]),
        np.stack([np.column_stack([along, np.full_like(along, v)]) for v in (0.0, 1.0)]),
    )
    disc = 0.5 + 0.5 * ring[:, :2]
    middle = np.zeros_like(ring)
    upper = _grid(
        np.stack([radius * ring + top, middle + top]),
        np.tile(up, (2, _AROUND + 1, 1)),
        np.stack([disc, np.full_like(disc, 0.5)]),
    )
    lower = _grid(
        np.stack([middle - top, radius * ring - top]),
        np.tile(-up, (2, _AROUND + 1, 1)),
        np.stack([np.full_like(disc, 0.5), disc]),
    )
    return joined([side, upper, lower])


def _sphere(sphere: Sphere) -> Triangles:
    radius = sphere.radius * 2.0 / (1.0 + math.cos(math.pi / _AROUND))
    height = np.linspace(-0.5 * math.pi, 0.5 * math.pi, _RINGS + 1)[:, None]
    turn = np.linspace(0.0, 2.0 * math.pi, _AROUND + 1)[None, :]
    out = np.stack([np.cos(height) * np.cos(turn), np.cos(height) * np.sin(turn), np.sin(height) + 0.0 * turn], axis=2)
    out[:, -1] = out[:, 0]
    out[0, :], out[-1, :] = (0.0, 0.0, -1.0), (0.0, 0.0, 1.0)
    u, v = np.meshgrid(np.linspace(0.0, 1.0, _AROUND + 1), np.linspace(0.0, 1.0, _RINGS + 1))
    return _grid(radius * out, out, np.stack([u, v], axis=2))


def _scale(mesh: Triangles, geometry: Mesh) -> Triangles:
    scale = np.asarray(geometry.scale, float)
    if np.all(scale == 1.0):
        return mesh
    if not np.all(np.isfinite(scale)) or np.any(scale == 0.0):
        raise MeshError(f"{geometry.path}: scale {geometry.scale!r} is not allowed, three numbers other than 0")
    normals = mesh.normals / scale
    normals /= np.maximum(np.linalg.norm(normals, axis=2, keepdims=True), 1e-12)
    if np.prod(scale) < 0.0:  # mirrored: reverse the order of the corners
        return Triangles((mesh.points * scale)[:, ::-1], normals[:, ::-1], mesh.uv[:, ::-1])
    return Triangles(mesh.points * scale, normals, mesh.uv)


def read_obj(path: Path) -> Triangles:
    """Return the triangles of a Wavefront file. Missing normals are those of flat faces; missing uv are (0, 0).

    Materials are ignored: the visual defines colour and texture.

    Raises:
        MeshError: the file is missing, malformed or without faces; the message names file and line.
    """
    values: dict[str, list[list[float]]] = {"v": [], "vt": [], "vn": []}
    faces: list[tuple[tuple[int, int, int], ...]] = []
    try:
        lines = read_bytes(path, _LARGEST).decode("utf-8", "replace").splitlines()
    except OSError as error:
        raise MeshError(f"{path}: {error.strerror or error}") from None
    for number, line in enumerate(lines, 1):
        words = line.split()
        if not words:
            continue
        try:
            if words[0] in values:
                values[words[0]].append(list(map(float, words[1:3] if words[0] == "vt" else words[1:4])))
            elif words[0] == "f":
                corners = [_corner(word, values) for word in words[1:]]
                faces += [(corners[0], b, c) for b, c in itertools.pairwise(corners[1:])]
        except (ValueError, IndexError):
            raise MeshError(f"{path}, line {number}: {line.strip()[:80]!r} cannot be read") from None
    if not faces:
        raise MeshError(f"{path}: has no faces, a Wavefront file (.obj) with faces is needed")
    return _triangles(path, values, faces)


def _corner(word: str, values: dict[str, list[list[float]]]) -> tuple[int, int, int]:
    """Return the indices of point, texture coordinate and normal, from 0; -1 for none."""
    parts = [*word.split("/"), "", ""][:3]
    found = []
    for part, kind in zip(parts, ("v", "vt", "vn"), strict=True):
        index, count = int(part) if part else 0, len(values[kind])
        index = index - 1 if index > 0 else count + index if index < 0 else -1
        if index >= count or (kind == "v" and index < 0):
            raise ValueError(word)
        found.append(index)
    return found[0], found[1], found[2]


def _triangles(path: Path, values: dict[str, list[list[float]]], faces: list) -> Triangles:
    try:
        points = np.array(values["v"], float).reshape(-1, 3)
        uv = np.array([*values["vt"], [0.0, 0.0]], float).reshape(-1, 2)
        normals = np.array([*values["vn"], [0.0, 0.0, 0.0]], float).reshape(-1, 3)
    except ValueError:
        raise MeshError(f"{path}: corners must have three numbers, texture coordinates two") from None
    if not all(np.isfinite(numbers).all() for numbers in (points, uv, normals)):
        raise MeshError(f"{path}: has numbers that are not finite, all must be")
    indices = np.array(faces, int)
    corners = points[indices[:, :, 0]]
    flat = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(flat, axis=1)
    some = area > 0.0
    corners, indices, flat = corners[some], indices[some], flat[some] / area[some, None]
    given = normals[indices[:, :, 2]]  # index -1 selects the zero appended at the end
    length = np.linalg.norm(given, axis=2, keepdims=True)
    out = np.where(length > 0.0, given / np.maximum(length, 1e-12), flat[:, None, :])
    return Triangles(corners, out, uv[indices[:, :, 1]])


def write_obj(path: Path, triangles: Triangles) -> None:
    """Write a Wavefront file, each corner once."""
    rows = np.concatenate([triangles.points, triangles.normals, triangles.uv], axis=2).reshape(-1, 8)
    rows = np.round(rows, 6) + 0.0
    unique, inverse = np.unique(rows, axis=0, return_inverse=True)
    text = [f"v {x:.9g} {y:.9g} {z:.9g}\n" for x, y, z in unique[:, :3].tolist()]
    text += [f"vn {x:.9g} {y:.9g} {z:.9g}\n" for x, y, z in unique[:, 3:6].tolist()]
    text += [f"vt {u:.9g} {v:.9g}\n" for u, v in unique[:, 6:].tolist()]
    faces = inverse.reshape(-1, 3) + 1
    text += [f"f {a}/{a}/{a} {b}/{b}/{b} {c}/{c}/{c}\n" for a, b, c in faces.tolist()]
    path.write_text("".join(text), encoding="ascii")
