#!/usr/bin/env python3
"""Images of all cameras of the fleet; ``xtdrone_sim.cameras.camera_node`` lists the topics.

Parameters:
    ~rate (Hz, 0.1 to 50; default 0: the rate in the vehicle's file): images per second of every camera.
    ~latency (s, 0 to 10, default 0.1): simulated time from exposure to publication.
    ~backend (egl, tiny, default auto): OpenGL implementation of the renderer; auto: egl if available.
    ~shadows (default false): shadows of the sun, by rays, unless the world's light has none.
    ~world (default /xtdrone/world, set by the simulator): name or file of the world to draw.
    /xtdrone/fleet (e.g. ``typhoon_h480:6``): the vehicles; ~fleet overrides it.
"""

from __future__ import annotations

import sys

from xtdrone_common.programs.node_command_line import run_program
from xtdrone_sim.cameras.camera_node import USAGE, main

if __name__ == "__main__":
    sys.exit(run_program(main, sys.argv, USAGE))
