#!/usr/bin/env python3
"""Forward VINS-Fusion's pose to the autopilot: ``vins_transfer.py iris 0``, like upstream's program of this name.

Topics are listed in ``xtdrone_perception.slam.transfer.transfer_node``.

Parameters:
    ~topic, ~start, ~heading, ~sensor_position: see docs/settings.md.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

import rospy

from xtdrone_control import lockstep
from xtdrone_control.programs.node_command_line import ArgumentError, run_program, served_vehicles
from xtdrone_perception.slam.transfer.transfer_node import RATE, transfer_of

USAGE = "vins_transfer.py TYPE ID   (ID: a number, as 0)"


def main(arguments: Sequence[str]) -> None:
    """Run the node for the vehicle in the arguments until shutdown."""
    _, ids, name = served_vehicles(arguments, rospy.get_param("/xtdrone/fleet", None))
    if len(ids) != 1:
        raise ArgumentError(f"id: {len(ids)} vehicles are not allowed; multi_vins_transfer.py serves several")
    lockstep.init_node(f"{name}_vins_transfer", rate=RATE)
    transfer = transfer_of(name, "vins")
    lockstep.start()
    lockstep.spin(transfer.step)


if __name__ == "__main__":
    sys.exit(run_program(main, sys.argv, USAGE))
