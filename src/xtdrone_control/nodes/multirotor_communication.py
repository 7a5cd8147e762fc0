#!/usr/bin/env python3
"""XTDrone's communication node for multirotors: ``multirotor_communication.py iris 0``.

One process serves one vehicle (``0``) or several (``0-8``, ``1,3,5``, ``all``: all of that type in /xtdrone/fleet).
Topics are listed in ``xtdrone_control.communication.multirotor``; all names are absolute, so the node may be started
in any namespace.

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

from xtdrone_control import lockstep
from xtdrone_control.communication.commands import CommandSettings
from xtdrone_control.communication.multirotor import RATE, MultirotorCommunication
from xtdrone_control.programs.node_command_line import run_program, served_vehicles

USAGE = "multirotor_communication.py TYPE ID   (ID: 0, 0-8, 1,3,5 or all)"


def main(arguments: Sequence[str]) -> None:
    """Serve the vehicles that the arguments name until shutdown."""
    kind, ids, name = served_vehicles(arguments, rospy.get_param("/xtdrone/fleet", None))
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
