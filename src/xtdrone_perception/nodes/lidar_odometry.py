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

from xtdrone_control.vehicle_program import serve_vehicles
from xtdrone_perception.slam.lidar_odometry_node import LidarOdometryNode, read_settings
from xtdrone_perception.slam.odometry_node import RATE


def make(kind: str, ids: list[int]) -> LidarOdometryNode:
    """Return the node of a vehicle."""
    return LidarOdometryNode(f"{kind}_{ids[0]}", *read_settings())


if __name__ == "__main__":
    sys.exit(serve_vehicles("lidar_odometry", RATE, make, one=True))
