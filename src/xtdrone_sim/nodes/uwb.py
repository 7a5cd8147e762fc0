#!/usr/bin/env python3
"""Ranges of all UWB sensors of the fleet; ``xtdrone_sim.uwb.uwb_node`` lists the topics.

Parameters:
    ~rate (Hz, 0.1 to 50; default 0: the rate in the vehicle's file): measurements per second of every sensor.
    ~world (default /xtdrone/world, set by the simulator): name or file of the world.
    /xtdrone/fleet (e.g. ``iris_uwb:6``): the vehicles; ~fleet overrides it.
"""

from __future__ import annotations

import sys

from xtdrone_common.programs.node_command_line import run_program
from xtdrone_sim.uwb.uwb_node import USAGE, main

if __name__ == "__main__":
    sys.exit(run_program(main, sys.argv, USAGE))
