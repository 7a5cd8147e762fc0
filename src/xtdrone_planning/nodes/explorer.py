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

import rospy

from xtdrone_common.programs.node_command_line import fleet_of
from xtdrone_control.vehicle_program import serve_vehicles
from xtdrone_planning.exploration.explorer_node import RATE, ExplorerNode


def make(kind: str, ids: list[int]) -> ExplorerNode:
    """Return the node of some vehicles."""
    fleet = fleet_of(rospy.get_param("/xtdrone/fleet", None)) or ()
    return ExplorerNode([f"{kind}_{index}" for index in ids], [vehicle.name for vehicle in fleet])


if __name__ == "__main__":
    sys.exit(serve_vehicles("explorer", RATE, make))
