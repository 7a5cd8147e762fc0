"""Values at past times: poses between the messages that told them."""

from __future__ import annotations

from bisect import bisect_left
from collections import deque

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class History:
    """Positions and attitudes of the last seconds, and what they were between.

    An entry is an array of numbers whose last four are a unit quaternion, the others whatever moves evenly.
    """

    def __init__(self, seconds: float = 3.0, reach: float = 0.3) -> None:
        """Start empty.

        Args:
            seconds: how long entries are kept, s.
            reach: so far from an entry, s, a time may lie that is not between two.
        """
        self._keep_ns = round(seconds * 1e9)
        self._reach_ns = round(reach * 1e9)
        self._times: deque[int] = deque()
        self._entries: deque[Array] = deque()

    def clear(self) -> None:
        """Forget everything."""
        self._times.clear()
        self._entries.clear()

    def add(self, time_ns: int, entry: Array) -> None:
        """Add an entry; one that is not later than the last is left out."""
        if self._times and time_ns <= self._times[-1]:
            return
        self._times.append(time_ns)
        self._entries.append(np.asarray(entry, float))
        while self._times[0] < time_ns - self._keep_ns:
            self._times.popleft()
            self._entries.popleft()

    @property
    def last(self) -> Array | None:
        """The newest entry, None before the first."""
        return self._entries[-1] if self._entries else None

    def at(self, time_ns: int) -> Array | None:
        """Return the entry of a time: between two, both in parts (the quaternion normalised), else the nearest.

        Returns:
            None where the nearest is too far away.
        """
        after = bisect_left(self._times, time_ns)
        if 0 < after < len(self._times):
            early, late = self._times[after - 1], self._times[after]
            part = (time_ns - early) / (late - early)
            return _between(self._entries[after - 1], self._entries[after], part)
        if not self._times:
            return None
        nearest = min(after, len(self._times) - 1)
        return self._entries[nearest] if abs(self._times[nearest] - time_ns) <= self._reach_ns else None


def _between(early: Array, late: Array, part: float) -> Array:
    # A quaternion and its negative are the same turn: take the nearer.
    late = late.copy()
    if early[-4:] @ late[-4:] < 0.0:
        late[-4:] *= -1.0
    mixed = (1.0 - part) * early + part * late
    mixed[-4:] /= np.linalg.norm(mixed[-4:])
    return mixed
