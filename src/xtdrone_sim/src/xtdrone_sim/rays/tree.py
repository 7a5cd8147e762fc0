"""Trees of bounding boxes over surfaces, and the nearest surface along a ray.

A *surface* is a triangle, or the boundary of a box, a sphere or a cylinder. A tree's inner node has two children, the
first directly after it in the array; a leaf has a few surfaces. Several trees share one set of arrays: the first is
that of all static models, in the frame of the world; the others are those of moving objects, in their own frames.

Triangles are intersected from both sides as by T. Möller and B. Trumbore (Fast, minimum storage ray-triangle
intersection, Journal of Graphics Tools 2, 1997). Trees are split where the binned surface area heuristic is least
(I. Wald, On fast construction of SAH-based bounding volume hierarchies, Symposium on Interactive Ray Tracing, 2007).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from xtdrone_sim.kernel import kernel, kernel_that_allocates

TRIANGLE, BOX, SPHERE, CYLINDER = range(4)
NOTHING = -1  # as index of a surface: the ray hits none

SURFACE = np.dtype(
    [
        ("kind", "i8"),
        ("owner", "i8"),  # number of the model or vehicle that it belongs to
        ("a", "f8", 3),  # triangle: first corner, m; others: middle, m
        ("b", "f8", 3),  # triangle: from the first corner to the second; others: first row of ``turn``
        ("c", "f8", 3),  # triangle: from the first corner to the third; others: second row
        ("d", "f8", 3),  # others: third row of the rotation from the tree's frame to the shape's
        ("size", "f8", 3),  # m; half the sides of a box, radius of a sphere, radius and half the length of a cylinder
    ],
    align=True,
)

NODE = np.dtype(
    [
        ("low", "f8", 3),  # m
        ("high", "f8", 3),
        ("second", "i8"),  # second child of an inner node; first surface of a leaf
        ("count", "i8"),  # surfaces of a leaf; 0: inner node
        ("axis", "i8"),  # along which its children lie side by side
    ],
    align=True,
)

DEPTH = 96
"""Size of a ray's stack of nodes; the trees are never deeper."""

_LEAF = 4  # most surfaces of a leaf, unless they coincide
_BINS = 16
_WALK = 1.0  # cost of a node relative to that of a surface
_EDGE = 1e-9  # share by which triangles are enlarged, so that no ray passes between two
LEAST = 1e-300  # replaces 0 in a direction, whose inverse is needed
ROUNDING = 1.0 + 1e-12  # margin of boxes, so that a flat one is not missed
_MOST_SPLITS = 60  # depth below which nodes are split into halves of equal number

Array = NDArray[np.float64]


class Trees(NamedTuple):
    """Trees that share their arrays.

    Attributes:
        nodes: ``NODE``.
        surfaces: ``SURFACE``, in the order of the leaves.
    """

    nodes: NDArray[np.void]
    surfaces: NDArray[np.void]


@kernel
def _half_area(low, high):
    x, y, z = high[0] - low[0], high[1] - low[1], high[2] - low[2]
    return x * y + y * z + z * x


@kernel_that_allocates
def _best_split(low, high, order, first, last, axis, least, most):
    """Return cost and bin of the best split of ``order[first:last]`` along an axis; see ``_build``."""
    counts = np.zeros(_BINS, np.int64)
    lows, highs = np.full((_BINS, 3), np.inf), np.full((_BINS, 3), -np.inf)
    scale = _BINS / (most - least)
    for k in range(first, last):
        s = order[k]
        bin_ = min(int((0.5 * (low[s, axis] + high[s, axis]) - least) * scale), _BINS - 1)
        counts[bin_] += 1
        for i in range(3):
            lows[bin_, i] = min(lows[bin_, i], low[s, i])
            highs[bin_, i] = max(highs[bin_, i], high[s, i])
    after = np.full(_BINS, np.inf)
    box_low, box_high, count = np.full(3, np.inf), np.full(3, -np.inf), 0
    for bin_ in range(_BINS - 1, 0, -1):
        count += counts[bin_]
        for i in range(3):
            box_low[i] = min(box_low[i], lows[bin_, i])
            box_high[i] = max(box_high[i], highs[bin_, i])
        if count:
            after[bin_] = count * _half_area(box_low, box_high)
    box_low[:], box_high[:], count = np.inf, -np.inf, 0
    best, where = np.inf, 0
    for bin_ in range(1, _BINS):
        count += counts[bin_ - 1]
        for i in range(3):
            box_low[i] = min(box_low[i], lows[bin_ - 1, i])
            box_high[i] = max(box_high[i], highs[bin_ - 1, i])
        if count:
            cost = count * _half_area(box_low, box_high) + after[bin_]
            if cost < best:
                best, where = cost, bin_
    return best, where


@kernel
def _divide(low, high, order, first, last, axis, least, most, where):
    """Sort ``order[first:last]`` so that surfaces below bin ``where`` come first; return the index of the others."""
    scale = _BINS / (most - least)
    middle = first
    for k in range(first, last):
        s = order[k]
        if min(int((0.5 * (low[s, axis] + high[s, axis]) - least) * scale), _BINS - 1) < where:
            order[k] = order[middle]
            order[middle] = s
            middle += 1
    return middle


@kernel_that_allocates
def _build(low, high, nodes, order):
    """Fill ``nodes`` (2 n,) and ``order`` (n,) of a tree over boxes ``low``, ``high`` (n, 3); return the nodes' number.

    Nodes and surfaces are numbered from 0.
    """
    n = low.shape[0]
    for i in range(n):
        order[i] = i
    stack = np.empty((DEPTH, 4), np.int64)  # first, last, parent whose second child it is or -1, depth
    stack[0] = (0, n, -1, 0)
    waiting, made = 1, 0
    while waiting:
        waiting -= 1
        first, last, parent, depth = stack[waiting]
        node = nodes[made]
        if parent >= 0:
            nodes[parent].second = made
        for i in range(3):
            node.low[i], node.high[i] = np.inf, -np.inf
        least, most = np.full(3, np.inf), np.full(3, -np.inf)
        for k in range(first, last):
            for i in range(3):
                a, b = low[order[k], i], high[order[k], i]
                node.low[i], node.high[i] = min(node.low[i], a), max(node.high[i], b)
                least[i], most[i] = min(least[i], 0.5 * (a + b)), max(most[i], 0.5 * (a + b))
        axis = 0
        for i in range(1, 3):
            if most[i] - least[i] > most[axis] - least[axis]:
                axis = i
        count, spread = last - first, most[axis] - least[axis]
        middle = first
        if count > 1 and spread > 1e-9 and depth < _MOST_SPLITS:
            best, where = _best_split(low, high, order, first, last, axis, least[axis], most[axis])
            area = _half_area(node.low, node.high)
            if count > _LEAF or best + _WALK * area < count * area:
                middle = _divide(low, high, order, first, last, axis, least[axis], most[axis], where)
        elif count > 2 * _LEAF:
            middle = first + count // 2
        node.axis = axis
        if middle in (first, last):
            node.second, node.count = first, count
        else:
            node.second, node.count = 0, 0
            stack[waiting] = (middle, last, made, depth + 1)
            stack[waiting + 1] = (first, middle, -1, depth + 1)
            waiting += 2
        made += 1
    return made


def build(surfaces: NDArray[np.void]) -> Trees:
    """Return the tree of surfaces; without surfaces it has no node.

    Args:
        surfaces: (n,) ``SURFACE``.
    """
    low, high = bounds(surfaces)
    nodes, order = np.zeros(2 * len(surfaces), NODE), np.empty(len(surfaces), np.int64)
    made = int(_build(low, high, nodes, order)) if len(surfaces) else 0
    return Trees(nodes[:made].copy(), surfaces[order])


def join_trees(trees: list[Trees]) -> tuple[Trees, list[int]]:
    """Return trees in one set of arrays, and the root of each; -1 for one without nodes."""
    nodes, surfaces, roots = [], [], []
    node_count = surface_count = 0
    for tree in trees:
        moved = tree.nodes.copy()
        moved["second"] += np.where(moved["count"] > 0, surface_count, node_count)
        roots.append(node_count if len(moved) else NOTHING)
        nodes.append(moved)
        surfaces.append(tree.surfaces)
        node_count += len(moved)
        surface_count += len(tree.surfaces)
    empty = Trees(np.zeros(0, NODE), np.zeros(0, SURFACE))
    return (Trees(np.concatenate(nodes), np.concatenate(surfaces)) if trees else empty), roots


def bounds(surfaces: NDArray[np.void]) -> tuple[Array, Array]:
    """Return the lowest and the highest corners (n, 3) of the surfaces' bounding boxes, m."""
    corners = surfaces["a"][:, None, :] + np.stack([np.zeros_like(surfaces["b"]), surfaces["b"], surfaces["c"]], axis=1)
    low, high = corners.min(axis=1), corners.max(axis=1)
    solid = surfaces["kind"] != TRIANGLE
    if solid.any():
        some = surfaces[solid]
        rows = np.abs(np.stack([some["b"], some["c"], some["d"]], axis=1))
        half = some["size"].copy()
        kinds = some["kind"][:, None]
        half = np.where(kinds == SPHERE, half[:, :1], half)
        half = np.where(kinds == CYLINDER, half[:, [0, 0, 1]], half)
        reach = np.einsum("nij,ni->nj", rows, half)
        low[solid], high[solid] = some["a"] - reach, some["a"] + reach
    return low, high


# the nearest surface


@kernel
def _triangle(s, ox, oy, oz, dx, dy, dz):
    """Return the distance at which a ray hits a triangle; infinite if it does not."""
    bx, by, bz = s.b[0], s.b[1], s.b[2]
    cx, cy, cz = s.c[0], s.c[1], s.c[2]
    px, py, pz = dy * cz - dz * cy, dz * cx - dx * cz, dx * cy - dy * cx
    det = bx * px + by * py + bz * pz
    if det == 0.0:
        return math.inf
    inverse = 1.0 / det
    tx, ty, tz = ox - s.a[0], oy - s.a[1], oz - s.a[2]
    u = (tx * px + ty * py + tz * pz) * inverse
    if not -_EDGE <= u <= 1.0 + _EDGE:
        return math.inf
    qx, qy, qz = ty * bz - tz * by, tz * bx - tx * bz, tx * by - ty * bx
    v = (dx * qx + dy * qy + dz * qz) * inverse
    if not (v >= -_EDGE and u + v <= 1.0 + _EDGE):
        return math.inf
    t = (cx * qx + cy * qy + cz * qz) * inverse
    return t if t > 0.0 else math.inf


@kernel
def _rotate(s, x, y, z):
    """Return a vector of the tree's frame in a shape's frame."""
    return (
        s.b[0] * x + s.b[1] * y + s.b[2] * z,
        s.c[0] * x + s.c[1] * y + s.c[2] * z,
        s.d[0] * x + s.d[1] * y + s.d[2] * z,
    )


@kernel
def _slab(o, d, half, near, far):
    """Return near and far, narrowed to the part of a ray between two planes at ``half`` on either side of 0."""
    if d == 0.0:
        return (near, far) if abs(o) <= half else (math.inf, -math.inf)
    a, b = (-half - o) / d, (half - o) / d
    return max(near, min(a, b)), min(far, max(a, b))


@kernel
def _ahead(near, far):
    """Return the first of two distances that is ahead; infinite if the ray stays outside."""
    if near > far or far <= 0.0:
        return math.inf
    return near if near > 0.0 else far


@kernel
def _round(a, b, c):
    """Return the ends of the interval in which a t^2 + 2 b t + c <= 0, a > 0."""
    root = b * b - a * c
    if root < 0.0:
        return math.inf, -math.inf
    root = math.sqrt(root)
    return (-b - root) / a, (-b + root) / a


@kernel
def _solid(s, ox, oy, oz, dx, dy, dz):
    """Return the distance at which a ray hits a box, sphere or cylinder, from outside or inside."""
    x, y, z = _rotate(s, ox - s.a[0], oy - s.a[1], oz - s.a[2])
    u, v, w = _rotate(s, dx, dy, dz)
    if s.kind == BOX:
        near, far = _slab(x, u, s.size[0], -math.inf, math.inf)
        near, far = _slab(y, v, s.size[1], near, far)
        near, far = _slab(z, w, s.size[2], near, far)
        return _ahead(near, far)
    radius = s.size[0]
    if s.kind == SPHERE:
        near, far = _round(u * u + v * v + w * w, x * u + y * v + z * w, x * x + y * y + z * z - radius * radius)
        return _ahead(near, far)
    near, far = -math.inf, math.inf
    a = u * u + v * v
    if a > 0.0:
        near, far = _round(a, x * u + y * v, x * x + y * y - radius * radius)
    elif x * x + y * y > radius * radius:
        return math.inf
    near, far = _slab(z, w, s.size[1], near, far)
    return _ahead(near, far)


@kernel
def distance_to(s, ox, oy, oz, dx, dy, dz):
    """Return the distance at which a ray hits a surface, m; infinite if it does not."""
    return _triangle(s, ox, oy, oz, dx, dy, dz) if s.kind == TRIANGLE else _solid(s, ox, oy, oz, dx, dy, dz)


@kernel
def normal_at(s, x, y, z):
    """Return the unit normal of a surface at one of its points, in the tree's frame; that of a triangle, either one."""
    if s.kind == TRIANGLE:
        bx, by, bz = s.b[0], s.b[1], s.b[2]
        cx, cy, cz = s.c[0], s.c[1], s.c[2]
        nx, ny, nz = by * cz - bz * cy, bz * cx - bx * cz, bx * cy - by * cx
        length = math.sqrt(nx * nx + ny * ny + nz * nz)
        return (nx / length, ny / length, nz / length) if length > 0.0 else (0.0, 0.0, 0.0)
    px, py, pz = _rotate(s, x - s.a[0], y - s.a[1], z - s.a[2])
    if s.kind == SPHERE:
        return (x - s.a[0]) / s.size[0], (y - s.a[1]) / s.size[0], (z - s.a[2]) / s.size[0]
    nx, ny, nz = 0.0, 0.0, 0.0
    if s.kind == BOX:
        gx, gy, gz = abs(abs(px) - s.size[0]), abs(abs(py) - s.size[1]), abs(abs(pz) - s.size[2])
        if gx <= gy and gx <= gz:
            nx = 1.0
        elif gy <= gz:
            ny = 1.0
        else:
            nz = 1.0
    elif abs(abs(pz) - s.size[1]) < abs(math.sqrt(px * px + py * py) - s.size[0]):
        nz = 1.0
    else:
        nx, ny = px / s.size[0], py / s.size[0]
    return (
        s.b[0] * nx + s.c[0] * ny + s.d[0] * nz,
        s.b[1] * nx + s.c[1] * ny + s.d[1] * nz,
        s.b[2] * nx + s.c[2] * ny + s.d[2] * nz,
    )


@kernel
def nearest(nodes, surfaces, root, ox, oy, oz, dx, dy, dz, best, stack):
    """Return distance and index of the nearest surface of a tree along a ray.

    Args:
        nodes, surfaces: see ``Trees``.
        root: node at which the tree begins.
        ox, oy, oz: origin of the ray, m, in the tree's frame.
        dx, dy, dz: its direction, a unit vector.
        best: surfaces farther away than this are ignored, m.
        stack: (``DEPTH``,) integers, overwritten.

    Returns:
        Distance, m, and index; ``best`` and NOTHING if the ray hits none.
    """
    found = NOTHING
    ix = 1.0 / (dx if abs(dx) > LEAST else LEAST)
    iy = 1.0 / (dy if abs(dy) > LEAST else LEAST)
    iz = 1.0 / (dz if abs(dz) > LEAST else LEAST)
    stack[0] = root
    waiting = 1
    while waiting:
        waiting -= 1
        number = stack[waiting]
        node = nodes[number]
        ax, bx = (node.low[0] - ox) * ix, (node.high[0] - ox) * ix
        ay, by = (node.low[1] - oy) * iy, (node.high[1] - oy) * iy
        az, bz = (node.low[2] - oz) * iz, (node.high[2] - oz) * iz
        near = max(max(min(ax, bx), min(ay, by)), min(az, bz))
        far = min(min(max(ax, bx), max(ay, by)), max(az, bz))
        if near > far * ROUNDING or far < 0.0 or near > best:
            continue
        if node.count:
            for k in range(node.second, node.second + node.count):
                t = distance_to(surfaces[k], ox, oy, oz, dx, dy, dz)
                if t < best:
                    best, found = t, k
            continue
        ahead = dx if node.axis == 0 else (dy if node.axis == 1 else dz)
        stack[waiting], stack[waiting + 1] = node.second, number + 1
        if ahead <= 0.0:
            stack[waiting], stack[waiting + 1] = number + 1, node.second
        waiting += 2
    return best, found
