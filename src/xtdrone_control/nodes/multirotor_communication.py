#!/usr/bin/env python3
"""XTDrone's communication node for multirotors: ``multirotor_communication.py iris 0``.

One process serves one vehicle (``0``) or several (``0-8``, ``1,3,5``, ``all``: all of that type in /xtdrone/fleet).
Topics are listed in ``xtdrone_control.communication.multirotor``; all names are absolute, so the node may be started
in any namespace.

Parameters:
    ~hover_speed (m/s, default 0.001): a velocity (or acceleration, m/s^2) not above this on any axis means HOVER.
        XTDrone's 0.02 swallows the first two presses of its keyboard, and freezes formations beside their slots.
    ~cmd_timeout (s, default 0): a velocity or acceleration that is not renewed for this long turns into HOVER;
        0 keeps the last one for ever, as XTDrone does.
    /xtdrone/fleet (as ``iris:9``): which vehicles there are; without it ids are not checked against a count.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

import rospy

from xtdrone_control import lockstep
from xtdrone_control.communication.arguments import ArgumentError, run_program, served_vehicles
from xtdrone_control.communication.core import HOVER_SPEED
from xtdrone_control.communication.multirotor import RATE, MultirotorCommunication

USAGE = "multirotor_communication.py TYPE ID   (ID: 0, 0-8, 1,3,5 or all)"


def main(arguments: Sequence[str]) -> None:
    """Serve the vehicles that the arguments name until shutdown."""
    kind, ids, name = served_vehicles(arguments, rospy.get_param("/xtdrone/fleet", None))
    lockstep.init_node(f"{name}_communication", rate=RATE)
    try:
        settings = {
            "hover_speed": float(rospy.get_param("~hover_speed", HOVER_SPEED)),
            "cmd_timeout": float(rospy.get_param("~cmd_timeout", 0.0)),
        }
        nodes = [MultirotorCommunication(f"{kind}_{i}", in_lockstep=lockstep.is_active(), **settings) for i in ids]
    except (TypeError, ValueError) as error:
        raise ArgumentError(f"parameters ~hover_speed, ~cmd_timeout: {error}") from error

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
