#!/usr/bin/env python3
"""Odometry of a vehicle by its 3D lidar: ``lidar_odometry.py iris_slam 0``.

One process serves one vehicle. ``xtdrone_perception.slam.lidar_odometry_node`` lists the topics.

Parameters:
    those of ``LidarOdometryOptions``, ``RegistrationOptions`` and ``HealthLimits`` in ``xtdrone_perception.slam``, see
        docs/settings.md.
    /xtdrone/fleet (as ``iris_slam:1``): the fleet; without it ids are not checked against a count.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

import rospy

from xtdrone_control import lockstep
from xtdrone_control.programs.program import ArgumentError, run_program, served_vehicles
from xtdrone_perception.slam.lidar_odometry_node import RATE, VehicleOdometry, read_settings

USAGE = "lidar_odometry.py TYPE ID   (ID: a number, as 0)"


def main(arguments: Sequence[str]) -> None:
    """Run the node for a vehicle until shutdown."""
    _, ids, name = served_vehicles(arguments, rospy.get_param("/xtdrone/fleet", None))
    if len(ids) != 1:
        raise ArgumentError(f"id: {len(ids)} vehicles are not allowed, one for each node")
    lockstep.init_node(f"{name}_lidar_odometry", rate=RATE)
    node = VehicleOdometry(name, *read_settings())
    try:
        lockstep.start()
        lockstep.spin(node.step)
    finally:
        node.close()


if __name__ == "__main__":
    sys.exit(run_program(main, sys.argv, USAGE))
