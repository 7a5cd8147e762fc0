"""Participants that hold up the simulation: when the status and the log name them, and the text of the log."""

from __future__ import annotations

from collections.abc import Callable

from xtdrone_control.lockstep.server import LockstepServer

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
