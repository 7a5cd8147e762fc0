#!/usr/bin/env python3
"""Filter setpoints for safety, as the last node before MAVROS: ``safety_filter.py [VEHICLE ...]``, all vehicles by
default.

Topics are listed in ``xtdrone_planning.safety.safety_node``. Start it by the launch argument ``safety:=true``, which
also sets ``/xtdrone/setpoint_namespace`` for the MAVROS layer.

Parameters:
    ~distance, ~obstacle_distance, ~cloud, ...: see ``xtdrone_planning.safety.velocity_filter.SafetySettings``.
    ~swarm_topic: topic with the positions of all vehicles (default: /xtdrone/swarm_topic); empty: each vehicle's own.
"""

import sys

from xtdrone_planning.safety.safety_node import run_safety_filter

if __name__ == "__main__":
    sys.exit(run_safety_filter())
