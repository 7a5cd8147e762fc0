"""Triangle meshes of the scenery, as arrays and as Wavefront files.

Metres, z up. Every triangle has separate corners, so that faces look flat, and texture coordinates of 0 or more,
because renderers treat negative ones differently.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class TexturedTriangles:
    """A triangle mesh.

    Attributes:
        corners: shape (n, 3, 3), m, counter-clockwise seen from outside.
        texture: texture coordinates, shape (n, 3, 2).
    """

    corners: Array
    texture: Array


def join(*parts: TexturedTriangles) -> TexturedTriangles:
    """Return several meshes as one."""
    return TexturedTriangles(np.concatenate([p.corners for p in parts]), np.concatenate([p.texture for p in parts]))


def move(
    mesh: TexturedTriangles, offset: Sequence[float], scale: Sequence[float] = (1.0, 1.0, 1.0)
) -> TexturedTriangles:
    """Return the mesh scaled, then translated, m."""
    return TexturedTriangles(mesh.corners * np.asarray(scale) + np.asarray(offset), mesh.texture)


def map_texture(corners: Array, size: float = 1.0) -> TexturedTriangles:
    """Return triangles with the texture projected along the main direction of each, repeating every ``size`` m."""
    normal = np.abs(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))
    axis = np.argmax(normal, axis=1)
    first, second = np.array([1, 0, 0])[axis], np.array([2, 2, 1])[axis]
    rows = np.arange(len(corners))[:, None]
    three = np.arange(3)[None, :]
    flat = np.stack([corners[rows, three, first[:, None]], corners[rows, three, second[:, None]]], axis=2) / size
    return TexturedTriangles(corners, flat - np.floor(flat.reshape(-1, 2).min(axis=0)))


def polyhedron(
    points: Sequence[Sequence[float]], faces: Sequence[Sequence[int]], size: float = 1.0
) -> TexturedTriangles:
    """Return a polyhedron of flat faces, lists of point indices counter-clockwise seen from outside."""
    p = np.asarray(points, float)
    triangles = [(f[0], f[i], f[i + 1]) for f in faces for i in range(1, len(f) - 1)]
    return map_texture(p[np.array(triangles)], size)


def cuboid(low: Sequence[float], high: Sequence[float]) -> TexturedTriangles:
    """Return a box between its lowest and highest corner, m."""
    (a, b, c), (d, e, f) = low, high
    points = [(a, b, c), (d, b, c), (d, e, c), (a, e, c), (a, b, f), (d, b, f), (d, e, f), (a, e, f)]
    faces = [(3, 2, 1, 0), (4, 5, 6, 7), (0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7)]
    return polyhedron(points, faces)


def prism(profile: Sequence[tuple[float, float]], width: float) -> TexturedTriangles:
    """Return a convex or star-shaped outline (x, z), counter-clockwise seen from -y, extruded along y."""
    n, y = len(profile), 0.5 * width
    near = [(x, -y, z) for x, z in profile]
    far = [(x, y, z) for x, z in profile]
    middle = np.mean(np.asarray(profile), axis=0)
    points = [*near, *far, (middle[0], -y, middle[1]), (middle[0], y, middle[1])]
    faces: list[tuple[int, ...]] = []
    for i in range(n):
        j = (i + 1) % n
        faces += [(i, j, 2 * n), (n + j, n + i, 2 * n + 1), (j, i, n + i, n + j)]
    return polyhedron(points, faces)


def revolve(outline: Sequence[tuple[float, float]], sides: int) -> TexturedTriangles:
    """Return an outline (radius, z), from bottom to top, revolved about z."""
    angle = np.arange(sides) * (2.0 * math.pi / sides)
    rings = [np.column_stack([r * np.cos(angle), r * np.sin(angle), np.full(sides, z)]) for r, z in outline]
    points = np.concatenate(rings)
    faces: list[tuple[int, ...]] = []
    for k in range(len(outline) - 1):
        for i in range(sides):
            j = (i + 1) % sides
            faces.append((k * sides + i, k * sides + j, (k + 1) * sides + j, (k + 1) * sides + i))
    top = (len(outline) - 1) * sides
    faces += [tuple(range(top, top + sides)), tuple(range(sides - 1, -1, -1))]
    triangles = polyhedron(points.tolist(), faces)
    area = np.linalg.norm(
        np.cross(triangles.corners[:, 1] - triangles.corners[:, 0], triangles.corners[:, 2] - triangles.corners[:, 0]),
        axis=1,
    )
    return TexturedTriangles(triangles.corners[area > 1e-9], triangles.texture[area > 1e-9])


def ball(divisions: int, roughness: float, rng: np.random.Generator) -> TexturedTriangles:
    """Return a sphere of radius 1 from an octahedron, its points moved radially by up to ``roughness``."""
    axes = np.array([(1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1)], float)
    corners = axes[np.array([(0, 2, 4), (2, 1, 4), (1, 3, 4), (3, 0, 4), (2, 0, 5), (1, 2, 5), (3, 1, 5), (0, 3, 5)])]
    for _ in range(divisions):
        a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
        ab, bc, ca = (0.5 * (p + q) for p, q in ((a, b), (b, c), (c, a)))
        groups = [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
        corners = np.concatenate([np.stack(group, axis=1) for group in groups])
        corners /= np.linalg.norm(corners, axis=2, keepdims=True)
    # equal displacement of a point in all its triangles
    points, inverse = np.unique(np.round(corners.reshape(-1, 3), 6), axis=0, return_inverse=True)
    push = 1.0 + roughness * rng.uniform(-1.0, 1.0, len(points))
    return map_texture((points * push[:, None])[inverse.reshape(-1)].reshape(-1, 3, 3))


def crown(blobs: int, rng: np.random.Generator) -> TexturedTriangles:
    """Return a tree's crown, radius and half height approximately 1, of several rough balls."""
    parts = [move(ball(2, 0.16, rng), (0.0, 0.0, 0.0), (0.72, 0.72, 0.8))]
    for k in range(blobs):
        angle = 2.0 * math.pi * (k + rng.uniform(0.0, 0.6)) / blobs
        size = rng.uniform(0.38, 0.58)
        place = (0.55 * math.cos(angle), 0.55 * math.sin(angle), rng.uniform(-0.35, 0.45))
        parts.append(move(ball(1, 0.18, rng), place, (size, size, size)))
    return join(*parts)


def conifer(tiers: int, rng: np.random.Generator) -> TexturedTriangles:
    """Return a spruce's crown from z = 0 to 1, radius approximately 1, of rough cones."""
    parts = []
    for k in range(tiers):
        low = k / (tiers + 0.6)
        radius = (1.0 - 0.8 * k / tiers) * rng.uniform(0.92, 1.08)
        height = 1.0 - low if k == tiers - 1 else 1.7 / (tiers + 0.6)
        cone = revolve([(radius, low), (0.0, low + height)], 9)
        jitter = rng.uniform(0.9, 1.1, (*cone.corners.shape[:1], 1, 1))
        parts.append(
            TexturedTriangles(
                cone.corners * np.concatenate([jitter, jitter, np.ones_like(jitter)], axis=2), cone.texture
            )
        )
    return join(*parts)


def blob(rng: np.random.Generator) -> TexturedTriangles:
    """Return an irregular patch of ground, radius approximately 1, with a texture period of 2 m."""
    sides = 28
    angle = np.arange(sides) * (2.0 * math.pi / sides)
    radius = 1.0 + sum(
        rng.uniform(0.0, 0.28) / k * np.cos(k * angle + rng.uniform(0.0, 6.28)) for k in range(1, 6)
    )  # fmt: skip
    edge = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), np.zeros(sides)])
    nearer = np.roll(edge, -1, axis=0)
    return map_texture(np.stack([np.zeros_like(edge), edge, nearer], axis=1), 2.0)


def grid(cells: int, times: int) -> TexturedTriangles:
    """Return the square from -0.5 to 0.5 as ``cells`` x ``cells``, with ``times`` x ``times`` textures in each cell."""
    at = np.linspace(-0.5, 0.5, cells + 1)
    corners, texture = [], []
    for i in range(cells):
        for j in range(cells):
            a, b, c, d = at[i], at[j], at[i + 1], at[j + 1]
            quad = [(a, b, 0.0), (c, b, 0.0), (c, d, 0.0), (a, d, 0.0)]
            coordinates = [(0.0, 0.0), (times, 0.0), (times, times), (0.0, times)]
            for triangle in ((0, 1, 2), (0, 2, 3)):
                corners.append([quad[k] for k in triangle])
                texture.append([coordinates[k] for k in triangle])
    return TexturedTriangles(np.array(corners), np.array(texture, float))


def strip(pieces: int, sway: float, rng: np.random.Generator) -> TexturedTriangles:
    """Return a winding path along x from -0.5 to 0.5, width 1, offset up to ``sway``, one texture per piece."""
    x = np.linspace(-0.5, 0.5, pieces + 1)
    y = sum(
        sway / k * rng.uniform(0.3, 1.0) * np.sin(2.0 * math.pi * k * x + rng.uniform(0.0, 6.28)) for k in (1, 2, 3)
    )
    y = y - y[pieces // 2] + np.zeros_like(x)
    corners, texture = [], []
    for i in range(pieces):
        quad = [(x[i], y[i] - 0.5), (x[i + 1], y[i + 1] - 0.5), (x[i + 1], y[i + 1] + 0.5), (x[i], y[i] + 0.5)]
        coordinates = [(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)]
        for triangle in ((0, 1, 2), (0, 2, 3)):
            corners.append([(*quad[k], 0.0) for k in triangle])
            texture.append([coordinates[k] for k in triangle])
    return TexturedTriangles(np.array(corners), np.array(texture, float))


def write_obj(mesh: TexturedTriangles, path: Path) -> None:
    """Write a Wavefront file with flat normals."""
    points, at = np.unique(np.round(mesh.corners.reshape(-1, 3), 4) + 0.0, axis=0, return_inverse=True)
    texture, texture_at = np.unique(np.round(mesh.texture.reshape(-1, 2), 4) + 0.0, axis=0, return_inverse=True)
    normal = np.cross(mesh.corners[:, 1] - mesh.corners[:, 0], mesh.corners[:, 2] - mesh.corners[:, 0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    normals, normal_at = np.unique(np.round(normal, 3) + 0.0, axis=0, return_inverse=True)
    lines = ["# made by xtdrone_worlds.worlds.scenery.assets"]
    lines += ["v " + " ".join(f"{value:g}" for value in row) for row in points]
    lines += ["vt " + " ".join(f"{value:g}" for value in row) for row in texture]
    lines += ["vn " + " ".join(f"{value:g}" for value in row) for row in normals]
    at, texture_at = at.reshape(-1, 3) + 1, texture_at.reshape(-1, 3) + 1
    for corners, coordinates, n in zip(
        at.tolist(), texture_at.tolist(), (normal_at.reshape(-1) + 1).tolist(), strict=True
    ):
        lines.append("f " + " ".join(f"{v}/{t}/{n}" for v, t in zip(corners, coordinates, strict=True)))
    path.write_text("\n".join(lines) + "\n", encoding="ascii")
