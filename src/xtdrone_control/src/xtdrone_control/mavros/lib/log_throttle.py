"""Rate limit for log lines about a stream of bad input."""

from __future__ import annotations

import time


class Throttle:
    """Allows each key once in ``interval`` seconds; of wall time, because people read logs."""

    def __init__(self, interval: float = 5.0) -> None:
        """Set the interval in seconds."""
        self._interval = interval
        self._last: dict[str, float] = {}

    def passes(self, key: str) -> bool:
        """Return whether ``key`` may be logged now."""
        now = time.monotonic()
        if now - self._last.get(key, -self._interval) < self._interval:
            return False
        self._last[key] = now
        return True
