#!/usr/bin/env python3
"""Detect AprilTags in camera images and send the landing target to the autopilot: ``apriltag.py iris_downward_camera
0``.

One process serves one vehicle (``0``) or several (``0-5``, ``1,3``, ``all``: all of that type in /xtdrone/fleet).
Topics are listed in ``xtdrone_perception.tags.apriltag_node``.

Parameters:
    those of ``xtdrone_perception.tags.apriltag_node.AprilTagOptions`` and
        ``xtdrone_perception.tags.tag_detector.TagDetectorSettings``, see docs/settings.md.
    /xtdrone/fleet (as ``iris_downward_camera:6``): the fleet; without it ids are not checked against a count.
"""

from __future__ import annotations

import sys

import rospy

from xtdrone_control.vehicle_program import serve_vehicles
from xtdrone_perception.tags.apriltag_node import RATE, AprilTagNode, AprilTagOptions
from xtdrone_perception.tags.tag_detector import TagDetectorSettings


def make(kind: str, ids: list[int]) -> AprilTagNode:
    """Return the node of some vehicles."""
    options = AprilTagOptions.from_parameters(rospy.get_param)
    return AprilTagNode(kind, ids, options, TagDetectorSettings.from_parameters(rospy.get_param))


if __name__ == "__main__":
    sys.exit(serve_vehicles("apriltag", RATE, make))
