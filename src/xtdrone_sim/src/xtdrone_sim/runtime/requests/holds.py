"""Holds: simulated time stands still between two ticks while another program's action takes effect.

A hold differs from a pause, which a user asks for and which lasts: it ends with its holder, so that a program that is
killed or suspended inside one cannot stop the world for ever.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from threading import Thread

LONGEST_HOLD = 5.0
"""Wall s after which a hold ends in any case."""


@dataclass(frozen=True)
class Holder:
    """Caller that holds time.

    Attributes:
        name: of its node.
        connection: thread in which rospy serves the caller; the hold ends with it.
    """

    name: str
    connection: Thread


@dataclass(frozen=True)
class HoldAnswer:
    """The response to a request for a hold, see xtdrone_msgs/Hold; ``time_us`` in microseconds."""

    success: bool
    message: str
    tick: int
    time_us: int


class Holds:
    """The holds in force."""

    def __init__(self, wall: Callable[[], float]) -> None:
        """Start without any; ``wall`` returns the monotonic wall time, s."""
        self._wall = wall
        self._ends: dict[Holder, float] = {}  # monotonic wall time, s

    def __bool__(self) -> bool:
        """Return whether time is held."""
        return bool(self._ends)

    @property
    def names(self) -> str:
        """The holders."""
        return ", ".join(dict.fromkeys(holder.name for holder in self._ends))

    def begin(self, holder: Holder) -> None:
        """Begin a hold, or begin it again."""
        self._ends[holder] = self._wall() + LONGEST_HOLD

    def end(self, holder: Holder) -> bool:
        """End a hold; return whether it was in force."""
        return self._ends.pop(holder, None) is not None

    def end_overdue(self) -> list[str]:
        """End the holds whose holders are gone or have held for too long; return a text for each."""
        now, texts = self._wall(), []
        for holder, end in list(self._ends.items()):
            if not holder.connection.is_alive():
                why = "its connection has closed"
            elif now >= end:
                why = f"it has held time for {LONGEST_HOLD:g} s"
            else:
                continue
            del self._ends[holder]
            texts.append(f"the hold of {holder.name} ends: {why}")
        return texts
