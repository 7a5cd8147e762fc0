#!/usr/bin/env python3
"""Mission control of a cooperative search: ``search_mission.py``, one node for all vehicles.

It starts each vehicle's mission, which a ground station has uploaded, sends vehicles to a second look at what their
cameras find, has the finder follow, gives the rest of lost vehicles' paths to others, and brings all home.

Parameters (``config/search.yaml`` has them all, with their ranges):
    /xtdrone/fleet (as ``typhoon_h480:6``): the vehicles.
    ~region: YAML file of the region, ``{region: [[x, y], ...], holes: [...]}``, m ENU.
    ~out: folder to whose events.jsonl events are appended; empty: none.
    ~class (human): what is searched for, a class of the detector; empty: any.
    ~camera: {width, height, horizontal_fov} of all vehicles' cameras.
    ~datum: {latitude, longitude, altitude} of the map frame's origin.
    ~on_find, ~follow_time, ...: see ``xtdrone_coordination.search.mission.MissionSettings``.

Topics: see ``xtdrone_coordination.ros_search``.
"""

import sys

from xtdrone_control.program import run_program
from xtdrone_coordination.ros_search import run

if __name__ == "__main__":
    sys.exit(run_program(run, sys.argv, "search_mission.py   (see its parameters in config/search.yaml)"))
