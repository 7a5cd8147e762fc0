#!/usr/bin/env python3
"""The follower of ``./xtdrone demo forest --formation``: it listens to the leader alone and feeds its velocity forward.

Between trees each follower makes detours of its own. With the topology of the leader node one that lags behind holds
back those that listen to it; with the leader as the only neighbour it does not. The leader's velocity keeps followers
in their slots while it flies, see ``feed_forward_follower.py``. To use your own in its place::

    ./xtdrone demo forest --formation circle --n 6 --follower FILE.py
"""

import sys

from xtdrone_coordination.follower import StarFollower


class ForestFollower(StarFollower):
    """The paper's law towards the leader, and its velocity (vel mode)."""

    uses_velocities = True

    def control_law(self, position, peers):
        """Return the stock law plus the leader's velocity, m/s ENU."""
        stock = super().control_law(position, peers)
        return [u + v for u, v in zip(stock, peers[0].velocity, strict=True)]


if __name__ == "__main__":
    from xtdrone_coordination.ros import run_follower

    sys.exit(run_follower(ForestFollower))
