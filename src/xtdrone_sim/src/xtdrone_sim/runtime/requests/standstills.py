"""Reasons for which simulated time stands still: holds of other programs, and participants that are slow.

During a hold, another program's action takes effect between two ticks. It differs from a pause, which a user asks for
and which lasts: it ends with its holder, so that a program that is killed or suspended inside one cannot stop the world
for ever.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from threading import Thread

from xtdrone_lockstep.server import LockstepServer

LONGEST_HOLD = 5.0
"""Wall s after which a hold ends in any case."""


@dataclass(frozen=True)
class Holder:
    """Caller that holds time.

    Attributes:
        name: name of its node.
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


_REPORTED = 0.5  # wall s of waiting for a participant after which the status names it
_FIRST_WARNING = 5.0  # wall s of waiting after which the log names it
_WARNING_PERIOD = 30.0  # wall s between two such warnings
_ALIVE_LIMIT = 3.0  # wall s since the last keep-alive, sent every second, within which a process counts as alive


class SlowParticipants:
    """The participants for which the barrier has waited too long."""

    def __init__(self, barrier: LockstepServer, hang_limit: float, warn: Callable[[str], None]) -> None:
        """Watch the participants of ``barrier``.

        Args:
            barrier: lockstep server.
            hang_limit: hang limit of the server, wall s; used in log texts.
            warn: logs standstills.
        """
        self._barrier = barrier
        self._hang_limit = hang_limit
        self._warn = warn
        self._next_warning = 0.0

    def waiting(self, now: float, least: float = _REPORTED) -> dict[str, float]:
        """Return the participants that have held up the world for at least ``least`` wall s, with the wall s so far."""
        return {
            name: now - participant.asked
            for name, participant in self._barrier.participants.items()
            if participant.waiting and now - participant.asked >= least
        }

    def report(self, now: float) -> None:
        """Log the participants that hold up the world, so that a breakpoint is not mistaken for a failure."""
        waiting = self.waiting(now, _FIRST_WARNING)
        if not waiting:
            self._next_warning = 0.0
            return
        if now < self._next_warning:
            return
        self._next_warning = now + _WARNING_PERIOD
        parts = []
        for name, seconds in waiting.items():
            silent = now - self._barrier.participants[name].heard
            how = "it is alive; is it at a breakpoint?" if silent < _ALIVE_LIMIT else self._silence(silent)
            parts.append(f"{name} for {seconds:.0f} s ({how})")
        self._warn(f"the world stands still, waiting for {', '.join(parts)}")

    def _silence(self, silent: float) -> str:
        end = f"dropped after {self._hang_limit:g} s" if self._hang_limit else "hang_limit is 0: never dropped"
        return f"silent for {silent:.0f} s; {end}"
