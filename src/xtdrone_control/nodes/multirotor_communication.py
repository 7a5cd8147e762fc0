#!/usr/bin/env python3
"""XTDrone's communication node for multirotors: ``multirotor_communication.py iris 0``.

One process serves one vehicle (``0``) or several (``0-8``, ``1,3,5``, ``all``: all of that type in /xtdrone/fleet).
Topics are listed in ``xtdrone_control.communication.multirotor``; all names are absolute, so the node may be started
in any namespace. ``multirotor_communication.py iris 9 --wait`` waits until iris_9 has joined the simulation.

Parameters:
    ~hover_speed, ~cmd_timeout: see ``xtdrone_control.communication.commands.CommandSettings`` and docs/settings.md.
        XTDrone's ~hover_speed of 0.02 ignores the first two presses of its keyboard and stops formations short of their
        slots.
    /xtdrone/fleet (such as ``iris:9``): all vehicles; without it the upper limit of the ids is unknown.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import asdict

import rospy

import xtdrone_lockstep as lockstep
from xtdrone_common.programs.node_command_line import Served, parse_ids, run_program, served_vehicles
from xtdrone_common.programs.plain_node import FLEET_PARAMETER, wait_for_fleet
from xtdrone_control.communication.commands import CommandSettings
from xtdrone_control.communication.multirotor import RATE, MultirotorCommunication

WAIT = "--wait"
USAGE = """multirotor_communication.py TYPE ID [--wait]
  ID: 0, 0-8, 1,3,5 or all
  --wait: until the vehicles have joined the simulation"""


def vehicles_of(arguments: Sequence[str]) -> Served:
    """Return the vehicles that the arguments name; with ``--wait``, once they have joined the simulation.

    Raises:
        ArgumentError: see ``served_vehicles``; ``all`` does not tell which vehicles to wait for.
    """
    named = [argument for argument in arguments if argument != WAIT]
    if len(named) == 2 and WAIT in arguments:
        for index in parse_ids(named[1], 0, None):
            wait_for_fleet(f"{named[0]}_{index}")
    return served_vehicles(named, rospy.get_param(FLEET_PARAMETER, None))


def main(arguments: Sequence[str]) -> None:
    """Serve the vehicles that the arguments name until shutdown."""
    kind, ids, name = vehicles_of(arguments)
    lockstep.init_node(f"{name}_communication", rate=RATE)
    settings = CommandSettings.from_parameters(rospy.get_param)
    with lockstep.registering_together():
        nodes = [
            MultirotorCommunication(f"{kind}_{i}", in_lockstep=lockstep.is_active(), **asdict(settings)) for i in ids
        ]

    def step() -> None:
        for node in nodes:
            node.step()

    try:
        lockstep.start()
        lockstep.spin(step)
    finally:
        for node in nodes:
            node.close()


if __name__ == "__main__":
    sys.exit(run_program(main, sys.argv, USAGE))
