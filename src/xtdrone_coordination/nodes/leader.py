#!/usr/bin/env python3
"""A formation's leader: ``leader.py iris 9`` (type, number of vehicles); it steers vehicle 0 and chooses patterns.

Parameters:
    ~class: a leader class of your own, ``file.py``, ``file.py:Class`` or ``module:Class``.
    ~patterns: a YAML file with more patterns, in the form of ``config/patterns.yaml``.
    ~cloud_folder (default empty): the folder below which clouds and fonts of patterns that are asked for may lie;
        relative names begin in it. Empty: none is read.
    ~given_patterns (default empty): patterns, with commas between, whose files are read wherever they lie.
    ~republish_rate (Hz, default 30): how often pattern and topology are said again.
    ~avoid, ~Kp_avoid, ~avoid_radius, ~min_height, ~vel_max: see ``xtdrone_coordination.leader.LeaderOptions``.
"""

import sys

from xtdrone_coordination.ros_leader import run_leader

if __name__ == "__main__":
    sys.exit(run_leader())
