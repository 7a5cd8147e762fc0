#!/usr/bin/env python3
"""Measures how fast a formation flight can be simulated. See xtdrone_interaction.speed_probe.

Parameters:
    ~plan: JSON file that says what to measure.
    ~out: folder for events.jsonl.

Exit status: 0 after a measurement, 1 after a failed one.
"""

from __future__ import annotations

import sys

import rospy

from xtdrone_interaction.speed_probe import main

if __name__ == "__main__":
    try:
        sys.exit(main())
    except rospy.ROSInterruptException:
        sys.exit(1)
