#!/usr/bin/env python3
"""Flies the formation demo: takeoff, the patterns in turn, landing. Topics: see xtdrone_interaction.director.

Parameters:
    /xtdrone/fleet (as ``iris:9``): the vehicles; the first leads.
    ~patterns (default ``cube,pyramid,triangle``): flown in turn between ``origin`` and ``origin``.
    ~pattern_file (default empty): YAML with patterns of one's own.
    ~clearance (m, default 3.0): least height of any slot above the ground.
    ~out (default empty): folder for events.jsonl.
    ~recorder (default empty): node that records the flight; time starts when it has subscribed, or after 30 s.

Exit status: 0 after a whole flight; 1 for parameters that are not allowed, after a flight that has lost a vehicle, and
after a failed one (all vehicles are landed first).
"""

from __future__ import annotations

import sys

import rospy

from xtdrone_control import lockstep
from xtdrone_control.fleet import parse_fleet
from xtdrone_coordination.follower import check_number
from xtdrone_interaction.director import RATE, FormationDirector, open_events
from xtdrone_interaction.options import split_patterns, swarm_patterns

_RECORDER_LIMIT = 30.0  # s of wall time


def main() -> int:
    """Fly and return the exit status."""
    lockstep.init_node("formation_director", rate=RATE)
    try:
        fleet = parse_fleet(str(rospy.get_param("/xtdrone/fleet")))
        names = split_patterns(str(rospy.get_param("~patterns", "cube,pyramid,triangle")))
        slots = swarm_patterns(len(fleet), names, str(rospy.get_param("~pattern_file", "")) or None)
        clearance = rospy.get_param("~clearance", 3.0)
        check_number("clearance", clearance, zero=True)
        events = open_events(str(rospy.get_param("~out", "")))
    except KeyError:
        rospy.logfatal("director: parameter /xtdrone/fleet is not set; launch/multi_vehicle.launch sets it")
        return 1
    except OSError as error:
        rospy.logfatal("director: out: %s: %s", error.filename, error.strerror)
        return 1
    except ValueError as error:  # fleet, patterns and clearance
        rospy.logfatal("director: %s", error)
        return 1
    director = FormationDirector([v.name for v in fleet], names, slots, clearance, events)
    recorder = str(rospy.get_param("~recorder", ""))
    if recorder and not director.wait_for_recorder(recorder, _RECORDER_LIMIT):
        rospy.logerr(
            "director: %s has not subscribed within %g s: the flight may not be recorded", recorder, _RECORDER_LIMIT
        )
    lockstep.start()
    try:
        return director.run()
    finally:
        if events is not None:
            events.close()


if __name__ == "__main__":
    try:
        sys.exit(main())
    except rospy.ROSInitException as error:
        print(f"director: {error}", file=sys.stderr)
        sys.exit(1)
    except rospy.ROSInterruptException:
        sys.exit(1)
