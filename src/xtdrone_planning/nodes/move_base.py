#!/usr/bin/env python3
"""Navigate vehicles in the plane, with the topics of ROS's move_base: ``move_base.py iris_2d_lidar 0``, ``ugv 0``.

One process serves one vehicle (``0``) or several (``0-5``, ``1,3``). UAVs fly at a fixed height; a type that is not in
/xtdrone/fleet is treated as a ground robot. Topics are listed in ``xtdrone_planning.navigation.navigation_node``.

Parameters:
    ~drive, ~scan_topic, ~map_topic and those of map, motion and decisions, see docs/settings.md.
    /xtdrone/fleet (as ``iris_2d_lidar:1``): the fleet; ids of UAVs are checked against it.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

import rospy

import xtdrone_lockstep as lockstep
from xtdrone_common.programs.node_command_line import fleet_of, parse_ids, run_program, served_vehicles
from xtdrone_control.vehicle_program import run_node
from xtdrone_planning.navigation.navigation_node import RATE, NavigationNode

USAGE = "move_base.py TYPE ID   (ID: 0, 0-5, 1,3,5 or all)"


def main(arguments: Sequence[str]) -> None:
    """Run the node for the vehicles in the arguments until shutdown."""
    names, are_robots = _served(arguments, rospy.get_param("/xtdrone/fleet", None))
    lockstep.init_node(f"{names[0]}_move_base", rate=RATE)
    run_node(NavigationNode(names, are_robots=are_robots))


def _served(arguments: Sequence[str], fleet: str | None) -> tuple[list[str], bool]:
    """Return the vehicles' names, and whether they are ground robots (their type is not in the fleet).

    Raises:
        ArgumentError: see ``served_vehicles``; ``all`` is not allowed for robots.
    """
    vehicles = fleet_of(fleet)
    if len(arguments) == 2 and vehicles and arguments[0] not in {vehicle.type for vehicle in vehicles}:
        return [f"{arguments[0]}_{index}" for index in parse_ids(arguments[1], 0, None)], True
    kind, ids, _ = served_vehicles(arguments, fleet)
    return [f"{kind}_{index}" for index in ids], False


if __name__ == "__main__":
    sys.exit(run_program(main, sys.argv, USAGE))
