#!/usr/bin/env python3
"""Open rviz with a view generated for the fleet. It is not part of the lockstep.

``rviz_view.py VIEW``; VIEW is vehicle, formation, search or an .rviz file.

Parameters:
    /xtdrone/fleet (as ``iris:9``): the vehicles.
    /VEHICLE/robot_description: set where missing, e.g. with the simplified simulator.
"""

import sys

from xtdrone_common.programs.node_command_line import run_program
from xtdrone_interaction.rviz.rviz_window import main

if __name__ == "__main__":
    sys.exit(run_program(main, sys.argv, "rviz_view.py VIEW"))
