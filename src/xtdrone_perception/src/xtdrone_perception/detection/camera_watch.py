"""Camera supervision: images must arrive, with increasing stamps, and change while the vehicle moves."""

from __future__ import annotations

import math

Vector = tuple[float, float, float]

TIMEOUT = 3.0  # s without a new image
MOVED = 3.0  # m of flight after which an image must have changed


class CameraWatch:
    """Supervision of one camera.

    Attributes:
        fault: the fault, empty if there is none or nothing is known yet.
    """

    def __init__(self, timeout: float = TIMEOUT) -> None:
        """Start without an image.

        Args:
            timeout: simulated time without a new image after which a camera in flight has failed, s.
        """
        self.fault = ""
        self._timeout = timeout
        self._since: float | None = None
        self._stamp = -math.inf
        self._content: int | None = None
        self._begun: tuple[float, Vector | None] = (-math.inf, None)

    @property
    def seen(self) -> bool:
        """Whether an image has arrived."""
        return self._stamp > -math.inf

    def on_picture(self, now: float, stamp: float, content: int, place: Vector | None) -> None:
        """Check an image.

        Args:
            now: time, s.
            stamp: time of the exposure, s; an image without a later stamp than the last one is not new.
            content: checksum of the image.
            place: position of the vehicle, m; None if unknown or not in flight.
        """
        if stamp <= self._stamp:
            return
        self._stamp = stamp
        began, where = self._begun
        if content != self._content or where is None:
            self._content, self._begun = content, (now, place)
        elif place is not None and now - began >= self._timeout and math.dist(where, place) > MOVED:
            self.fault = f"its images have been the same since {began:.1f} s, in flight"
            self._since = now
            return
        self._since, self.fault = now, ""

    def update(self, now: float, flying: bool) -> None:
        """Check the time since the last image.

        Args:
            now: time, s.
            flying: whether the vehicle is in flight; on the ground the camera may be silent.
        """
        if not flying or self._since is None:
            self._since = now
        elif now - self._since > self._timeout:
            self.fault = f"no image for more than {self._timeout:g} s, in flight"
