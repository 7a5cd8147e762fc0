#!/usr/bin/env python3
"""Hold a vehicle's gimbal at an angle and publish its camera pose: ``gimbal_control.py typhoon_h480 0``.

One process serves one vehicle (``0``) or several (``0-5``, ``1,3``, ``all``: all of that type in /xtdrone/fleet).
Topics are listed in ``xtdrone_perception.gimbal_node``.

Parameters:
    those of ``xtdrone_perception.gimbal_node.GimbalOptions``, see docs/settings.md.
    /xtdrone/fleet (as ``typhoon_h480:6``): the fleet; without it ids are not checked against a count.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

import rospy

from xtdrone_control import lockstep
from xtdrone_control.programs.node_command_line import run_program, served_vehicles
from xtdrone_perception.gimbal_node import RATE, GimbalNode, GimbalOptions

USAGE = "gimbal_control.py TYPE ID   (ID: 0, 0-5, 1,3,5 or all)"


def main(arguments: Sequence[str]) -> None:
    """Run the node for the vehicles in the arguments until shutdown."""
    kind, ids, name = served_vehicles(arguments, rospy.get_param("/xtdrone/fleet", None))
    lockstep.init_node(f"{name}_gimbal_control", rate=RATE)
    node = GimbalNode(kind, ids, GimbalOptions.from_parameters(rospy.get_param))
    lockstep.start()
    lockstep.spin(node.step)


if __name__ == "__main__":
    sys.exit(run_program(main, sys.argv, USAGE))
