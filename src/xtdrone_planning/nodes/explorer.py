#!/usr/bin/env python3
"""Explore a floor with vehicles that planners fly: ``explorer.py iris_3d_lidar all``.

One process serves one vehicle (``0``) or several (``0-5``, ``1,3``, ``all``: all of that type in /xtdrone/fleet), which
share the floor with all of the fleet. Topics are listed in ``xtdrone_planning.exploration.explorer_node``.

Parameters:
    ~bounds and those of ``ExplorationSettings``, see docs/settings.md; equal for all vehicles.
    /xtdrone/fleet (as ``iris_3d_lidar:2``): the fleet.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

import rospy

from xtdrone_control import lockstep
from xtdrone_control.programs.node_command_line import fleet_of, run_program, served_vehicles
from xtdrone_planning.exploration.explorer_node import RATE, ExplorerNode

USAGE = "explorer.py TYPE ID   (ID: 0, 0-5, 1,3,5 or all)"


def main(arguments: Sequence[str]) -> None:
    """Run the node for the vehicles in the arguments until shutdown."""
    kind, ids, name = served_vehicles(arguments, rospy.get_param("/xtdrone/fleet", None))
    lockstep.init_node(f"{name}_explorer", rate=RATE)
    fleet = fleet_of(rospy.get_param("/xtdrone/fleet", None)) or ()
    node = ExplorerNode([f"{kind}_{index}" for index in ids], [vehicle.name for vehicle in fleet])
    lockstep.start()
    lockstep.spin(node.step)


if __name__ == "__main__":
    sys.exit(run_program(main, sys.argv, USAGE))
