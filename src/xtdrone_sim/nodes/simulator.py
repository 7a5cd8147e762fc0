#!/usr/bin/env python3
"""Simulator node of all vehicles; parameters: see ``xtdrone_sim.runtime.full_simulation.FullSettings``."""

import signal
import sys

if __name__ == "__main__":
    # The imports take seconds and some of them swallow a KeyboardInterrupt; rospy takes SIGINT over afterwards.
    signal.signal(signal.SIGINT, signal.SIG_DFL)

    from xtdrone_sim.runtime.full_simulation import main

    sys.exit(main())
