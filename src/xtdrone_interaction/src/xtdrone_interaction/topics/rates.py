"""Rates of messages as ``rostopic hz`` and ``rostopic bw`` have them, and the choice of the messages to pass on."""

from __future__ import annotations

from collections import deque

_WINDOW = 5.0  # s over which a rate is taken
_MOST_KEPT = 2000  # messages within the window


class RateMeter:
    """Rate of the messages of a topic over the last 5 s, in the clock that the caller gives."""

    def __init__(self) -> None:
        self.count = 0
        self._arrivals: deque[tuple[float, int]] = deque(maxlen=_MOST_KEPT)

    def add(self, now: float, size: int) -> None:
        """Count a message.

        Args:
            now: time of its arrival, s; the same clock in every call.
            size: bytes.
        """
        self.count += 1
        self._arrivals.append((now, size))

    def rates(self, now: float) -> tuple[float, float]:
        """Return messages per s and bytes per s; 0 with fewer than two messages in the window."""
        while self._arrivals and self._arrivals[0][0] < now - _WINDOW:
            self._arrivals.popleft()
        arrivals = list(self._arrivals)
        if len(arrivals) < 2:
            return 0.0, 0.0
        # A topic that has ended falls off as its silence grows longer than its period was.
        span = arrivals[-1][0] - arrivals[0][0]
        period = span / (len(arrivals) - 1)
        span = max(span, now - arrivals[0][0] - period)
        if span <= 0.0:
            return 0.0, 0.0
        return (len(arrivals) - 1) / span, sum(size for _, size in arrivals[1:]) / span


class Throttle:
    """Chooses messages so that they come at most at a rate, the last one of a burst included."""

    def __init__(self, most: float | None) -> None:
        """Set the rate.

        Args:
            most: messages per s; None for all.
        """
        self.interval = 1.0 / most if most else 0.0
        self._next = float("-inf")

    def wait(self, now: float) -> float:
        """Return how long a message has to wait that has come at ``now``, s; 0.0 if it may be passed on at once."""
        return max(self._next - now, 0.0)

    def passed(self, now: float) -> None:
        """Note that a message has been passed on."""
        # Times are kept on a grid so that the mean rate of a faster topic is the allowed one.
        self._next = max(self._next + self.interval, now) if self._next + self.interval > now else now + self.interval
