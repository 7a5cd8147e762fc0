#!/usr/bin/env python3
"""Avoidance of all vehicles in one process: ``avoid.py iris 9 vel`` (type, number of vehicles, vel or accel).

Followers compute their own by default; they take this one's when their parameter ``~avoid`` is ``topic``.

Parameters:
    ~ids (default ``all``): whose avoidance to compute, as ``3``, ``0-4`` or ``1,3``.
    ~avoid_radius (m, default 1.5).
"""

import sys

from xtdrone_coordination.ros import run_avoidance

if __name__ == "__main__":
    sys.exit(run_avoidance())
