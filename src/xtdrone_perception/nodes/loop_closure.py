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
from collections.abc import Sequence

from xtdrone_control.programs.node_command_line import run_program
from xtdrone_perception.slam.loops.loop_closure_node import RATE, VehicleLoops, read_settings
from xtdrone_perception.slam.vehicle_program import serve_vehicle

USAGE = "loop_closure.py TYPE ID   (ID: a number, as 0)"


def main(arguments: Sequence[str]) -> None:
    """Run the node for a vehicle until shutdown."""
    serve_vehicle(arguments, "loop_closure", RATE, lambda name: VehicleLoops(name, *read_settings()))


if __name__ == "__main__":
    sys.exit(run_program(main, sys.argv, USAGE))
