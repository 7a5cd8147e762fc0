#!/usr/bin/env python3
"""Fly the formation demo: takeoff, the patterns in turn, landing. See missions.formation.director for topics.

Parameters:
    /xtdrone/fleet (as ``iris:9``): the vehicles; the first leads.
    ~patterns (default ``cube,pyramid,triangle``): flown in turn between ``origin`` and ``origin``.
    ~pattern_file, ~clearance, ~out, ~recorder: see ``missions.formation.director.DirectorSettings``.

Exit status: 0 after a complete flight; 1 for invalid parameters, after a flight that lost a vehicle, and after a failed
one (all vehicles are landed first).
"""

from __future__ import annotations

import sys

from xtdrone_interaction.missions.director import run_director
from xtdrone_interaction.missions.formation.director import RATE, make_director

if __name__ == "__main__":
    sys.exit(run_director("formation_director", RATE, make_director))
