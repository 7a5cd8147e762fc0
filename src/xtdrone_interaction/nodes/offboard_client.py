#!/usr/bin/env python3
"""Holds every vehicle in OFFBOARD through MAVROS's topics and measures the stack's speed. See bench_client.

Parameters:
    /xtdrone/fleet (as ``iris:9``): the vehicles.
    ~window (s, default 20.0): how long is measured once all are airborne, in simulated time.
    ~height (m, default 3.0): height that is held above the ground.
    ~out (default empty): folder for events.jsonl.

Exit status: 0 after a measurement, 1 after a failed one, 2 for bad parameters.
"""

from __future__ import annotations

import sys

import rospy

from xtdrone_interaction.bench_client import main

if __name__ == "__main__":
    try:
        sys.exit(main())
    except rospy.ROSInterruptException:
        sys.exit(1)
    except rospy.ROSInitException as error:
        sys.exit(f"offboard_client: {error}")
