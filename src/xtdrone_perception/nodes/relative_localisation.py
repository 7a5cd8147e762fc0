#!/usr/bin/env python3
"""Estimate the positions of the other vehicles from ranges and odometry: ``relative_localisation.py iris_uwb 0 5``.

One process serves one vehicle (``0``) or several (``0-4``, ``1,3``, ``all``).
Topics are listed in ``xtdrone_perception.localisation.relative_node``.

Parameters:
    those of ``xtdrone_perception.localisation.relative_node.RelativeOptions`` and
        ``xtdrone_perception.localisation.relative_filter.FilterSettings``, see docs/settings.md.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

import rospy

import xtdrone_lockstep as lockstep
from xtdrone_common.programs.node_command_line import ArgumentError, parse_count, parse_ids, run_program
from xtdrone_control.vehicle_program import run_node
from xtdrone_perception.localisation.relative_filter import FilterSettings
from xtdrone_perception.localisation.relative_node import RATE, RelativeLocalisationNode, RelativeOptions

USAGE = "relative_localisation.py TYPE ID NUM   (ID: 0, 0-4, 1,3 or all)"


def main(arguments: Sequence[str]) -> None:
    """Run the node for the vehicles in the arguments until shutdown."""
    if len(arguments) != 3:
        raise ArgumentError(f"3 arguments are needed, {len(arguments)} were given")
    kind, text, number = arguments
    count = parse_count(number)
    ids = parse_ids(text, 0, count - 1)
    name = f"relative_localisation_{ids[0]}" if len(ids) == 1 else f"relative_localisation_{ids[0]}_{ids[-1]}"
    lockstep.init_node(name, rate=RATE)
    options = RelativeOptions.from_parameters(rospy.get_param)
    with lockstep.registering_together():
        node = RelativeLocalisationNode(kind, ids, count, options, FilterSettings.from_parameters(rospy.get_param))
    run_node(node)


if __name__ == "__main__":
    sys.exit(run_program(main, sys.argv, USAGE))
