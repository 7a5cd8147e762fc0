#!/usr/bin/env python3
"""Carry topics of standard types to and from ROS 2 over DDS; needs no ROS 2 here. See docs/bridges.md.

Parameters:
    ~domain_id (default: ROS_DOMAIN_ID), ~interface (lo), ~to_ros2 (*), ~from_ros2 (XTDrone's commands and MAVROS's
    setpoints): see ``xtdrone_interaction.bridges.ros2.ros2_node.Ros2Settings`` and docs/settings.md.

Topics: those that match, while the other side has a subscriber. It is a plain node: the lockstep does not wait for it.
"""

import sys

from xtdrone_common.programs.node_command_line import run_program
from xtdrone_interaction.bridges.ros2.ros2_node import main

if __name__ == "__main__":
    sys.exit(run_program(main, sys.argv, "ros2_bridge.py"))
