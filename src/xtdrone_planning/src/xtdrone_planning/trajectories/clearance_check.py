"""Kernels that check a finished trajectory against the map."""

from __future__ import annotations

import math

from xtdrone_planning.kernel import kernel
from xtdrone_planning.mapping.field_lookup import distance_at, is_seen
from xtdrone_planning.trajectories.splines.spline_kernels import spline_at

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
        radius: of the horizontal disc that must have been seen, m; below 0: unknown space is ignored.
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
