"""Whether a camera still shows what is there: pictures come, with times that go on, and change while it moves."""

from __future__ import annotations

import math

Vector = tuple[float, float, float]

LONGEST = 3.0  # s without a new picture
MOVED = 3.0  # m of flight over which two pictures cannot be the same


class CameraWatch:
    """Watches one camera.

    Attributes:
        fault: what is wrong, empty while nothing is or nothing is known.
    """

    def __init__(self, longest: float = LONGEST) -> None:
        """Start without a picture.

        Args:
            longest: s of simulated time without a new picture after which a camera in flight is silent.
        """
        self.fault = ""
        self._longest = longest
        self._since: float | None = None
        self._stamp = -math.inf
        self._content: int | None = None
        self._begun: tuple[float, Vector | None] = (-math.inf, None)

    @property
    def seen(self) -> bool:
        """Whether there has been a picture."""
        return self._stamp > -math.inf

    def picture(self, now: float, stamp: float, content: int, place: Vector | None) -> None:
        """Take note of a picture.

        Args:
            now: time, s.
            stamp: its exposure's time, s; one that is not later than the last one's is no new picture.
            content: a checksum.
            place: the vehicle's, m; None when it is not known or the vehicle does not fly.
        """
        if stamp <= self._stamp:
            return
        self._stamp = stamp
        began, where = self._begun
        if content != self._content or where is None:
            self._content, self._begun = content, (now, place)
        elif place is not None and now - began >= self._longest and math.dist(where, place) > MOVED:
            self.fault = f"its pictures have been the same since {began:.1f} s, in flight"
            self._since = now
            return
        self._since, self.fault = now, ""

    def look(self, now: float, flying: bool) -> None:
        """Look at the time that has passed.

        Args:
            now: time, s.
            flying: a camera on the ground may be silent.
        """
        if not flying or self._since is None:
            self._since = now
        elif now - self._since > self._longest:
            self.fault = f"no picture for more than {self._longest:g} s, in flight"
