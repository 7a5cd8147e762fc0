#!/usr/bin/env python3
"""Detect people and objects in camera images: ``yolo.py typhoon_h480 0``.

One process serves one vehicle (``0``) or several (``0-5``, ``1,3``, ``all``: all of that type in /xtdrone/fleet).
Topics are listed in ``xtdrone_perception.detection.yolo_node``.

Parameters:
    ~detector (default ``search``): a name in config/yolo, or the path of a .yaml file, with the network's files and
        settings; ~weights, ~config, ~names and the settings of
        ``xtdrone_perception.detection.detector.DetectorSettings`` replace its entries.
    those of ``xtdrone_perception.detection.yolo_node.DetectionOptions`` and ``GroundOptions``, see docs/settings.md.
    ~person, ~noise, ~tracker: mappings as in ``geolocation.Person``, ``geolocation.Noise``, ``TrackerSettings``.
    /xtdrone/fleet (as ``typhoon_h480:6``): the fleet; without it ids are not checked against a count.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

import rospy

from xtdrone_control import lockstep
from xtdrone_control.programs.node_command_line import run_program, served_vehicles
from xtdrone_perception.detection.yolo_node import RATE, YoloNode, read_detector, read_options

USAGE = "yolo.py TYPE ID   (ID: 0, 0-5, 1,3,5 or all)"


def main(arguments: Sequence[str]) -> None:
    """Run the node for the vehicles in the arguments until shutdown."""
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
