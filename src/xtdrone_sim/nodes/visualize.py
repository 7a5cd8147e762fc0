#!/usr/bin/env python3
"""Run ``rosrun xtdrone_swarm visualize.py``, for launch files and scripts that name its former package."""

import os
import sys

if __name__ == "__main__":
    os.execvp("rosrun", ["rosrun", "xtdrone_swarm", "visualize.py", *sys.argv[1:]])
