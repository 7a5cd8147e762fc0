#!/usr/bin/env python3
"""Publish the plan of the world between two heights, latched on ``/map`` and ``/map_metadata``, as map_server does.

Parameters:
    ~bounds, ~cell, ~low, ~high, ~step: extent, resolution and heights of the plan, see docs/settings.md.
    ~world (default /xtdrone/world, set by the simulator): name or file of the world.
"""

from __future__ import annotations

import sys

from xtdrone_common.programs.node_command_line import run_program
from xtdrone_sim.topics.world_map import USAGE, main

if __name__ == "__main__":
    sys.exit(run_program(main, sys.argv, USAGE))
