#!/usr/bin/env python3
"""The picture of a running flight: ``visualize.py iris 9`` (type, number of vehicles); see ``simplified/view/ros.py``.

A live window, as a free rider: scroll zooms, drag turns, h shows the keys. With ``~film`` a film instead, as a
participant of the lockstep, until the node ends.

Parameters:
    ~film (file that ends with .mp4, .gif or .png, default none).
    ~fps (frames a simulated second, default 25).
    ~trails (s, default 4).
"""

import signal
import sys

if __name__ == "__main__":
    # The imports take seconds and some of them swallow a KeyboardInterrupt.
    signal.signal(signal.SIGINT, signal.SIG_DFL)

    from xtdrone_swarm.view.ros import main

    sys.exit(main())
