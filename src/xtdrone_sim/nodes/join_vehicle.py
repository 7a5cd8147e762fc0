#!/usr/bin/env python3
"""Add a vehicle to the running simulation; it leaves when this node ends.

Parameters:
    ~vehicle (e.g. iris_9): its name.
    ~model (default: its type): name or file of its description.
    ~pose ([x, y, z, roll, pitch, yaw], m and rad ENU; default: its place on the spawn grid): start pose.

Services (called):
    /simulator/add_vehicle, /simulator/remove_vehicle (xtdrone_msgs)
"""

from __future__ import annotations

import sys

from xtdrone_common.programs.node_command_line import run_program
from xtdrone_sim.runtime.requests.join_vehicle import main

if __name__ == "__main__":
    sys.exit(run_program(main, sys.argv, "join_vehicle.py"))
