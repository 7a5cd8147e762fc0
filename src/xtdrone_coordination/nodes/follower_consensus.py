#!/usr/bin/env python3
"""A formation's follower with its kind of output: ``follower_consensus.py iris 1 9 vel`` (or ``accel``).

Ids and parameters as in ``follower.py``.
"""

import sys

from xtdrone_coordination.follower_nodes import run_follower

if __name__ == "__main__":
    sys.exit(run_follower(mode_argument=True))
