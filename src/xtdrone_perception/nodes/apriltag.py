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
from collections.abc import Sequence

import rospy

from xtdrone_control import lockstep
from xtdrone_control.programs.node_command_line import run_program, served_vehicles
from xtdrone_perception.tags.apriltag_node import RATE, AprilTagNode, AprilTagOptions
from xtdrone_perception.tags.tag_detector import TagDetectorSettings

USAGE = "apriltag.py TYPE ID   (ID: 0, 0-5, 1,3,5 or all)"


def main(arguments: Sequence[str]) -> None:
    """Run the node for the vehicles in the arguments until shutdown."""
    kind, ids, name = served_vehicles(arguments, rospy.get_param("/xtdrone/fleet", None))
    lockstep.init_node(f"{name}_apriltag", rate=RATE)
    options = AprilTagOptions.from_parameters(rospy.get_param)
    node = AprilTagNode(kind, ids, options, TagDetectorSettings.from_parameters(rospy.get_param))
    try:
        lockstep.start()
        lockstep.spin(node.step)
    finally:
        node.close()


if __name__ == "__main__":
    sys.exit(run_program(main, sys.argv, USAGE))
