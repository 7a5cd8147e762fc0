#!/usr/bin/env python3
"""Finds people and things in what cameras see: ``yolo.py typhoon_h480 0``.

One process serves one vehicle (``0``) or several (``0-5``, ``1,3``, ``all``: all of that type in /xtdrone/fleet).
Topics are listed in ``xtdrone_perception.yolo``.

Parameters:
    ~detector (default ``search``): a name in config/yolo, or the path of a file .yaml, with the network's files and
        settings; ~weights, ~config, ~names, ~layout, ~width, ~height, ~confidence, ~nms, ~letterbox, ~threads replace
        entries of it (``xtdrone_perception.detector.DetectorSettings``).
    ~latency (s, 0 to 10, default 0.1): simulated time from a picture to its results.
    ~workers (1 to 16, default 1): pictures of different vehicles in work at a time.
    ~camera (default ``cgo3_camera``): name of the camera's topics; ~camera_offset (m, FLU, default the typhoon's).
    ~persons (default [human, person]): classes that are put on the ground.
    ~ground (m, default 0): height of the ground in map; ~farthest (m, 1 to 10000, default 200).
    ~person, ~noise, ~tracker: mappings as in ``geolocation.Person``, ``geolocation.Noise``, ``TrackerSettings``.
    /xtdrone/fleet (as ``typhoon_h480:6``): which vehicles there are; without it ids are not checked against a count.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

import rospy

from xtdrone_control import lockstep
from xtdrone_control.communication.arguments import run_program, served_vehicles
from xtdrone_perception.yolo import RATE, YoloNode, read_detector, read_options

USAGE = "yolo.py TYPE ID   (ID: 0, 0-5, 1,3,5 or all)"


def main(arguments: Sequence[str]) -> None:
    """Serve the vehicles that the arguments name until shutdown."""
    kind, ids, name = served_vehicles(arguments, rospy.get_param("/xtdrone/fleet", None))
    lockstep.init_node(f"{name}_yolo", rate=RATE)
    node = YoloNode(kind, ids, read_detector(), read_options())
    try:
        lockstep.start()
        lockstep.spin(node.step)
    finally:
        node.close()


if __name__ == "__main__":
    sys.exit(run_program(main, sys.argv, USAGE))
