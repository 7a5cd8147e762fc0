#!/usr/bin/env python3
"""Close loops on top of lidar odometry: ``loop_closure.py iris_slam 0``.

One process serves one vehicle. ``xtdrone_perception.slam.loops.loop_closure_node`` lists the topics.

Parameters:
    those of ``LoopOptions`` and ``LoopNodeOptions`` in ``xtdrone_perception.slam.loops``, see
        docs/settings.md.
    /xtdrone/fleet (as ``iris_slam:1``): the fleet; without it ids are not checked against a count.
"""

from __future__ import annotations

import sys

from xtdrone_control.vehicle_program import serve_vehicles
from xtdrone_perception.slam.loops.loop_closure_node import RATE, VehicleLoops, read_settings


def make(kind: str, ids: list[int]) -> VehicleLoops:
    """Return the node of a vehicle."""
    return VehicleLoops(f"{kind}_{ids[0]}", *read_settings())


if __name__ == "__main__":
    sys.exit(serve_vehicles("loop_closure", RATE, make, one=True))
