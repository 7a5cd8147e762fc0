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

from xtdrone_control.vehicle_program import serve_vehicles
from xtdrone_perception.slam.laser.laser_odometry_node import LaserOdometryNode, read_settings
from xtdrone_perception.slam.odometry_node import RATE


def make(kind: str, ids: list[int]) -> LaserOdometryNode:
    """Return the node of a vehicle."""
    return LaserOdometryNode(f"{kind}_{ids[0]}", *read_settings())


if __name__ == "__main__":
    sys.exit(serve_vehicles("laser_odometry", RATE, make, one=True))
