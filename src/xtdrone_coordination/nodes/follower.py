#!/usr/bin/env python3
"""A formation's follower: ``follower.py iris 1 9`` (type, id, number of vehicles).

One process runs one follower (``1``) or several (``1-8``, ``1,3``, ``all``).

Parameters:
    ~class: a follower class of your own, ``file.py``, ``file.py:Class`` or ``module:Class``.
    ~mode, ~Kp, ~raw_weights, ~vel_max, ~accel_max, ~avoid, ~Kp_avoid, ~avoid_radius, ~clearance, ~pose_timeout: see
        ``xtdrone_coordination.follower.FollowerOptions``.
"""

import sys

from xtdrone_coordination.follower_nodes import run_follower

if __name__ == "__main__":
    sys.exit(run_follower())
