#!/usr/bin/env python3
"""Estimate a vehicle's odometry from a 2D laser and a range finder: ``laser_odometry.py iris_slam_laser 0``.

One process serves one vehicle. ``xtdrone_perception.slam.laser.laser_odometry_node`` lists the topics.

Parameters:
    those of ``LaserOdometryOptions``, ``ScanMatchSettings`` and ``HealthLimits`` in
        ``xtdrone_perception.slam.laser``, see docs/settings.md.
    /xtdrone/fleet (as ``iris_slam_laser:1``): the fleet; without it ids are not checked against a count.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

from xtdrone_control.programs.node_command_line import run_program
from xtdrone_perception.slam.laser.laser_odometry_node import LaserOdometryNode, read_settings
from xtdrone_perception.slam.odometry_node import RATE
from xtdrone_perception.slam.vehicle_program import serve_vehicle

USAGE = "laser_odometry.py TYPE ID   (ID: a number, as 0)"


def main(arguments: Sequence[str]) -> None:
    """Run the node for a vehicle until shutdown."""
    serve_vehicle(arguments, "laser_odometry", RATE, lambda name: LaserOdometryNode(name, *read_settings()))


if __name__ == "__main__":
    sys.exit(run_program(main, sys.argv, USAGE))
