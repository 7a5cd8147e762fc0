"""History of recent poses, interpolated between messages."""

from __future__ import annotations

import itertools
from bisect import bisect_left
from collections import deque

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class PoseHistory:
    """Recent poses or attitudes, with interpolation.

    The last four numbers of an entry are a unit quaternion w, x, y, z; those before it, such as x, y, z in m, are
    interpolated linearly.
    """

    def __init__(self, seconds: float = 3.0, reach: float = 0.3, *, scalar_last: bool = False) -> None:
        """Start empty.

        Args:
            seconds: Time for which entries are kept, s.
            reach: Maximum extrapolation, s.
            scalar_last: Whether w is the last summand of a norm, not the first: the rounding of cameras and odometry.
                Exchanging both would change the last bits of flights.
        """
        self._summands = [-3, -2, -1, -4] if scalar_last else [-4, -3, -2, -1]
        self._keep_ns = round(seconds * 1e9)
        self._reach_ns = round(reach * 1e9)
        self._times: deque[int] = deque()
        self._entries: deque[Array] = deque()

    def clear(self) -> None:
        """Remove all entries."""
        self._times.clear()
        self._entries.clear()

    def add(self, time_ns: int, entry: Array) -> None:
        """Add an entry, unless it is not later than the last one."""
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
        """Return the entry at a time: interpolated between two entries (quaternion normalised), else the nearest.

        Returns:
            None if the nearest entry is too far away.
        """
        after = bisect_left(self._times, time_ns)
        if 0 < after < len(self._times):
            early, late = self._times[after - 1], self._times[after]
            part = (time_ns - early) / (late - early)
            return self._between(self._entries[after - 1], self._entries[after], part)
        if not self._times:
            return None
        nearest = min(after, len(self._times) - 1)
        return self._entries[nearest] if abs(self._times[nearest] - time_ns) <= self._reach_ns else None

    def during(self, time_ns: int, seconds: float, pieces: int) -> Array | None:
        """Return the entries at even times from ``time_ns`` to ``seconds`` later, (pieces + 1, n); None if unknown.

        Quaternions have the sign that is nearer to the one before.
        """
        found = [self.at(time_ns + round(k * (seconds / pieces) * 1e9)) for k in range(pieces + 1)]
        known = [entry.copy() for entry in found if entry is not None]
        for before, after in itertools.pairwise(known):
            if before[-4:] @ after[-4:] < 0.0:
                after[-4:] *= -1.0
        return np.array(known) if len(known) == len(found) else None

    def _between(self, early: Array, late: Array, part: float) -> Array:
        # A quaternion and its negative are the same rotation: use the nearer one.
        late = late.copy()
        if early[-4:] @ late[-4:] < 0.0:
            late[-4:] *= -1.0
        mixed = (1.0 - part) * early + part * late
        mixed[-4:] /= np.linalg.norm(mixed[self._summands])
        return mixed
