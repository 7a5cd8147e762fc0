#!/usr/bin/env python3
"""Radio between the vehicles: carries ``/A/NAME`` to ``/B/radio/NAME`` of every other vehicle B, with delay and loss.

Topics are listed in ``xtdrone_control.network.radio_node``.

Parameters:
    ~topics: names and types, comma-separated, e.g. planner/trajectory:xtdrone_msgs/SplineTrajectory.
    ~range, ~delay, ~jitter, ~loss, ~burst, ~bandwidth, ~queue: see ``xtdrone_control.network.NetworkOptions``.
    ~seed: of losses and jitter (0).
"""

import sys

from xtdrone_control.network.radio_node import run_radio

if __name__ == "__main__":
    sys.exit(run_radio())
