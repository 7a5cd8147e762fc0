#!/usr/bin/env python3
"""MAVROS's topics and services for every vehicle of the fleet, over MAVLink."""

import sys

from xtdrone_mavros.mavros_node import main

if __name__ == "__main__":
    sys.exit(main())
