#!/usr/bin/env python3
"""rviz on the screen, with a view that is made for the vehicles that fly. It takes no part in the lockstep.

``rviz_view.py VIEW``; VIEW is vehicle, formation, search or an .rviz file.

Parameters:
    /xtdrone/fleet (as ``iris:9``): which vehicles there are.
    /VEHICLE/robot_description: set where it is missing, as with the simplified simulator.
"""

import sys

from xtdrone_control.programs.node_command_line import run_program
from xtdrone_interaction.rviz.rviz_window import main

if __name__ == "__main__":
    sys.exit(run_program(main, sys.argv, "rviz_view.py VIEW"))
