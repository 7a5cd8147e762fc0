#!/usr/bin/env python3
"""Publish markers for rviz: of a swarm (names, trails, slots, topology, avoidance, detections, finds; see
``rviz/markers.py``) and of the world's models and people (``rviz/world_markers.py``).

Parameters:
    /xtdrone/fleet (as ``iris:9``): all vehicles; the first leads a formation.
    /xtdrone/world: name or file of the world; none: only the swarm is shown.
    ~view (default none): a view, e.g. search, that sets the defaults of the following parameters.
    ~rate, ~trail, ~scale, ~spot: see ``xtdrone_interaction.rviz.markers_node.MarkerSettings`` and docs/settings.md.

Topics:
    /VEHICLE/mavros/local_position/pose, /xtdrone/VEHICLE/avoid_vel, avoid_accel (in)
    /xtdrone/formation_pattern, /xtdrone/communication_topology (in)
    /xtdrone/VEHICLE/objects, /VEHICLE/cgo3_camera/camera_info, of vehicles with that camera (in)
    /xtdrone/search/event, /gazebo/model_states, /xtdrone/models (in)
    /xtdrone/markers (visualization_msgs/MarkerArray, out): while there are subscribers.
"""

import sys

from xtdrone_common.programs.node_command_line import run_program
from xtdrone_interaction.rviz.markers_node import main

if __name__ == "__main__":
    sys.exit(run_program(main, sys.argv, "swarm_markers.py"))
