#!/usr/bin/env python3
"""Pictures of all cameras of the fleet; topics are listed in ``xtdrone_sim.cameras.camera_node``.

Parameters:
    ~rate (Hz, 0.1 to 50; default 0: what each vehicle's file says): pictures a second of every camera.
    ~latency (s, 0 to 10, default 0.1): simulated time from a picture's exposure to its publishing.
    ~backend (egl, tiny, default auto): what draws; auto: egl where it can be had.
    ~world (default /xtdrone/world, which the simulator sets): name or file of the world that is drawn.
    /xtdrone/fleet (as ``typhoon_h480:6``): the vehicles; ~fleet goes before it.
"""

from __future__ import annotations

import sys

from xtdrone_control.program import run_program
from xtdrone_sim.cameras.camera_node import USAGE, main

if __name__ == "__main__":
    sys.exit(run_program(main, sys.argv, USAGE))
