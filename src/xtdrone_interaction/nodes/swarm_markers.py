#!/usr/bin/env python3
"""Markers of a swarm for rviz: names, trails, slots, topology, avoidance, detections, finds; see ``rviz/markers.py``.

Parameters:
    /xtdrone/fleet (as ``iris:9``): which vehicles there are; the first leads a formation.
    ~rate (Hz of simulated time, 0.1 to 50, default 30): how often.
    ~trail (s, 0 to 60, default 6): length of the trails.
    ~view (default none): a view, as search; what it needs is then the default of the following.
    ~scale (0.1 to 50, default 1): of letters and of lines' widths; at 1 letters are 0.4 m high, to be read from 15 m.
    ~spot (m, 0 to 50, default 0): diameter of a sphere about each vehicle, to be seen from afar; 0: none.

Topics:
    /VEHICLE/mavros/local_position/pose, /xtdrone/VEHICLE/avoid_vel, avoid_accel (in)
    /xtdrone/formation_pattern, /xtdrone/communication_topology (in)
    /xtdrone/VEHICLE/objects, /VEHICLE/cgo3_camera/camera_info, /xtdrone/search/event (in)
    /xtdrone/markers (visualization_msgs/MarkerArray, out): while somebody listens.
"""

import sys

from xtdrone_control.communication.arguments import run_program
from xtdrone_interaction.rviz.node import main

if __name__ == "__main__":
    sys.exit(run_program(main, sys.argv, "swarm_markers.py"))
