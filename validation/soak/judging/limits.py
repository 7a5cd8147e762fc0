"""Limits of a soak: growth of memory and descriptors, loss of speed, missed takeoffs."""

from __future__ import annotations

ALLOWANCES = {"rss": 2.0, "anonymous": 2.0, "descriptors": 0.5, "threads": 0.25, "sockets": 0.5}
"""Allowed growth per simulated hour: MiB of memory, counts of everything else."""
ROS_ALLOWANCES = {"rss": 6.0, "anonymous": 6.0, "descriptors": 2.0, "threads": 1.0, "sockets": 2.0}
"""The same for the ROS master and rosout, which keep some data of every node that has ever registered."""
PARTICIPANTS_ALLOWANCE = 0.1
"""Allowed growth of the number of lockstep participants, per simulated hour."""
PACE_ALLOWANCE = 0.2
"""Fraction by which an episode's real-time factor may fall, or its processor time grow, from first to last quarter."""
LOAD_ALLOWANCE = 0.2
"""Maximum increase of the cores used by other programs at which real-time factors are compared."""
LEAST_FLIGHTS = 0.9
"""Required fraction of the requested takeoffs."""
WARM_UP = 0.1
"""Fraction of the soak, at most WARM_UP_HOURS, that is not judged: memory is still being filled for the first time."""
WARM_UP_HOURS = 0.5
