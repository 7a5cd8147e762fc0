"""Kernels that check a trajectory over time: its distance from other vehicles' trajectories and from the map."""

from __future__ import annotations

import math

from xtdrone_planning.kernel import kernel
from xtdrone_planning.mapping.field_lookup import distance_at, is_seen
from xtdrone_planning.trajectories.splines.spline_cost import UPRIGHT
from xtdrone_planning.trajectories.splines.spline_kernels import spline_at

_LEAST_STEP, _MOST_STEP = 0.02, 0.5  # s
_LEAST = 0.01  # m: distances stay positive, because a search leaves obstacles only through such voxels


@kernel
def first_approach(points, interval, start, others, intervals, starts, counts, distance, begin, end):
    """Return the time at which a trajectory comes closer to another than a distance; infinite if never.

    Trajectories that are closer at ``begin`` may separate, not approach further. The step is chosen so that no approach
    by more than 10 % of the distance is missed: the distance decreases at most at the sum of both speeds.

    Args:
        points: (n, 3) control points of the trajectory, m.
        interval: s between its knots.
        start: its time, s.
        others: (m, k, 3) control points of the others, padded to the maximum number k.
        intervals, starts: (m,) of the others, s.
        counts: (m,) numbers of their control points.
        distance: (m,) m.
        begin, end: of the check, s.
    """
    found = math.inf
    for j in range(len(others)):
        spline = others[j, : counts[j]]
        allowed = distance[j]
        time = begin
        while time < found:
            own, speed = _state(points, interval, time - start)
            other, others_speed = _state(spline, intervals[j], time - starts[j])
            x, y, z = own[0] - other[0], own[1] - other[1], own[2] - other[2]
            away = math.sqrt(x * x + y * y + z * z)
            if away < allowed - 1e-6:
                if time > begin:
                    found = time
                    break
                allowed = away - 0.02
            elif time > begin:
                allowed = min(distance[j], max(allowed, away - 0.02))
            if time >= end:
                break
            step = max(0.1 * distance[j], away - distance[j]) / max(speed + others_speed, 0.1)
            time = min(time + min(max(step, _LEAST_STEP), _MOST_STEP), end)
    return found


@kernel
def _state(points, interval, since):
    """Return the position at a time after the start, s, and an upper bound of the speed on that segment."""
    last = interval * (len(points) - 3)
    state = spline_at(points, interval, min(max(since, 0.0), last))
    if since < 0.0 or since > last:
        return state[0], 0.0
    speed = math.sqrt(state[1, 0] ** 2 + state[1, 1] ** 2 + state[1, 2] ** 2)
    return state[0], speed + 0.5


@kernel
def places_at(points, interval, start, times, places):
    """Store the positions of a trajectory at times (n,), s, in (n, 3)."""
    last = interval * (len(points) - 3)
    for k in range(len(times)):
        places[k] = spline_at(points, interval, min(max(times[k] - start, 0.0), last))[0]


@kernel
def shorten_near(distance, corner, resolution, places, apart, clearance):
    """Reduce the distances of a map near vehicles, in place: below ``clearance`` where one is closer than allowed.

    Args:
        distance: (nx, ny, nz) m.
        corner: (3,) index of the lowest voxel.
        resolution: side of a voxel, m.
        places: (m, 3) of the vehicles, m in map.
        apart: (m,) clearance to each, m; vertically ``1 / UPRIGHT`` times as much.
        clearance: m.
    """
    nx, ny, nz = distance.shape
    for n in range(len(places)):
        reach = math.ceil((apart[n] + 1.0) / resolution)
        up = math.ceil((apart[n] + 1.0) / UPRIGHT / resolution)
        x, y, z = places[n] / resolution - corner - 0.5
        for i in range(max(0, math.floor(x) - reach), min(nx, math.floor(x) + reach + 2)):
            for j in range(max(0, math.floor(y) - reach), min(ny, math.floor(y) + reach + 2)):
                for k in range(max(0, math.floor(z) - up), min(nz, math.floor(z) + up + 2)):
                    w = UPRIGHT * (k - z)
                    away = resolution * math.sqrt((i - x) ** 2 + (j - y) ** 2 + w * w) - apart[n] + clearance
                    distance[i, j, k] = min(distance[i, j, k], max(away, _LEAST))


CLEAR = math.inf
"""Returned for a trajectory without conflict."""


@kernel
def first_conflict(points, interval, since, distance, evidence, corner, resolution, clearance, radius, exempt):
    """Return the time at which a trajectory comes too close to an obstacle, or enters unseen space.

    Args:
        points, interval: the spline.
        since: start of the check, s after the trajectory's start.
        distance, evidence, corner, resolution: the map.
        clearance: minimum distance to an obstacle, m. A trajectory that begins closer may lead away, not approach.
        radius: Radius of the horizontal disc that must have been seen, m; below 0: unknown space is ignored.
        exempt: discs within this distance of the first point need not have been seen, m.

    Returns:
        s after the trajectory's start; infinite without a conflict.
    """
    end = interval * (len(points) - 3)
    first = spline_at(points, interval, min(since, end))[0]
    away = distance_at(distance, corner, resolution, first[0], first[1], first[2])[0]
    time = since
    while True:
        time = min(time, end)
        state = spline_at(points, interval, time)
        x, y, z = state[0, 0], state[0, 1], state[0, 2]
        now = distance_at(distance, corner, resolution, x, y, z)[0]
        if now < clearance and now < away - 0.02:
            return time
        away = min(clearance, now)
        if radius >= 0.0:
            off = (x - first[0]) ** 2 + (y - first[1]) ** 2 + (z - first[2]) ** 2
            if off > exempt * exempt and not is_seen(evidence, corner, resolution, x, y, z, radius):
                return time
        if time >= end:
            return math.inf
        speed = math.sqrt(state[1, 0] ** 2 + state[1, 1] ** 2 + state[1, 2] ** 2)
        time += min(0.1, 0.4 * resolution / max(speed, 0.1))
