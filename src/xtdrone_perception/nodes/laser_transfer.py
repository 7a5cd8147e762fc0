#!/usr/bin/env python3
"""Forward the pose of a laser SLAM to the autopilot: ``laser_transfer.py iris 0 aloam``, like upstream's program.

SLAM is hector, cartographer (in the plane, with the height of a range finder), aloam, fastlio, or odometry, which is
any nav_msgs/Odometry on ``~topic``. Topics are listed in ``xtdrone_perception.slam.transfer.transfer_node``.

Parameters:
    ~topic, ~distance, ~distance_below, ~start, ~heading, ~sensor_position: see docs/settings.md.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

import rospy

import xtdrone_lockstep as lockstep
from xtdrone_common.programs.node_command_line import ArgumentError, run_program, served_vehicles
from xtdrone_control.vehicle_program import run_node
from xtdrone_perception.slam.transfer.transfer_node import LASERS, RATE, transfer_of

USAGE = "laser_transfer.py TYPE ID SLAM   (ID: a number, as 0)"


def main(arguments: Sequence[str]) -> None:
    """Run the node for the vehicle in the arguments until shutdown."""
    slam = arguments[-1] if arguments else ""
    if slam not in LASERS:
        raise ArgumentError(f"SLAM: {slam!r} is not allowed, {', '.join(LASERS)}")
    _, ids, name = served_vehicles(arguments[:-1], rospy.get_param("/xtdrone/fleet", None))
    if len(ids) != 1:
        raise ArgumentError(f"id: {len(ids)} vehicles are not allowed, one per node")
    lockstep.init_node(f"{name}_{slam}_laser_transfer", rate=RATE)
    run_node(transfer_of(name, slam))


if __name__ == "__main__":
    sys.exit(run_program(main, sys.argv, USAGE))
