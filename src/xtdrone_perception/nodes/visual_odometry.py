#!/usr/bin/env python3
"""Estimate a vehicle's odometry from a depth camera or a stereo pair: ``visual_odometry.py iris_slam_rgbd 0``.

One process serves one vehicle. ``xtdrone_perception.slam.visual.visual_odometry_node`` lists the topics.

Parameters:
    those of ``VisualOdometryOptions``, ``TrackSettings``, ``NoiseSettings``, ``KeyframeSettings`` and
        ``VisualHealthLimits`` in ``xtdrone_perception.slam.visual``, see docs/settings.md.
    /xtdrone/fleet (as ``iris_slam_rgbd:1``): the fleet; without it ids are not checked against a count.
"""

from __future__ import annotations

import sys

from xtdrone_control.vehicle_program import serve_vehicles
from xtdrone_perception.slam.odometry_node import RATE
from xtdrone_perception.slam.visual.visual_odometry_node import VisualOdometryNode, read_settings


def make(kind: str, ids: list[int]) -> VisualOdometryNode:
    """Return the node of a vehicle."""
    return VisualOdometryNode(f"{kind}_{ids[0]}", *read_settings())


if __name__ == "__main__":
    sys.exit(serve_vehicles("visual_odometry", RATE, make, one=True))
