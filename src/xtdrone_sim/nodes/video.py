#!/usr/bin/env python3
"""Videos of the cameras for ground stations: H.264 over RTP, and MAVLink's camera protocol; docs/ground-stations.md.

Parameters:
    ~host (default 127.0.0.1): the ground station's machine.
    ~port (default 0: 5600 + 540 N for instance N): UDP port of the first video, the others follow.
    ~bitrate (bit/s, default 2000000): of each video.
    ~cameras (default: the first of each vehicle): VEHICLE/CAMERA, comma-separated.
    ~sdp (folder, default none): for descriptions of the videos, which ffplay and VLC open.
    /xtdrone/fleet (e.g. ``typhoon_h480:6``): the vehicles; ~fleet overrides it.
"""

from __future__ import annotations

import sys

from xtdrone_common.programs.node_command_line import run_program
from xtdrone_sim.video.video_node import USAGE, main

if __name__ == "__main__":
    sys.exit(run_program(main, sys.argv, USAGE))
