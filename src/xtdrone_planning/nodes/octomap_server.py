#!/usr/bin/env python3
"""Build octree maps of everything that vehicles see: ``octomap_server.py iris_slam 0``, with the topics of
octomap_server.

One process serves one vehicle (``0``) or several (``0-5``, ``1,3``, ``all``: all of that type in /xtdrone/fleet).
Topics and services are listed in ``xtdrone_planning.octree.octomap_node``.

Parameters:
    ~odometry, ~resolution, ~memory, ~file, ...: see docs/settings.md.
    /xtdrone/fleet (as ``iris_slam:2``): the fleet.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

import rospy

from xtdrone_control import lockstep
from xtdrone_control.programs.node_command_line import run_program, served_vehicles
from xtdrone_planning.octree.octomap_node import RATE, OctomapNode

USAGE = "octomap_server.py TYPE ID   (ID: 0, 0-5, 1,3,5 or all)"


def main(arguments: Sequence[str]) -> None:
    """Run the node for the vehicles in the arguments until shutdown."""
    kind, ids, name = served_vehicles(arguments, rospy.get_param("/xtdrone/fleet", None))
    lockstep.init_node(f"{name}_octomap_server", rate=RATE)
    node = OctomapNode([f"{kind}_{index}" for index in ids])
    lockstep.start()
    try:
        lockstep.spin(node.step)
    finally:
        node.close()


if __name__ == "__main__":
    sys.exit(run_program(main, sys.argv, USAGE))
