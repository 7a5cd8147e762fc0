#!/usr/bin/env python3
"""Build octree maps of everything that vehicles see: ``octomap_server.py iris_slam 0``, with the topics of
octomap_server.

One process serves one vehicle (``0``) or several (``0-5``, ``1,3``, ``all``: all of that type in /xtdrone/fleet).
Topics and services are listed in ``xtdrone_planning.octree.octomap_node``.

Parameters:
    ~odometry, ~resolution, ~memory, ~file, ...: see docs/settings.md.
    /xtdrone/fleet (as ``iris_slam:2``): the fleet.
"""

from __future__ import annotations

import sys

from xtdrone_control.vehicle_program import serve_vehicles
from xtdrone_planning.octree.octomap_node import RATE, OctomapNode


def make(kind: str, ids: list[int]) -> OctomapNode:
    """Return the node of some vehicles."""
    return OctomapNode([f"{kind}_{index}" for index in ids])


if __name__ == "__main__":
    sys.exit(serve_vehicles("octomap_server", RATE, make))
