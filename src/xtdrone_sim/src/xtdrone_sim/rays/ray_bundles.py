"""Kernels for bundles of neighbouring rays from one origin at one time, such as a column of a spinning lidar.

The rays of a bundle share one traversal of a tree and one pose of each object. Each ray meets the leaves that it would
meet alone, in the same order, so that its result is the same to the last bit:

- A node is skipped for the bundle only if it would be skipped for each ray: the bounds of its distances over the range
  of the rays' inverse directions hold for the rounded values too, since rounding is monotonic.
- At a leaf, each ray is tested with the leaf's box. A ray that would have skipped a parent skips the leaf as well,
  because the parent's box contains the leaf's.
- The order of the leaves depends only on the signs of the direction, which are equal within a bundle.
"""

from __future__ import annotations

import math

from xtdrone_sim.kernel import kernel
from xtdrone_sim.rays.tree import LEAST, NOTHING, ROUNDING, distance_to

MOST = 32
"""Greatest number of rays of a bundle."""
ROWS = 8
"""Rows of a bundle's array (``ROWS``, ``MOST``): direction, inverse direction, range and cosine of incidence."""

X, Y, Z, INVERSE_X, INVERSE_Y, INVERSE_Z, RANGE, COSINE = range(ROWS)
_COHERENT = 0.94  # least cosine of the angle to the first ray; a wider bundle meets too many leaves


@kernel
def gather(first, segments, shares, origins, directions, rays):
    """Fill the directions of the bundle that begins with ray ``first``; return the number of its rays.

    It is 0 if this ray is none: origin or direction are not finite, or the direction is 0.

    Args:
        first: index of a ray.
        segments, shares, origins, directions: see ``casting.cast_rays``.
        rays: (``ROWS``, ``MOST``) filled.
    """
    ox, oy, oz = origins[first, 0], origins[first, 1], origins[first, 2]
    if not math.isfinite(ox + oy + oz):
        return 0
    count = min(MOST, origins.shape[0] - first)
    for lane in range(count):
        i = first + lane
        if segments[i] != segments[first] or shares[i] != shares[first]:
            return lane
        if origins[i, 0] != ox or origins[i, 1] != oy or origins[i, 2] != oz:
            return lane
        x, y, z = directions[i, 0], directions[i, 1], directions[i, 2]
        length = math.sqrt(x**2 + y**2 + z**2)
        if not 0.0 < length < math.inf:
            return lane
        x, y, z = x / length, y / length, z / length
        if lane:
            a, b, c = rays[X, 0], rays[Y, 0], rays[Z, 0]
            if (x <= 0.0) != (a <= 0.0) or (y <= 0.0) != (b <= 0.0) or (z <= 0.0) != (c <= 0.0):
                return lane
            if x * a + y * b + z * c < _COHERENT:
                return lane
        rays[X, lane], rays[Y, lane], rays[Z, lane] = x, y, z
    return count


@kernel
def nearest_of_bundle(nodes, surfaces, root, ox, oy, oz, rays, count, found, inside, stack):
    """Find the nearest surface of a tree along each ray of a bundle; see ``tree.nearest``.

    Args:
        nodes, surfaces, root, stack: see ``tree.nearest``.
        ox, oy, oz: origin of the rays, m, in the tree's frame.
        rays: directions in the tree's frame and ranges, which are reduced; inverse directions are overwritten.
        count: number of rays.
        found: (``MOST``,) filled: index of the surface, or NOTHING.
        inside: (``MOST``,) booleans, overwritten.
    """
    x0, x1 = _invert(rays, X, count)
    y0, y1 = _invert(rays, Y, count)
    z0, z1 = _invert(rays, Z, count)
    for lane in range(count):
        found[lane] = NOTHING
    most = _farthest(rays, count)
    stack[0] = root
    waiting = 1
    while waiting:
        waiting -= 1
        number = stack[waiting]
        node = nodes[number]
        near_x, far_x = _bounds(node.low[0] - ox, node.high[0] - ox, x0, x1)
        near_y, far_y = _bounds(node.low[1] - oy, node.high[1] - oy, y0, y1)
        near_z, far_z = _bounds(node.low[2] - oz, node.high[2] - oz, z0, z1)
        near, far = max(max(near_x, near_y), near_z), min(min(far_x, far_y), far_z)
        if near > far * ROUNDING or far < 0.0 or near > most:
            continue
        if node.count:
            if _enter(node, ox, oy, oz, rays, count, inside):
                _meet(surfaces, node.second, node.second + node.count, ox, oy, oz, rays, count, found, inside)
                most = _farthest(rays, count)
            continue
        ahead = rays[node.axis, 0]
        stack[waiting], stack[waiting + 1] = node.second, number + 1
        if ahead <= 0.0:
            stack[waiting], stack[waiting + 1] = number + 1, node.second
        waiting += 2


@kernel
def _invert(rays, axis, count):
    """Fill the inverses of the directions along an axis; return the least and the greatest."""
    least, most = math.inf, -math.inf
    for lane in range(count):
        d = rays[axis, lane]
        inverse = 1.0 / (d if abs(d) > LEAST else LEAST)
        rays[INVERSE_X + axis, lane] = inverse
        least, most = min(least, inverse), max(most, inverse)
    return least, most


@kernel
def _farthest(rays, count):
    most = rays[RANGE, 0]
    for lane in range(1, count):
        most = max(most, rays[RANGE, lane])
    return most


@kernel
def _bounds(low, high, least, most):
    """Return the bounds of the distances to two planes, m off the origin, for inverse directions from least to most."""
    a, b, c, d = low * least, low * most, high * least, high * most
    return min(min(a, b), min(c, d)), max(max(a, b), max(c, d))


@kernel
def _enter(node, ox, oy, oz, rays, count, inside):
    """Fill which rays of a bundle meet the box of a node within their ranges; return whether any does."""
    low_x, low_y, low_z = node.low[0] - ox, node.low[1] - oy, node.low[2] - oz
    high_x, high_y, high_z = node.high[0] - ox, node.high[1] - oy, node.high[2] - oz
    entered = 0
    for lane in range(count):
        ix, iy, iz = rays[INVERSE_X, lane], rays[INVERSE_Y, lane], rays[INVERSE_Z, lane]
        ax, bx, ay, by, az, bz = low_x * ix, high_x * ix, low_y * iy, high_y * iy, low_z * iz, high_z * iz
        near = max(max(min(ax, bx), min(ay, by)), min(az, bz))
        far = min(min(max(ax, bx), max(ay, by)), max(az, bz))
        is_inside = not ((near > far * ROUNDING) | (far < 0.0) | (near > rays[RANGE, lane]))
        inside[lane] = is_inside
        entered += is_inside
    return entered > 0


@kernel
def _meet(surfaces, first, last, ox, oy, oz, rays, count, found, inside):
    """Intersect the rays of a bundle that are ``inside`` with the surfaces of a leaf."""
    for lane in range(count):
        if not inside[lane]:
            continue
        dx, dy, dz, best = rays[X, lane], rays[Y, lane], rays[Z, lane], rays[RANGE, lane]
        for k in range(first, last):
            t = distance_to(surfaces[k], ox, oy, oz, dx, dy, dz)
            if t < best:
                best, found[lane] = t, k
        rays[RANGE, lane] = best


@kernel
def approach(cx, cy, cz, radius, rays, count, inside):
    """Fill which rays of a bundle meet a sphere within their ranges; return whether any does.

    Args:
        cx, cy, cz: centre of the sphere, m from the origin of the rays.
        radius: m.
        rays: directions and ranges.
        count: number of rays.
        inside: (``MOST``,) booleans, filled.
    """
    square, most = cx * cx + cy * cy + cz * cz, radius * radius
    met = 0
    for lane in range(count):
        along = cx * rays[X, lane] + cy * rays[Y, lane] + cz * rays[Z, lane]
        is_met = not ((along < -radius) | (along - radius > rays[RANGE, lane]) | (square - along * along > most))
        inside[lane] = is_met
        met += is_met
    return met > 0
