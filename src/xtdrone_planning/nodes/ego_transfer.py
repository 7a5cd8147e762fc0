#!/usr/bin/env python3
"""Connect EGO-Planner with a vehicle: ``ego_transfer.py iris 0``, as upstream's program of this name.

One process serves one vehicle (``0``) or several (``0-5``, ``1,3``, ``all``: all of that type in /xtdrone/fleet).
Topics are listed in ``xtdrone_planning.replanning.ego_transfer_node``. OFFBOARD is requested by the user, as ever.

Parameters:
    ~pose, ~command: topics, see docs/settings.md.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

import rospy

from xtdrone_control import lockstep
from xtdrone_control.programs.node_command_line import run_program, served_vehicles
from xtdrone_planning.replanning.ego_transfer_node import RATE, EgoTransfer

USAGE = "ego_transfer.py TYPE ID   (ID: 0, 0-5, 1,3,5 or all)"


def main(arguments: Sequence[str]) -> None:
    """Run the node for the vehicle in the arguments until shutdown."""
    kind, ids, name = served_vehicles(arguments, rospy.get_param("/xtdrone/fleet", None))
    lockstep.init_node(f"{name}_ego_transfer", rate=RATE)
    transfers = [EgoTransfer(f"{kind}_{index}") for index in ids]
    lockstep.start()
    lockstep.spin(lambda: _step(transfers))


def _step(transfers: Sequence[EgoTransfer]) -> None:
    for transfer in transfers:
        transfer.step()


if __name__ == "__main__":
    sys.exit(run_program(main, sys.argv, USAGE))
