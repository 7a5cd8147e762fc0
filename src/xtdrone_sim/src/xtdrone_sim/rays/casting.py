"""Kernels that cast many rays, each at its own time, at static and moving objects."""

from __future__ import annotations

import math

import numpy as np

from xtdrone_common.rotation_kernels import rotate, rotate_inverse
from xtdrone_sim.kernel import kernel, kernel_for_threads, kernel_that_allocates, kernel_that_allocates_for_threads
from xtdrone_sim.rays.ray_bundles import COSINE, MOST, RANGE, ROWS, X, Y, Z, approach, gather, nearest_of_bundle
from xtdrone_sim.rays.tree import DEPTH, NOTHING, nearest, normal_at

_FEWEST = 4  # rays that are cast as a bundle

THING = np.dtype(
    [
        ("owner", "i8"),
        ("radius", "f8"),  # m, around its origin
    ],
    align=True,
)

PLACE = np.dtype(
    [
        ("root", "i8"),  # root of its tree; NOTHING: it is absent
        ("position", "f8", 3),  # m, map
        ("q", "f8", 4),  # (w, x, y, z), to map
    ],
    align=True,
)


@kernel
def between(a, b, share):
    """Return position and unit quaternion interpolated linearly between two places (turned by well below 180 deg)."""
    x = a.position[0] + share * (b.position[0] - a.position[0])
    y = a.position[1] + share * (b.position[1] - a.position[1])
    z = a.position[2] + share * (b.position[2] - a.position[2])
    dot = a.q[0] * b.q[0] + a.q[1] * b.q[1] + a.q[2] * b.q[2] + a.q[3] * b.q[3]
    other = share if dot >= 0.0 else -share
    own = 1.0 - share
    qw, qx = own * a.q[0] + other * b.q[0], own * a.q[1] + other * b.q[1]
    qy, qz = own * a.q[2] + other * b.q[2], own * a.q[3] + other * b.q[3]
    length = math.sqrt(qw * qw + qx * qx + qy * qy + qz * qz)
    return (x, y, z), (qw / length, qx / length, qy / length, qz / length)


@kernel
def _incidence(s, x, y, z, dx, dy, dz):
    """Return the cosine of the angle between a ray and the normal where it meets a surface, 0..1."""
    nx, ny, nz = normal_at(s, x, y, z)
    return min(abs(nx * dx + ny * dy + nz * dz), 1.0)


@kernel
def _cast(nodes, surfaces, has_ground, things, before, after, share, skip, o, d, most, stack):
    """Cast one ray; see ``cast_rays``. ``before`` and ``after`` (m,) are the places of the objects around its time."""
    best, owner, cosine = most, NOTHING, 0.0
    if has_ground and d[2] < 0.0 and o[2] >= 0.0 and -o[2] / d[2] <= best:
        best, owner, cosine = -o[2] / d[2], 0, -d[2]
    if nodes.shape[0] and before.shape[0] and before[0].root != NOTHING:
        best, found = nearest(nodes, surfaces, before[0].root, o[0], o[1], o[2], d[0], d[1], d[2], best, stack)
        if found != NOTHING:
            s = surfaces[found]
            owner = s.owner
            cosine = _incidence(s, o[0] + best * d[0], o[1] + best * d[1], o[2] + best * d[2], d[0], d[1], d[2])
    for k in range(1, things.shape[0]):
        root = before[k].root
        if root == NOTHING or things[k].owner == skip:
            continue
        end = after[k] if after[k].root != NOTHING else before[k]
        cx = before[k].position[0] + share * (end.position[0] - before[k].position[0]) - o[0]
        cy = before[k].position[1] + share * (end.position[1] - before[k].position[1]) - o[1]
        cz = before[k].position[2] + share * (end.position[2] - before[k].position[2]) - o[2]
        along = cx * d[0] + cy * d[1] + cz * d[2]
        radius = things[k].radius
        if along < -radius or along - radius > best:
            continue
        if cx * cx + cy * cy + cz * cz - along * along > radius * radius:
            continue
        _, q = between(before[k], end, share)
        x, y, z = rotate_inverse(q, -cx, -cy, -cz)
        u, v, w = rotate_inverse(q, d[0], d[1], d[2])
        best, found = nearest(nodes, surfaces, root, x, y, z, u, v, w, best, stack)
        if found != NOTHING:
            owner = things[k].owner
            cosine = _incidence(surfaces[found], x + best * u, y + best * v, z + best * w, u, v, w)
    return best, owner, cosine


@kernel
def _cast_bundle(
    nodes, surfaces, has_ground, things, before, after, share, skip, o, most, rays, count, owners, found, inside,
    stack,
):  # fmt: skip
    """Cast the rays of a bundle, each as ``_cast`` would; see ``ray_bundles``.

    Args:
        rays: directions; ranges and cosines are filled.
        owners: (count,) filled.
        found, inside, stack: overwritten.
    """
    for lane in range(count):
        z = rays[Z, lane]
        rays[RANGE, lane], owners[lane], rays[COSINE, lane] = most, NOTHING, 0.0
        if has_ground and z < 0.0 and o[2] >= 0.0 and -o[2] / z <= most:
            rays[RANGE, lane], owners[lane], rays[COSINE, lane] = -o[2] / z, 0, -z
    if nodes.shape[0] and before.shape[0] and before[0].root != NOTHING:
        nearest_of_bundle(nodes, surfaces, before[0].root, o[0], o[1], o[2], rays, count, found, inside, stack)
        for lane in range(count):
            if found[lane] != NOTHING:
                s, t = surfaces[found[lane]], rays[RANGE, lane]
                dx, dy, dz = rays[X, lane], rays[Y, lane], rays[Z, lane]
                owners[lane] = s.owner
                rays[COSINE, lane] = _incidence(s, o[0] + t * dx, o[1] + t * dy, o[2] + t * dz, dx, dy, dz)
    for k in range(1, things.shape[0]):
        if before[k].root == NOTHING or things[k].owner == skip:
            continue
        end = after[k] if after[k].root != NOTHING else before[k]
        cx = before[k].position[0] + share * (end.position[0] - before[k].position[0]) - o[0]
        cy = before[k].position[1] + share * (end.position[1] - before[k].position[1]) - o[1]
        cz = before[k].position[2] + share * (end.position[2] - before[k].position[2]) - o[2]
        if not approach(cx, cy, cz, things[k].radius, rays, count, inside):
            continue
        _, q = between(before[k], end, share)
        x, y, z = rotate_inverse(q, -cx, -cy, -cz)
        for lane in range(count):
            if not inside[lane]:
                continue
            u, v, w = rotate_inverse(q, rays[X, lane], rays[Y, lane], rays[Z, lane])
            best, hit = nearest(nodes, surfaces, before[k].root, x, y, z, u, v, w, rays[RANGE, lane], stack)
            if hit != NOTHING:
                rays[RANGE, lane], owners[lane] = best, things[k].owner
                rays[COSINE, lane] = _incidence(surfaces[hit], x + best * u, y + best * v, z + best * w, u, v, w)


@kernel_that_allocates_for_threads
def cast_rays(
    nodes, surfaces, has_ground, things, places, segments, shares, skip, origins, directions, most, ranges, owners,
    cosines,
):  # fmt: skip
    """Cast rays, each at its own time.

    Args:
        nodes, surfaces: see ``tree.Trees``.
        has_ground: whether the plane z = 0, owner 0, is hit from above.
        things: (m,) ``THING``, the objects; the first contains all static models.
        places: (k, m) ``PLACE``, of the objects at k times.
        segments: (n,) number of the time before the ray's.
        shares: (n,) 0..1, fraction of the interval to the next time.
        skip: owner that the rays pass through; NOTHING: none.
        origins: (n, 3) m, map.
        directions: (n, 3), of any length.
        most: largest range, m.
        ranges: (n,) filled: distance, m; infinite without a hit; NaN if the origin or direction is not finite, or the
            direction is 0.
        owners: (n,) filled: owner of the surface that is hit, or NOTHING.
        cosines: (n,) filled: cosine of the angle between the ray and the surface's normal, 0..1.
    """
    stack, d, rays = np.empty(DEPTH, np.int64), np.empty(3), np.empty((ROWS, MOST))
    found, inside = np.empty(MOST, np.int64), np.empty(MOST, np.bool_)
    i = 0
    while i < origins.shape[0]:
        count = gather(i, segments, shares, origins, directions, rays)
        if count == 0:
            ranges[i], owners[i], cosines[i] = math.nan, NOTHING, 0.0
            i += 1
            continue
        o, first = origins[i], segments[i]
        before, after = places[first], places[min(first + 1, places.shape[0] - 1)]
        if count < _FEWEST:
            for lane in range(count):
                for k in range(3):
                    d[k] = rays[k, lane]
                rays[RANGE, lane], owners[i + lane], rays[COSINE, lane] = _cast(
                    nodes, surfaces, has_ground, things, before, after, shares[i], skip, o, d, most, stack
                )
        else:
            _cast_bundle(
                nodes, surfaces, has_ground, things, before, after, shares[i], skip, o, most, rays, count,
                owners[i : i + count], found, inside, stack,
            )  # fmt: skip
        for lane in range(count):
            cosines[i + lane] = rays[COSINE, lane]
            ranges[i + lane] = rays[RANGE, lane] if owners[i + lane] != NOTHING else math.inf
        i += count


@kernel_for_threads
def place_rays(places, segments, shares, mount, turn, local, origins, directions):
    """Fill origins and directions (n, 3) of a sensor's rays in the map.

    Args:
        places: (k,) ``PLACE`` of the sensor's link at k times.
        segments, shares: (n,) see ``cast_rays``.
        mount: (3,) m, of the sensor in its link.
        turn: (4,) (w, x, y, z), from the sensor to its link.
        local: (n, 3) directions in the sensor's frame.
        origins, directions: (n, 3) filled.
    """
    first, share = -1, math.nan
    (x, y, z), q, arm = (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
    for i in range(local.shape[0]):
        if segments[i] != first or shares[i] != share:  # a column's rays share their pose
            first, share = segments[i], shares[i]
            last = min(first + 1, places.shape[0] - 1)
            (x, y, z), q = between(places[first], places[last], share)
            arm = rotate(q, mount[0], mount[1], mount[2])
        lx, ly, lz = rotate(turn, local[i, 0], local[i, 1], local[i, 2])
        u, v, w = rotate(q, lx, ly, lz)
        origins[i, 0], origins[i, 1], origins[i, 2] = x + arm[0], y + arm[1], z + arm[2]
        directions[i, 0], directions[i, 1], directions[i, 2] = u, v, w


@kernel_that_allocates
def distance_along(nodes, surfaces, things, places, skip, position, direction, most):
    """Return the distance, m, to the nearest surface along a unit vector, the plane z = 0 excepted, and its owner.

    Args:
        nodes, surfaces, things: see ``cast_rays``.
        places: (m,) ``PLACE`` of the objects.
        skip: owner that the ray passes through; NOTHING: none.
        position: three numbers, m, map.
        direction: three numbers, map.
        most: m; returned if nothing is nearer, with NOTHING as owner.
    """
    o, d, stack = np.empty(3), np.empty(3), np.empty(DEPTH, np.int64)
    for k in range(3):
        o[k], d[k] = position[k], direction[k]
    best, owner, _ = _cast(nodes, surfaces, False, things, places, places, 0.0, skip, o, d, most, stack)
    return best, owner
