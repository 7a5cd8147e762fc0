#!/usr/bin/env python3
"""TF of all vehicles: ``map`` to ``VEHICLE/base_link``, and from there to every link of the URDF and optical frame.

Parameters:
    /xtdrone/fleet (e.g. ``typhoon_h480:6``): the vehicles.
    ~rate (Hz of simulated time, 1 to 50, default 30): publishing rate.
    ~frame_id (default map): frame of the vehicles' positions.
    ~body (default true): whether to publish them; false where odometry publishes VEHICLE/base_link.

Topics:
    /VEHICLE/mavros/local_position/pose (in)
    /VEHICLE/joint_states (in): gimbal and landing gear; their joints are at 0 before the first message.
    /tf, /tf_static (out)
"""

from __future__ import annotations

import sys

from xtdrone_common.programs.node_command_line import run_program
from xtdrone_sim.tf.vehicle_tf_node import main

if __name__ == "__main__":
    sys.exit(run_program(main, sys.argv, "robot_tf.py"))
