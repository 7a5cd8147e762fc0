"""Whether the world goes on: running, paused, or stepping towards a goal. No clock and no ROS in here."""

from __future__ import annotations

from dataclasses import dataclass


class StepError(ValueError):
    """A step that cannot be made; the message says why."""


@dataclass(frozen=True)
class Goal:
    """Where a step ends: whatever is given, the first tick that fulfils it.

    Attributes:
        ticks: after so many ticks, None for any number.
        until_us: at the first tick at or after this simulated time, microseconds; None for any time.
    """

    ticks: int | None = None
    until_us: int | None = None


@dataclass(frozen=True)
class Outcome:
    """What has become of a step.

    Attributes:
        success: it has come to its goal.
        ticks: ticks made.
        reason: why it has not come to its goal, else empty.
    """

    success: bool
    ticks: int
    reason: str


class Stepper:
    """Running, paused or stepping.

    Attributes:
        paused: no further tick begins, unless a step is under way.
        goal: of the step that is under way, None without one.
    """

    def __init__(self, paused: bool = False) -> None:
        """Start running or paused."""
        self.paused = paused
        self.goal: Goal | None = None
        self._made = 0

    @property
    def moving(self) -> bool:
        """Whether the next tick may begin."""
        return not self.paused or self.goal is not None

    def pause(self) -> Outcome | None:
        """Let no further tick begin; return what this has made of a step that was under way."""
        self.paused = True
        return self._end("it was paused")

    def resume(self) -> Outcome | None:
        """Go on without an end; return what this has made of a step that was under way."""
        self.paused = False
        return self._end("the simulation was resumed")

    def interrupt(self, reason: str) -> Outcome | None:
        """End a step that is under way for ``reason``; running or paused stays as it is."""
        return self._end(reason)

    def begin(self, goal: Goal, now_us: int) -> None:
        """Begin a step from simulated time ``now_us``; afterwards the simulation is paused.

        Raises:
            StepError: one is under way, or the goal is not ahead.
        """
        if self.goal is not None:
            raise StepError("another step is under way")
        if goal.ticks is None and goal.until_us is None:
            raise StepError("the step has no goal")
        if goal.ticks is not None and goal.ticks < 1:
            raise StepError(f"ticks: {goal.ticks} is not allowed, at least 1")
        if goal.until_us is not None and goal.until_us <= now_us:
            until, now = goal.until_us * 1e-6, now_us * 1e-6
            raise StepError(f"until: {until:.3f} s is not allowed, the simulated time is {now:.3f} s already")
        self.paused = True
        self.goal = goal
        self._made = 0

    def ticked(self, now_us: int) -> Outcome | None:
        """Note that a tick has ended at simulated time ``now_us``; return the outcome if it was a step's last."""
        goal = self.goal
        if goal is None:
            return None
        self._made += 1
        reached = (goal.ticks is not None and self._made >= goal.ticks) or (
            goal.until_us is not None and now_us >= goal.until_us
        )
        if not reached:
            return None
        self.goal = None
        return Outcome(True, self._made, "")

    def _end(self, reason: str) -> Outcome | None:
        if self.goal is None:
            return None
        self.goal = None
        return Outcome(False, self._made, reason)
