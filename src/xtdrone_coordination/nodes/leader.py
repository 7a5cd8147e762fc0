#!/usr/bin/env python3
"""A formation's leader: ``leader.py iris 9`` (type, number of vehicles); steers vehicle 0 and chooses patterns.

Parameters:
    ~class: a leader class of your own, ``file.py``, ``file.py:Class`` or ``module:Class``.
    ~patterns: a YAML file with more patterns, in the form of ``config/patterns.yaml``.
    ~cloud_folder (default empty): folder that must contain the files of clouds and fonts of requested patterns;
        relative paths start in it. Empty: no file is read.
    ~given_patterns (default empty): patterns, separated by commas, exempt from this restriction.
    ~republish_rate (Hz, default 30): repetition of pattern and topology.
    ~avoid, ~Kp_avoid, ~avoid_radius, ~min_height, ~vel_max: see ``xtdrone_coordination.leader.LeaderOptions``.
"""

import sys

from xtdrone_coordination.leader_node import run_leader

if __name__ == "__main__":
    sys.exit(run_leader())
