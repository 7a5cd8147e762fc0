#!/usr/bin/env python3
"""Fly the formation demo: takeoff, the patterns in turn, landing. See formation.formation_director for topics.

Parameters:
    /xtdrone/fleet (as ``iris:9``): the vehicles; the first leads.
    ~patterns (default ``cube,pyramid,triangle``): flown in turn between ``origin`` and ``origin``.
    ~pattern_file, ~clearance, ~out, ~recorder: see ``formation.formation_director.DirectorSettings``.

Exit status: 0 after a complete flight; 1 for invalid parameters, after a flight that lost a vehicle, and after a failed
one (all vehicles are landed first).
"""

from __future__ import annotations

import sys

import rospy

from xtdrone_control import lockstep
from xtdrone_control.fleet import parse_fleet
from xtdrone_control.programs.under_roslaunch import end_launch
from xtdrone_interaction.command_options import split_patterns, swarm_patterns
from xtdrone_interaction.formation.formation_director import (
    RATE,
    RECORDER_LIMIT,
    DirectorSettings,
    FormationDirector,
    open_events,
)


def main() -> int:
    """Fly and return the exit status."""
    lockstep.init_node("formation_director", rate=RATE)
    try:
        fleet = parse_fleet(str(rospy.get_param("/xtdrone/fleet")))
        names = split_patterns(str(rospy.get_param("~patterns", "cube,pyramid,triangle")))
        settings = DirectorSettings.from_parameters(rospy.get_param)
        slots = swarm_patterns(len(fleet), names, settings.pattern_file or None)
        events = open_events(settings.out)
    except KeyError:
        rospy.logfatal("director: parameter /xtdrone/fleet is not set; launch/multi_vehicle.launch sets it")
        return 1
    except OSError as error:
        rospy.logfatal("director: out: %s: %s", error.filename, error.strerror)
        return 1
    except ValueError as error:  # fleet, patterns and clearance
        rospy.logfatal("director: %s", error)
        return 1
    with lockstep.registering_together():
        director = FormationDirector([v.name for v in fleet], names, slots, settings.clearance, events)
    if settings.recorder and not director.wait_for_recorder(settings.recorder, RECORDER_LIMIT):
        rospy.logerr(
            "director: %s has not subscribed within %g s: the flight may not be recorded",
            settings.recorder,
            RECORDER_LIMIT,
        )
    lockstep.start()
    try:
        status = director.run()
    finally:
        if events is not None:
            events.close()
    if status == 0:
        end_launch()
    return status


if __name__ == "__main__":
    try:
        sys.exit(main())
    except rospy.ROSInitException as error:
        print(f"director: {error}", file=sys.stderr)
        sys.exit(1)
    except rospy.ROSInterruptException:
        sys.exit(1)
