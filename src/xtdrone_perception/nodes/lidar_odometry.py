#!/usr/bin/env python3
"""Estimate a vehicle's odometry from its 3D lidar: ``lidar_odometry.py iris_slam 0``.

One process serves one vehicle. ``xtdrone_perception.slam.lidar_odometry_node`` lists the topics.

Parameters:
    those of ``LidarOdometryOptions``, ``RegistrationOptions`` and ``LidarHealthLimits`` in ``xtdrone_perception.slam``,
        see docs/settings.md.
    /xtdrone/fleet (as ``iris_slam:1``): the fleet; without it ids are not checked against a count.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

from xtdrone_control.programs.node_command_line import run_program
from xtdrone_perception.slam.lidar_odometry_node import LidarOdometryNode, read_settings
from xtdrone_perception.slam.odometry_node import RATE
from xtdrone_perception.slam.vehicle_program import serve_vehicle

USAGE = "lidar_odometry.py TYPE ID   (ID: a number, as 0)"


def main(arguments: Sequence[str]) -> None:
    """Run the node for a vehicle until shutdown."""
    serve_vehicle(arguments, "lidar_odometry", RATE, lambda name: LidarOdometryNode(name, *read_settings()))


if __name__ == "__main__":
    sys.exit(run_program(main, sys.argv, USAGE))
