#!/usr/bin/env python3
"""Forward VINS-Fusion's pose to the autopilot: ``vins_transfer.py iris 0``, like upstream's program of this name.

Topics are listed in ``xtdrone_perception.slam.transfer.transfer_node``.

Parameters:
    ~topic, ~start, ~heading, ~sensor_position: see docs/settings.md.
"""

from __future__ import annotations

import sys

from xtdrone_control.vehicle_program import serve_vehicles
from xtdrone_perception.slam.transfer.transfer_node import RATE, PoseTransfer, transfer_of


def make(kind: str, ids: list[int]) -> PoseTransfer:
    """Return the node of a vehicle; multi_vins_transfer.py serves several."""
    return transfer_of(f"{kind}_{ids[0]}", "vins")


if __name__ == "__main__":
    sys.exit(serve_vehicles("vins_transfer", RATE, make, one=True))
