"""Random points on surfaces, and exact distances of points from surfaces; both include the plane z = 0."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from xtdrone_sim.kernel import kernel
from xtdrone_sim.rays.tree import BOX, CYLINDER, SPHERE, TRIANGLE, bounds

Array = NDArray[np.float64]


def distances_from(surfaces: NDArray[np.void], points: Array, most: float) -> Array:
    """Return the distances (n,), m, of points from the nearest surface, or from the plane z = 0; at most ``most``.

    Args:
        surfaces: (m,) ``tree.SURFACE``, in the points' frame.
        points: (n, 3) m.
        most: m.
    """
    found = np.minimum(np.abs(points[:, 2]), most)
    _nearest_distances(surfaces, *bounds(surfaces), np.ascontiguousarray(points, float), found)
    return found


@kernel
def _nearest_distances(surfaces, low, high, points, found):
    """Lower ``found`` (n,) to the distances of points (n, 3) from surfaces within boxes ``low``, ``high`` (m, 3)."""
    for p in range(len(points)):
        x, y, z = points[p, 0], points[p, 1], points[p, 2]
        best = found[p]
        for k in range(len(surfaces)):
            dx = max(low[k, 0] - x, x - high[k, 0])
            dy = max(low[k, 1] - y, y - high[k, 1])
            dz = max(low[k, 2] - z, z - high[k, 2])
            if dx >= best or dy >= best or dz >= best:
                continue
            s = surfaces[k]
            distance = _from_triangle(s, x, y, z) if s.kind == TRIANGLE else _from_solid(s, x, y, z)
            best = min(best, distance)
        found[p] = best


@kernel
def _from_solid(s, x, y, z):
    """Return the distance of a point from the boundary of a box, sphere or cylinder, from outside or inside."""
    x, y, z = x - s.a[0], y - s.a[1], z - s.a[2]
    u = s.b[0] * x + s.b[1] * y + s.b[2] * z
    v = s.c[0] * x + s.c[1] * y + s.c[2] * z
    w = s.d[0] * x + s.d[1] * y + s.d[2] * z
    if s.kind == SPHERE:
        return abs(math.sqrt(u * u + v * v + w * w) - s.size[0])
    if s.kind == CYLINDER:
        across, along = math.sqrt(u * u + v * v) - s.size[0], abs(w) - s.size[1]
        if across <= 0.0 and along <= 0.0:
            return -max(across, along)
        return math.hypot(max(across, 0.0), max(along, 0.0))
    a, b, c = abs(u) - s.size[0], abs(v) - s.size[1], abs(w) - s.size[2]
    if a <= 0.0 and b <= 0.0 and c <= 0.0:
        return -max(a, b, c)
    a, b, c = max(a, 0.0), max(b, 0.0), max(c, 0.0)
    return math.sqrt(a * a + b * b + c * c)


@kernel
def _from_triangle(s, x, y, z):
    """Return the distance of a point from a triangle: from its plane, or else from the nearest edge."""
    px, py, pz = x - s.a[0], y - s.a[1], z - s.a[2]
    bx, by, bz = s.b[0], s.b[1], s.b[2]
    cx, cy, cz = s.c[0], s.c[1], s.c[2]
    bb, bc, cc = bx * bx + by * by + bz * bz, bx * cx + by * cy + bz * cz, cx * cx + cy * cy + cz * cz
    pb, pc = px * bx + py * by + pz * bz, px * cx + py * cy + pz * cz
    area = bb * cc - bc * bc
    if area > 0.0:
        u, v = (cc * pb - bc * pc) / area, (bb * pc - bc * pb) / area
        if u >= 0.0 and v >= 0.0 and u + v <= 1.0:
            nx, ny, nz = px - u * bx - v * cx, py - u * by - v * cy, pz - u * bz - v * cz
            return math.sqrt(nx * nx + ny * ny + nz * nz)
    first = _from_edge(px, py, pz, bx, by, bz)
    second = _from_edge(px, py, pz, cx, cy, cz)
    third = _from_edge(px - bx, py - by, pz - bz, cx - bx, cy - by, cz - bz)
    return min(first, min(second, third))


@kernel
def _from_edge(px, py, pz, ex, ey, ez):
    """Return the distance of a point from an edge that begins at the origin."""
    length = ex * ex + ey * ey + ez * ez
    share = 0.0 if length == 0.0 else min(1.0, max(0.0, (px * ex + py * ey + pz * ez) / length))
    dx, dy, dz = px - share * ex, py - share * ey, pz - share * ez
    return math.sqrt(dx * dx + dy * dy + dz * dz)


def points_on(surfaces: NDArray[np.void], count: int, low: Array, high: Array, seed: int) -> Array:
    """Return points on surfaces and on the plane z = 0, evenly by area, within a box.

    Args:
        surfaces: (m,) ``tree.SURFACE``.
        count: number of points drawn; those outside the box are left out.
        low, high: (3,) corners of the box, m.
        seed: seed of the draw.

    Returns:
        (n, 3) m.
    """
    least, most = bounds(surfaces)
    near = surfaces[(least <= high).all(axis=1) & (most >= low).all(axis=1)]
    rng = np.random.default_rng(seed)
    plane = float(np.prod((high - low)[:2])) if low[2] <= 0.0 <= high[2] else 0.0
    areas = np.append(_areas(near), plane)
    if not areas.sum() > 0.0:
        return np.zeros((0, 3))
    chosen = rng.choice(len(areas), count, p=areas / areas.sum())
    points = np.zeros((count, 3))
    ground = chosen == len(near)
    points[ground, :2] = rng.uniform(low[:2], high[:2], (int(ground.sum()), 2))
    drawn = near[chosen[~ground]]
    local = rng.random((len(drawn), 3))
    points[~ground] = np.where(
        (drawn["kind"] == TRIANGLE)[:, None], _on_triangle(drawn, local), _on_solid(drawn, local)
    )
    return points[(points >= low).all(axis=1) & (points <= high).all(axis=1)]


def _areas(surfaces: NDArray[np.void]) -> Array:
    """Return the areas (m,), m²."""
    a, b, c = surfaces["size"].T
    kinds = surfaces["kind"]
    triangle = 0.5 * np.linalg.norm(np.cross(surfaces["b"], surfaces["c"]), axis=1)
    box = 8.0 * (a * b + b * c + c * a)
    cylinder = 2.0 * math.pi * a * (2.0 * b + a)
    return np.select(
        [kinds == TRIANGLE, kinds == BOX, kinds == CYLINDER], [triangle, box, cylinder], 4.0 * math.pi * a**2
    )


def _on_triangle(surfaces: NDArray[np.void], random: Array) -> Array:
    root = np.sqrt(random[:, :1])
    return surfaces["a"] + root * ((1.0 - random[:, 1:2]) * surfaces["b"] + random[:, 1:2] * surfaces["c"])


def _on_solid(surfaces: NDArray[np.void], random: Array) -> Array:
    kinds = surfaces["kind"]
    local = np.where((kinds == BOX)[:, None], _on_box(surfaces["size"], random), _on_cylinder(surfaces["size"], random))
    local = np.where((kinds == SPHERE)[:, None], _on_sphere(surfaces["size"], random), local)
    turned = local[:, :1] * surfaces["b"] + local[:, 1:2] * surfaces["c"] + local[:, 2:] * surfaces["d"]
    return np.asarray(surfaces["a"] + turned)


def _on_box(half: Array, random: Array) -> Array:
    """Return points on boxes: the first number chooses the face, by its area."""
    faces = np.stack([half[:, 1] * half[:, 2], half[:, 2] * half[:, 0], half[:, 0] * half[:, 1]], axis=1)
    shares = np.cumsum(faces, axis=1) / np.maximum(faces.sum(axis=1, keepdims=True), 1e-300)
    place = 2.0 * random[:, 0]
    side = np.where(place < 1.0, -1.0, 1.0)
    axis = (place % 1.0 > shares[:, 0]).astype(int) + (place % 1.0 > shares[:, 1])
    rows = np.arange(len(half))
    local = np.zeros_like(half)
    local[rows, (axis + 1) % 3] = (2.0 * random[:, 1] - 1.0) * half[rows, (axis + 1) % 3]
    local[rows, (axis + 2) % 3] = (2.0 * random[:, 2] - 1.0) * half[rows, (axis + 2) % 3]
    local[rows, axis] = side * half[rows, axis]
    return local


def _on_cylinder(size: Array, random: Array) -> Array:
    """Return points on cylinders of radius and half length: the first number chooses side, top or bottom."""
    radius, half = size[:, 0], size[:, 1]
    mantle = 2.0 * half / np.maximum(2.0 * half + radius, 1e-300)
    on_mantle = random[:, 0] < mantle
    side = np.where(random[:, 0] < mantle + 0.5 * (1.0 - mantle), 1.0, -1.0)
    angle = 2.0 * math.pi * random[:, 1]
    across = np.where(on_mantle, radius, radius * np.sqrt(random[:, 2]))
    along = np.where(on_mantle, (2.0 * random[:, 2] - 1.0) * half, side * half)
    return np.stack([across * np.cos(angle), across * np.sin(angle), along], axis=1)


def _on_sphere(size: Array, random: Array) -> Array:
    angle, up = 2.0 * math.pi * random[:, 1], 2.0 * random[:, 2] - 1.0
    level = np.sqrt(1.0 - up * up)
    return size[:, :1] * np.stack([level * np.cos(angle), level * np.sin(angle), up], axis=1)
