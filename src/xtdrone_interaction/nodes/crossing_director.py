#!/usr/bin/env python3
"""Fly every vehicle through obstacles to its goal, and land it. Topics: see ``crossing.crossing_director``.

Parameters:
    /xtdrone/fleet (as ``iris_3d_lidar:1``): the vehicles.
    ~goals (list of [x, y, z], m in map): one per vehicle, in order.
    those of ``xtdrone_interaction.crossing.crossing_mission.CrossingSettings``.

Exit status: 0 if all have arrived; 1 for invalid parameters, or if one has not arrived.
"""

from __future__ import annotations

import sys

import rospy
import yaml

from xtdrone_control import lockstep
from xtdrone_control.fleet import parse_fleet
from xtdrone_control.programs.under_roslaunch import end_launch
from xtdrone_interaction.crossing.crossing_director import RATE, CrossingDirector, parse_goals
from xtdrone_interaction.crossing.crossing_mission import CrossingSettings
from xtdrone_interaction.crossing.formation_crossing_director import FormationCrossingDirector

RECORDER_LIMIT = 30.0  # s of wall time


def main() -> int:
    """Fly and return the exit status."""
    lockstep.init_node("crossing_director", rate=RATE)
    try:
        names = [vehicle.name for vehicle in parse_fleet(str(rospy.get_param("/xtdrone/fleet")))]
        goals = rospy.get_param("~goals")
        settings = CrossingSettings.from_parameters(rospy.get_param)
        parsed = parse_goals(yaml.safe_load(goals) if isinstance(goals, str) else goals, names)
        director = (FormationCrossingDirector if settings.pattern else CrossingDirector)(parsed, settings)
    except KeyError as error:
        rospy.logfatal("crossing_director: parameter %s is not set", error)
        return 1
    except (ValueError, OSError, yaml.YAMLError) as error:
        rospy.logfatal("crossing_director: %s", error)
        return 1
    if settings.recorder and not director.wait_for_recorder(settings.recorder, RECORDER_LIMIT):
        rospy.logerr("crossing_director: %s has not subscribed: the flight may not be recorded", settings.recorder)
    lockstep.start()
    try:
        status = director.run()
    finally:
        director.close()
    end_launch()
    return status


if __name__ == "__main__":
    try:
        sys.exit(main())
    except rospy.ROSInitException as error:
        print(f"crossing_director: {error}", file=sys.stderr)
        sys.exit(1)
    except rospy.ROSInterruptException:
        sys.exit(1)
