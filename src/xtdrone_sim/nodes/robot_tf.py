#!/usr/bin/env python3
"""TF of all vehicles: ``map`` to ``VEHICLE/base_link``, and from there to every link of the URDF and optical frame.

Parameters:
    /xtdrone/fleet (as ``typhoon_h480:6``): which vehicles there are.
    ~rate (Hz of simulated time, 1 to 50, default 30): how often.
    ~frame_id (default map): frame of the vehicles' positions.

Topics:
    /VEHICLE/mavros/local_position/pose (in)
    /VEHICLE/joint_states (in): of gimbal and landing gear; until it comes, their joints are at 0.
    /tf, /tf_static (out)
"""

from __future__ import annotations

import sys

from xtdrone_control.program import run_program
from xtdrone_sim.topics.robot_tf import main

if __name__ == "__main__":
    sys.exit(run_program(main, sys.argv, "robot_tf.py"))
