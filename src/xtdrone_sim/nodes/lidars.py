#!/usr/bin/env python3
"""Scans of all lidars of the fleet; ``xtdrone_sim.lidars.lidar_node`` lists the topics.

Parameters:
    ~rate (Hz, 0.1 to 50; default 0: the rate in the vehicle's file): scans per second of every lidar.
    ~latency (s, 0 to 10, default 0.04): simulated time from the end of a scan to its publication.
    ~skew (default true): whether each ray is cast at its own time.
    ~world (default /xtdrone/world, set by the simulator): name or file of the world.
    /xtdrone/fleet (e.g. ``iris_3d_lidar:6``): the vehicles; ~fleet overrides it.
"""

from __future__ import annotations

import sys

from xtdrone_common.programs.node_command_line import run_program
from xtdrone_sim.lidars.lidar_node import USAGE, main

if __name__ == "__main__":
    sys.exit(run_program(main, sys.argv, USAGE))
