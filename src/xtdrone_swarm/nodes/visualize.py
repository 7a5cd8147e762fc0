#!/usr/bin/env python3
"""The picture of a running flight: ``visualize.py iris 9`` (type, number of vehicles); see ``view.view_of_ros_flight``.

A live window outside the lockstep: scroll zooms, drag turns, h shows the keys. With ``~film`` a film instead, as a
participant of the lockstep, until the node ends.

Parameters:
    ~film (file with the suffix .mp4, .gif or .png, default none).
    ~fps (frames per simulated second, default 25).
    ~trails (s, default 4).
"""

import signal
import sys

if __name__ == "__main__":
    # The imports take seconds, and some of them suppress a KeyboardInterrupt.
    signal.signal(signal.SIGINT, signal.SIG_DFL)

    from xtdrone_swarm.view.view_of_ros_flight import main

    sys.exit(main())
