#!/usr/bin/env python3
"""Mission control of a cooperative search: ``search_mission.py``, one node for all vehicles.

Starts the missions that a ground station has uploaded, sends vehicles to a second look at candidates, makes the finder
follow the person, reallocates the paths of lost vehicles, and returns all vehicles home.

Parameters (all of them, with their ranges, are in ``config/search.yaml``):
    /xtdrone/fleet (as ``typhoon_h480:6``): the vehicles.
    ~region: YAML file of the region, ``{region: [[x, y], ...], holes: [...]}``, m ENU.
    ~out: folder with the events.jsonl that events are appended to; empty: none.
    ~class (human): detector class to search for; empty: any.
    ~camera: {width, height, horizontal_fov} of the cameras.
    ~datum: {latitude, longitude, altitude} of the map frame's origin.
    ~on_find, ~follow_time, ...: see ``xtdrone_coordination.search.search_settings.MissionSettings``.

Topics: see ``xtdrone_coordination.search.search_node``.
"""

import sys

from xtdrone_common.programs.node_command_line import run_program
from xtdrone_coordination.search.search_node import run

if __name__ == "__main__":
    sys.exit(run_program(run, sys.argv, "search_mission.py   (see its parameters in config/search.yaml)"))
