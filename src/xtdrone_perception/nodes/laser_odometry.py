#!/usr/bin/env python3
"""Odometry of a vehicle by a 2D laser and a range finder: ``laser_odometry.py iris_slam_laser 0``.

One process serves one vehicle. ``xtdrone_perception.slam.laser.laser_odometry_node`` lists the topics.

Parameters:
    those of ``LaserOdometryOptions``, ``ScanMatchSettings`` and ``HealthLimits`` in
        ``xtdrone_perception.slam.laser``, see docs/settings.md.
    /xtdrone/fleet (as ``iris_slam_laser:1``): the fleet; without it ids are not checked against a count.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

import rospy

from xtdrone_control import lockstep
from xtdrone_control.programs.program import ArgumentError, run_program, served_vehicles
from xtdrone_perception.slam.laser.laser_odometry_node import LaserOdometryNode, read_settings
from xtdrone_perception.slam.odometry_node import RATE

USAGE = "laser_odometry.py TYPE ID   (ID: a number, as 0)"


def main(arguments: Sequence[str]) -> None:
    """Run the node for a vehicle until shutdown."""
    _, ids, name = served_vehicles(arguments, rospy.get_param("/xtdrone/fleet", None))
    if len(ids) != 1:
        raise ArgumentError(f"id: {len(ids)} vehicles are not allowed, one for each node")
    lockstep.init_node(f"{name}_laser_odometry", rate=RATE)
    node = LaserOdometryNode(name, *read_settings())
    try:
        lockstep.start()
        lockstep.spin(node.step)
    finally:
        node.close()


if __name__ == "__main__":
    sys.exit(run_program(main, sys.argv, USAGE))
