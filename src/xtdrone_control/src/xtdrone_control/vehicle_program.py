"""Main program of nodes that serve vehicles of one type: ``NODE.py TYPE ID``."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from typing import Any

import rospy

import xtdrone_lockstep as lockstep
from xtdrone_common.programs.node_command_line import ArgumentError, run_program, served_vehicles


def serve_vehicles(suffix: str, rate: float, make: Callable[[str, list[int]], Any], *, one: bool = False) -> int:
    """Run a node for the vehicles of the command line until shutdown; return the exit status.

    Args:
        suffix: End of the node's name: ``TYPE_ID_suffix``.
        rate: Steps per second of simulated time, Hz.
        make: Creates the node, or a list of nodes, from the vehicles' type and ids; see ``run_node``.
        one: Whether a process serves a single vehicle.
    """

    def main(arguments: Sequence[str]) -> None:
        kind, ids, name = served_vehicles(arguments, rospy.get_param("/xtdrone/fleet", None))
        if one and len(ids) != 1:
            raise ArgumentError(f"id: {len(ids)} vehicles are not allowed, one per node")
        lockstep.init_node(f"{name}_{suffix}", rate=rate)
        run_node(make(kind, ids))

    ids = "a number, as 0" if one else "0, 0-5, 1,3,5 or all"
    return run_program(main, sys.argv, f"{sys.argv[0].rsplit('/', 1)[-1]} TYPE ID   (ID: {ids})")


def run_node(node: Any) -> None:
    """Run a node, or the nodes of a list in turn, until shutdown: their ``step``, and at the end ``close``, if any."""
    nodes = node if isinstance(node, list) else [node]

    def step() -> None:
        for each in nodes:
            each.step()

    try:
        lockstep.start()
        lockstep.spin(step)
    finally:
        for each in nodes:
            if hasattr(each, "close"):
                each.close()
