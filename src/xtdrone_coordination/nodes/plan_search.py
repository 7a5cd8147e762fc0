#!/usr/bin/env python3
"""Divide a region among vehicles: ``plan_search.py region.yaml --vehicles typhoon_h480:6 --out plans``.

Writes a QGroundControl .plan file for each vehicle; ``--help`` lists the options. Needs no ROS master.
"""

import sys

from xtdrone_coordination.search.planning.plans import main

if __name__ == "__main__":
    sys.exit(main())
