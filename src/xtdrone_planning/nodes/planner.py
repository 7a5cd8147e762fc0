#!/usr/bin/env python3
"""Fly vehicles to goals around obstacles that their sensors see: ``planner.py iris_3d_lidar 0``.

One process serves one vehicle (``0``) or several (``0-5``, ``1,3``, ``all``: all of that type in /xtdrone/fleet).
Topics are listed in ``xtdrone_planning.replanning.planner_node``.

Parameters:
    ~swarm (false): coordinate trajectories with the other vehicles, through ``radio.py``.
    ~sensor (lidar or depth), and those of the planner, the map, the sensors and the trajectories, see docs/settings.md.
    /xtdrone/fleet (as ``iris_3d_lidar:6``): the fleet; without it ids are not checked against a count.
"""

from __future__ import annotations

import sys

import rospy

from xtdrone_common.programs.node_command_line import fleet_of
from xtdrone_control.vehicle_program import serve_vehicles
from xtdrone_planning.replanning.planner_node import RATE, PlannerNode


def make(kind: str, ids: list[int]) -> PlannerNode:
    """Return the node of some vehicles."""
    fleet = fleet_of(rospy.get_param("/xtdrone/fleet", None)) or ()
    return PlannerNode([f"{kind}_{index}" for index in ids], [vehicle.name for vehicle in fleet])


if __name__ == "__main__":
    sys.exit(serve_vehicles("planner", RATE, make))
