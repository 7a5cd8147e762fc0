#!/usr/bin/env python3
"""A leader with a rule of its own for the slots: the nearest pair of follower and slot first.

To fly it::

    ./xtdrone demo formation --leader src/xtdrone_coordination/examples/nearest_first_leader.py
"""

import numpy as np

from xtdrone_coordination.leader import Leader


class NearestFirstLeader(Leader):
    """Greedy assignment of the slots."""

    def assignment(self, current, target):
        """Return the slot of each follower, shape (N-1,): the closest pair is assigned first, then the next one."""
        distance = np.linalg.norm(current[:, None] - target[None], axis=-1)
        slots = np.empty(len(target), dtype=int)
        for _ in slots:
            follower, slot = np.unravel_index(distance.argmin(), distance.shape)
            slots[follower] = slot
            distance[follower] = distance[:, slot] = np.inf
        return slots
