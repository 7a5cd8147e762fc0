#!/usr/bin/env python3
"""Follow a person found by the detection node: ``yolo_human_tracking.py typhoon_h480 0``.

One process serves one vehicle (``0``) or several (``0-5``, ``1,3``, ``all``: all of that type in /xtdrone/fleet).
Needs ``yolo.py`` and the communication node; topics are listed in ``xtdrone_perception.following.human_tracking_node``.

Parameters:
    those of ``xtdrone_perception.following.human_tracking_node.TrackingOptions`` and
    ``xtdrone_perception.following.person_following.FollowSettings``, see docs/settings.md.
    /xtdrone/fleet (as ``typhoon_h480:6``): the fleet; without it ids are not checked against a count.
"""

from __future__ import annotations

import sys

from xtdrone_control.vehicle_program import serve_vehicles
from xtdrone_perception.following.human_tracking_node import RATE, HumanTracking, read_options


def make(kind: str, ids: list[int]) -> list[HumanTracking]:
    """Return the nodes of some vehicles."""
    options = read_options()
    return [HumanTracking(f"{kind}_{index}", options) for index in ids]


if __name__ == "__main__":
    sys.exit(serve_vehicles("yolo_human_tracking", RATE, make))
