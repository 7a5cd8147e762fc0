"""What a soak may do: growth of memory and descriptors, loss of pace, missed takeoffs."""

from __future__ import annotations

ALLOWANCES = {"rss": 2.0, "anonymous": 2.0, "descriptors": 0.5, "threads": 0.25, "sockets": 0.5}
"""Growth that is allowed, per simulated hour: MiB of memory, counts of the rest."""
ROS_ALLOWANCES = {"rss": 6.0, "anonymous": 6.0, "descriptors": 2.0, "threads": 1.0, "sockets": 2.0}
"""The same of ROS's own master and log collector, which keep something of every node that ever was."""
PARTICIPANTS_ALLOWANCE = 0.1
"""Growth of the number of lockstep participants that is allowed, per simulated hour."""
PACE_ALLOWANCE = 0.2
"""Fraction by which an episode's real-time factor may fall, or its processor time grow, from first to last quarter."""
LOAD_ALLOWANCE = 0.2
"""Maximum increase of the cores used by other programs at which real-time factors are compared."""
LEAST_FLIGHTS = 0.9
"""Required fraction of the requested takeoffs."""
WARM_UP = 0.1
"""Fraction of the soak, at most WARM_UP_HOURS, that is not judged: memory is still being filled for the first time."""
WARM_UP_HOURS = 0.5
