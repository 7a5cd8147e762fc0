#!/usr/bin/env python3
"""Steer vehicles from the keyboard: ``multirotor_keyboard_control.py iris 9 vel`` (type, number, vel or accel).

The keys are XTDrone's and are shown on the screen; topics are listed in ``xtdrone_interaction.keyboard.keyboard_node``.
A mixed fleet is given as ``iris:3,typhoon_h480:2``. Any terminal works, also over ssh.

Parameters:
    ~patterns: the leader's YAML file with additional patterns, for the digit keys.
    /xtdrone/fleet (as ``iris:9``): the vehicles; without it the number is not checked.
"""

import signal
import sys

if __name__ == "__main__":
    # The imports take a second and some of them swallow a KeyboardInterrupt.
    signal.signal(signal.SIGINT, signal.SIG_DFL)

    from xtdrone_interaction.keyboard.keyboard_node import main

    sys.exit(main())
