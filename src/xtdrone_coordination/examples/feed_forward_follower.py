#!/usr/bin/env python3
"""A follower of your own in a few lines: it adds the mean velocity of its neighbours.

With the paper's law alone a formation lags behind a moving leader by v / Kp per layer of the topology; with this law it
does not. To use it instead of the stock follower::

    roslaunch launch/formation.launch follower_class:=$PWD/src/xtdrone_coordination/examples/feed_forward_follower.py

or on its own, with the arguments of follower.py: ``feed_forward_follower.py iris 1 9``. This needs ``control_law`` and
the base class ``Follower`` only. ``control_laws`` is the same law for many followers at once, so that a thousand fly as
fast as the stock ones in ``Swarm(1000, follower=FeedForwardFollower)``.
"""

import sys

from xtdrone_coordination.array_follower import ArrayFollower


class FeedForwardFollower(ArrayFollower):
    """Consensus with the neighbours' velocity fed forward (vel mode)."""

    uses_velocities = True

    def control_law(self, position, peers):
        """Return the stock law plus the mean velocity of the neighbours, m/s ENU."""
        stock = super().control_law(position, peers)
        return [u + sum(peer.velocity[axis] for peer in peers) / len(peers) for axis, u in enumerate(stock)]

    @classmethod
    def control_laws(cls, options, own, peers):
        """Return the same for many followers at once, shape (M, 3)."""
        return own.stock + peers.mean(peers.velocity)


if __name__ == "__main__":
    from xtdrone_coordination.ros import run_follower

    sys.exit(run_follower(FeedForwardFollower))
