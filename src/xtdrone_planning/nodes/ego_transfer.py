#!/usr/bin/env python3
"""Connect EGO-Planner with a vehicle: ``ego_transfer.py iris 0``, as upstream's program of this name.

One process serves one vehicle (``0``) or several (``0-5``, ``1,3``, ``all``: all of that type in /xtdrone/fleet).
Topics are listed in ``xtdrone_planning.replanning.ego_transfer_node``. OFFBOARD is requested by the user, as ever.

Parameters:
    ~pose, ~command: topics, see docs/settings.md.
"""

from __future__ import annotations

import sys

from xtdrone_control.vehicle_program import serve_vehicles
from xtdrone_planning.replanning.ego_transfer_node import RATE, EgoTransfer


def make(kind: str, ids: list[int]) -> list[EgoTransfer]:
    """Return the nodes of some vehicles."""
    return [EgoTransfer(f"{kind}_{index}") for index in ids]


if __name__ == "__main__":
    sys.exit(serve_vehicles("ego_transfer", RATE, make))
