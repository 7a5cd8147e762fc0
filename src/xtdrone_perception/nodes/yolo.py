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

from xtdrone_control.vehicle_program import serve_vehicles
from xtdrone_perception.detection.yolo_node import RATE, YoloNode, read_detector, read_options


def make(kind: str, ids: list[int]) -> YoloNode:
    """Return the node of some vehicles."""
    return YoloNode(kind, ids, read_detector(), read_options())


if __name__ == "__main__":
    sys.exit(serve_vehicles("yolo", RATE, make))
