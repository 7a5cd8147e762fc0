#!/usr/bin/env python3
"""A follower of your own in a few lines: it adds the mean velocity of those it listens to.

With the paper's law alone a formation lags behind a moving leader by v / Kp per layer of the topology; with this one
it does not. Run it instead of the stock follower::

    roslaunch launch/formation.launch follower_class:=$PWD/src/xtdrone_coordination/examples/feed_forward_follower.py

or by itself, with the arguments of follower.py: ``feed_forward_follower.py iris 1 9``. ``control_laws`` is not needed
for that: it is the same law for all at once, so that a thousand fly as fast as the stock ones in
``Swarm(1000, follower=FeedForwardFollower)``.
"""

import sys

from xtdrone_coordination.follower import Follower


class FeedForwardFollower(Follower):
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
