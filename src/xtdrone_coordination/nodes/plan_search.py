#!/usr/bin/env python3
"""Divides a region among vehicles: ``plan_search.py region.yaml --vehicles typhoon_h480:6 --out plans``.

It writes a QGroundControl .plan file for each vehicle; ``--help`` lists the options. It needs no ROS master.
"""

import sys

from xtdrone_coordination.search.plans import main

if __name__ == "__main__":
    sys.exit(main())
