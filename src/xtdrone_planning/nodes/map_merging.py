#!/usr/bin/env python3
"""Merge the maps of several vehicles through relative poses: ``map_merging.py iris_uwb 0-2``.

The maps of the others join that of the first vehicle named. Topics are listed in
``xtdrone_planning.merging.merging_node``.

Parameters:
    those of ``MergingOptions``, ``LinkSettings`` and ``FitSettings`` in ``xtdrone_planning.merging.settings``, see
        docs/settings.md.
    /xtdrone/fleet (as ``iris_uwb:3``): the fleet; without it ids are not checked against a count.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

import rospy

import xtdrone_lockstep as lockstep
from xtdrone_common.programs.node_command_line import ArgumentError, run_program, served_vehicles
from xtdrone_control.vehicle_program import run_node
from xtdrone_planning.merging.merging_node import RATE, MapMergingNode, read_settings

USAGE = "map_merging.py TYPE ID   (ID: 0-2, 1,3,5 or all)"


def main(arguments: Sequence[str]) -> None:
    """Run the node for the vehicles in the arguments until shutdown."""
    kind, ids, _ = served_vehicles(arguments, rospy.get_param("/xtdrone/fleet", None))
    if len(ids) < 2:
        raise ArgumentError(f"id: {len(ids)} vehicle is not allowed, at least 2")
    lockstep.init_node("map_merging", rate=RATE)
    settings = read_settings()
    with lockstep.registering_together():
        node = MapMergingNode([f"{kind}_{index}" for index in ids], settings)
    run_node(node)


if __name__ == "__main__":
    sys.exit(run_program(main, sys.argv, USAGE))
