#!/usr/bin/env python3
"""Forward the poses of several VINS-Fusions to the autopilots: ``multi_vins_transfer.py iris 4``, like upstream's
program.

Vehicle ``T``'s VINS-Fusion runs in the namespace ``/T``. Topics are listed in
``xtdrone_perception.slam.transfer.transfer_node``.

Parameters:
    ~starts: list of x, y, z for each vehicle, m in map: start position of its VINS-Fusion, ``[[0, 0, 0], [0, 3, 0]]``.
    ~heading, ~sensor_position: see docs/settings.md.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import replace

import rospy

import xtdrone_lockstep as lockstep
from xtdrone_common.programs.node_command_line import ArgumentError, parse_count, run_program
from xtdrone_control.vehicle_program import run_node
from xtdrone_perception.slam.transfer.foreign_pose import PlaceSettings, read_starts
from xtdrone_perception.slam.transfer.transfer_node import RATE, SOURCES, ForeignOptions, PoseTransfer

USAGE = "multi_vins_transfer.py TYPE NUM   (NUM: number of vehicles)"
_ARGUMENTS = 2


def main(arguments: Sequence[str]) -> None:
    """Run the node for the vehicles in the arguments until shutdown."""
    if len(arguments) != _ARGUMENTS:
        raise ArgumentError(f"{_ARGUMENTS} arguments are needed, {len(arguments)} were given")
    kind, count = arguments[0], parse_count(arguments[1])
    lockstep.init_node(f"{kind}_vins_transfer", rate=RATE)
    place = PlaceSettings.from_parameters(rospy.get_param)
    starts = read_starts(rospy.get_param("~starts", [list(place.start)] * count), count)
    transfers = [
        PoseTransfer(f"{kind}_{n}", SOURCES["multi_vins"], ForeignOptions(), replace(place, start=start))
        for n, start in enumerate(starts)
    ]
    run_node(transfers)


if __name__ == "__main__":
    sys.exit(run_program(main, sys.argv, USAGE))
