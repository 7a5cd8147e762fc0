#!/usr/bin/env python3
"""Measures how fast the cooperative search is simulated. See xtdrone_interaction.search_probe.

Parameters:
    /xtdrone/fleet (as ``typhoon_h480:6``): the vehicles.
    ~window (s, above 0): how long is measured once all search, in simulated time.
    ~out: folder for events.jsonl.

Exit status: 0 after a measurement, 1 after a failed one, 2 for bad parameters.
"""

from __future__ import annotations

import sys

import rospy

from xtdrone_interaction.search_probe import main

if __name__ == "__main__":
    try:
        sys.exit(main())
    except rospy.ROSInterruptException:
        sys.exit(1)
    except rospy.ROSInitException as error:
        sys.exit(f"search_probe: {error}")
