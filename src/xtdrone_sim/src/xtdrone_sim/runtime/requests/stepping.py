"""State machine of the simulation: running, paused, or stepping towards a goal. Independent of clocks and ROS."""

from __future__ import annotations

from dataclasses import dataclass


class StepError(ValueError):
    """A step that cannot be made; the message gives the reason."""


@dataclass(frozen=True)
class Goal:
    """End of a step: the first tick that satisfies one of the given conditions.

    Attributes:
        ticks: number of ticks; None for no such condition.
        until_us: simulated time to reach, microseconds; None for no such condition.
    """

    ticks: int | None = None
    until_us: int | None = None


@dataclass(frozen=True)
class Outcome:
    """Result of a step.

    Attributes:
        success: whether the goal was reached.
        ticks: number of ticks made.
        reason: reason why the goal was not reached; "" on success.
    """

    success: bool
    ticks: int
    reason: str


class Stepper:
    """Running, paused or stepping.

    Attributes:
        paused: no further tick begins, except during a step.
        goal: goal of the current step; None without one.
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
        """Pause; return the outcome of the step that this has ended, or None."""
        self.paused = True
        return self._end("it was paused")

    def resume(self) -> Outcome | None:
        """Resume; return the outcome of the step that this has ended, or None."""
        self.paused = False
        return self._end("the simulation was resumed")

    def interrupt(self, reason: str) -> Outcome | None:
        """End the current step for ``reason``, leaving ``paused`` as it is; return its outcome, or None."""
        return self._end(reason)

    def begin(self, goal: Goal, now_us: int) -> None:
        """Begin a step from simulated time ``now_us``; afterwards the simulation is paused.

        Raises:
            StepError: another step is in progress, or the goal is not in the future.
        """
        if self.goal is not None:
            raise StepError("another step is in progress")
        if goal.ticks is None and goal.until_us is None:
            raise StepError("the step has no goal")
        if goal.ticks is not None and goal.ticks < 1:
            raise StepError(f"ticks: {goal.ticks} is not allowed, at least 1")
        if goal.until_us is not None and goal.until_us <= now_us:
            until, now = goal.until_us * 1e-6, now_us * 1e-6
            raise StepError(f"until: {until:.3f} s is not allowed, the simulated time is already {now:.3f} s")
        self.paused = True
        self.goal = goal
        self._made = 0

    def ticked(self, now_us: int) -> Outcome | None:
        """Count a tick that has ended at ``now_us``, microseconds; return the outcome if it completed a step."""
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
