#!/usr/bin/env python3
"""Holds a vehicle's gimbal at an angle and tells where its camera is: ``gimbal_control.py typhoon_h480 0``.

One process serves one vehicle (``0``) or several (``0-5``, ``1,3``, ``all``: all of that type in /xtdrone/fleet).
Topics are listed in ``xtdrone_perception.gimbal``.

Parameters:
    ~pitch (deg, -180 to 180, default -60: down), ~roll, ~yaw (default 0): where to look, until
        /xtdrone/<vehicle>/gimbal_cmd says otherwise.
    ~source (default ``vehicle``): camera poses from what the vehicle tells of itself; ``gazebo``: true ones.
    ~camera_offset (m, FLU, default the typhoon's): of the camera from base_link, for ``vehicle``.
    ~link (default ``cgo3_camera_link``): name of the camera's link, for ``gazebo``.
    /xtdrone/fleet (as ``typhoon_h480:6``): which vehicles there are; without it ids are not checked against a count.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

import rospy

from xtdrone_control import lockstep
from xtdrone_control.communication.arguments import run_program, served_vehicles
from xtdrone_perception.gimbal import RATE, GimbalNode, read_options

USAGE = "gimbal_control.py TYPE ID   (ID: 0, 0-5, 1,3,5 or all)"


def main(arguments: Sequence[str]) -> None:
    """Serve the vehicles that the arguments name until shutdown."""
    kind, ids, name = served_vehicles(arguments, rospy.get_param("/xtdrone/fleet", None))
    lockstep.init_node(f"{name}_gimbal_control", rate=RATE)
    node = GimbalNode(kind, ids, read_options())
    lockstep.start()
    lockstep.spin(node.step)


if __name__ == "__main__":
    sys.exit(run_program(main, sys.argv, USAGE))
