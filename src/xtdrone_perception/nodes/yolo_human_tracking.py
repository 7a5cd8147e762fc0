#!/usr/bin/env python3
"""Follow a person found by the detection node: ``yolo_human_tracking.py typhoon_h480 0``.

One process serves one vehicle (``0``) or several (``0-5``, ``1,3``, ``all``: all of that type in /xtdrone/fleet).
Needs ``yolo.py`` and the communication node; topics are listed in ``xtdrone_perception.following.human_tracking_node``.

Parameters:
    those of ``xtdrone_perception.following.human_tracking_node.TrackingOptions`` and
    ``xtdrone_perception.following.person_following.FollowSettings``, see docs/settings.md.
    /xtdrone/fleet (as ``typhoon_h480:6``): the fleet; without it ids are not checked against a count.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

import rospy

from xtdrone_control import lockstep
from xtdrone_control.programs.node_command_line import run_program, served_vehicles
from xtdrone_perception.following.human_tracking_node import RATE, HumanTracking, read_options

USAGE = "yolo_human_tracking.py TYPE ID   (ID: 0, 0-5, 1,3,5 or all)"


def main(arguments: Sequence[str]) -> None:
    """Run the node for the vehicles in the arguments until shutdown."""
    kind, ids, name = served_vehicles(arguments, rospy.get_param("/xtdrone/fleet", None))
    lockstep.init_node(f"{name}_yolo_human_tracking", rate=RATE)
    options = read_options()
    nodes = [HumanTracking(f"{kind}_{index}", options) for index in ids]

    def step() -> None:
        for node in nodes:
            node.step()

    lockstep.start()
    lockstep.spin(step)


if __name__ == "__main__":
    sys.exit(run_program(main, sys.argv, USAGE))
