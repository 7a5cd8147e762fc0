#!/usr/bin/env python3
"""Land a UAV on a moving ground robot: ``landing_director.py iris_landing_camera_0``.

Topics: see ``missions.landing.director``; parameters: ``LandingSettings`` there, see docs/settings.md.

Exit status: 0 after a landing on the tags, 1 after a landing elsewhere, 2 for invalid values.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

import rospy

from xtdrone_common.programs.node_command_line import ArgumentError, run_program
from xtdrone_common.programs.under_roslaunch import end_launch
from xtdrone_control.drone.script_node import connect
from xtdrone_interaction.missions.landing.director import LandingDirector, LandingSettings, direct

USAGE = "landing_director.py VEHICLE   (as iris_landing_camera_0)"


def main(arguments: Sequence[str]) -> None:
    """Land, end the launch, and exit."""
    if len(arguments) != 1:
        raise ArgumentError(f"arguments: {list(arguments)} are not allowed, one vehicle")
    with connect(arguments[0], node="landing_director") as drone:
        director = LandingDirector(arguments[0], LandingSettings.from_parameters(rospy.get_param))
        try:
            status = direct(director, drone)
        finally:
            director.reporter.close()
    if status:
        sys.exit(status)
    end_launch()


if __name__ == "__main__":
    sys.exit(run_program(main, sys.argv, USAGE))
