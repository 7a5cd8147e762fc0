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

import rospy

from xtdrone_control.vehicle_program import serve_vehicles
from xtdrone_perception.gimbal_node import RATE, GimbalNode, GimbalOptions


def make(kind: str, ids: list[int]) -> GimbalNode:
    """Return the node of some vehicles."""
    return GimbalNode(kind, ids, GimbalOptions.from_parameters(rospy.get_param))


if __name__ == "__main__":
    sys.exit(serve_vehicles("gimbal_control", RATE, make))
