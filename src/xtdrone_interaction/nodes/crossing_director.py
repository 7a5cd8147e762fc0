#!/usr/bin/env python3
"""Fly every vehicle through obstacles to its goal, and land it. Topics: see ``missions.crossing.director``.

Parameters:
    /xtdrone/fleet (as ``iris_3d_lidar:1``): the vehicles.
    ~goals (list of [x, y, z], m in map): one per vehicle, in order.
    those of ``xtdrone_interaction.missions.crossing.state_machine.CrossingSettings``.

Exit status: 0 if all have arrived; 1 for invalid parameters, or if one has not arrived.
"""

from __future__ import annotations

import sys

from xtdrone_interaction.missions.crossing.director import RATE, make_director
from xtdrone_interaction.missions.director import run_director

if __name__ == "__main__":
    sys.exit(run_director("crossing_director", RATE, make_director))
