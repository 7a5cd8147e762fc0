#!/usr/bin/env python3
"""A follower with memory: the paper's law plus the integral of the formation error.

The integral removes the steady error that a constant disturbance, such as wind, leaves behind. It grows only near the
slot, so that a long way there does not wind it up. ``self.dt`` is the time between two calls, so the same file behaves
alike in a node, in ``Swarm`` and on simplified vehicles. To fly it::

    ./xtdrone demo formation --follower src/xtdrone_coordination/examples/integral_follower.py
"""

import sys

from xtdrone_coordination.follower import Follower


class IntegralFollower(Follower):
    """Consensus with an integral term (vel mode)."""

    Ki = 0.1  # 1/s, share of the law's velocity that is added each second
    near = 0.2  # m/s: a law's velocity below it is near the slot
    integral = (0.0, 0.0, 0.0)  # m/s

    def control_law(self, position, peers):
        """Return the stock law plus its integral over time, m/s ENU."""
        stock = super().control_law(position, peers)
        if all(abs(u) < self.near for u in stock):
            self.integral = tuple(i + self.Ki * u * self.dt for i, u in zip(self.integral, stock, strict=True))
        return [u + i for u, i in zip(stock, self.integral, strict=True)]

    def restart(self):
        """Forget the integral, too, when simulated time is reset."""
        super().restart()
        self.integral = (0.0, 0.0, 0.0)


if __name__ == "__main__":
    from xtdrone_coordination.ros import run_follower

    sys.exit(run_follower(IntegralFollower))
