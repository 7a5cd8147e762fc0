"""The rest of a path, given to others: contiguous parts, so long that all are finished at about the same time."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import pairwise

from .coverage import Point, Waypoint

_LEAST = 10.0  # m; a shorter part is not worth the way there


def share_out(
    rest: Sequence[Waypoint], ends: Mapping[str, Point], loads: Mapping[str, float]
) -> dict[str, list[Waypoint]]:
    """Return who flies which part of a path.

    Args:
        rest: the path, at least two waypoints.
        ends: where those who can take over end what they have to fly already, m ENU.
        loads: how far they have still to fly, m.

    Returns:
        Parts of the path by name, in its order, for those who get one. Where the path is cut, one part ends and the
        next begins, looking along it.
    """
    whole = sum(_leg(a, b) for a, b in pairwise(rest))
    portions = _portions(whole, loads)
    parts: dict[str, list[Waypoint]] = {}
    left = list(rest)
    while portions:
        start = (left[0].x, left[0].y)
        name = min(portions, key=lambda n: (math.dist(ends[n], start), n))
        portion = portions.pop(name)
        parts[name], left = cut(left, portion) if portions else (left, [])
    return parts


def cut(path: Sequence[Waypoint], at: float) -> tuple[list[Waypoint], list[Waypoint]]:
    """Return the first ``at`` m of a path, and what is left of it."""
    first = [path[0]]
    for i, (a, b) in enumerate(pairwise(path), 1):
        leg = _leg(a, b)
        if at <= leg and leg > 0.0:
            share = at / leg
            place = Waypoint(a.x + share * (b.x - a.x), a.y + share * (b.y - a.y), b.heading)
            return [*first, place], [place, *path[i:]]
        at -= leg
        first.append(b)
    return first, [path[-1]]


def _leg(a: Waypoint, b: Waypoint) -> float:
    return math.dist((a.x, a.y), (b.x, b.y))


def _portions(whole: float, loads: Mapping[str, float]) -> dict[str, float]:
    """Return lengths that bring all loads to one level, leaving out whom it would bring too little."""
    names = sorted(loads, key=lambda name: (loads[name], name))
    while names:
        level = (whole + sum(loads[name] for name in names)) / len(names)
        if len(names) == 1 or level - loads[names[-1]] >= _LEAST:
            return {name: level - loads[name] for name in names}
        names.pop()  # has so much to fly that there is nothing for it
    return {}
