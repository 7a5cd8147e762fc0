#!/usr/bin/env python3
"""Avoidance of all vehicles in one process: ``avoid.py iris 9 vel`` (type, number of vehicles, vel or accel).

Followers compute their own avoidance by default and use this node's if their parameter ``~avoid`` is ``topic``.

Parameters:
    ~ids (default ``all``): vehicles to compute the avoidance of, as ``3``, ``0-4`` or ``1,3``.
    ~avoid_radius (m, default 1.5).
"""

import sys

from xtdrone_coordination.follower_nodes import run_avoidance

if __name__ == "__main__":
    sys.exit(run_avoidance())
