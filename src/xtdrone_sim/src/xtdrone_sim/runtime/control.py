"""Control of the simulation in flight: speed, pause, step, reset. No ROS in here; ``services`` offers it on the graph.

Everything is called in the simulator's own thread. What only changes the pace acts at once, also while the barrier
waits for a participant. A step and a reset act between ticks; whoever asked for them waits for the answer meanwhile. A
participant whose turn is not over must not wait for the end of its own tick: its step is refused, its reset is
answered at once and made when the tick is over.
"""

from __future__ import annotations

import enum
import time
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import Future
from dataclasses import dataclass
from typing import Any, Protocol

from xtdrone_sim.runtime.mailbox import ClosedError
from xtdrone_sim.runtime.pacing import Pacer, SpeedMeter
from xtdrone_sim.runtime.stepping import Goal, Outcome, StepError, Stepper

PATIENCE = 10.0
"""Wall seconds that a step or a reset waits for the end of the present tick."""

_REPORTED = 0.5  # wall s for which somebody is waited for before the status names him
_FIRST_WORD = 5.0  # wall s until the log does
_NEXT_WORD = 30.0  # wall s between two such words
_LIVES = 3.0  # wall s since the last sign of life of a process that lives; it gives one a second


class ControlError(RuntimeError):
    """A request that was not carried out; the message says why."""


class Reset(enum.IntEnum):
    """How much is set back."""

    WORLD = 1
    SIMULATION = 2


class Participant(Protocol):
    """What is looked at of a participant, see ``LockstepServer.participants``."""

    waiting: bool
    asked: float

    @property
    def heard(self) -> float:
        """Monotonic wall time in seconds at which data was last received from it."""


class Barrier(Protocol):
    """What is looked at of the lockstep's server."""

    @property
    def participants(self) -> Mapping[str, Participant]:
        """Who takes part, by name."""

    def missing(self, expected: int | Iterable[str] = 0) -> str:
        """Say who or what is missing."""


@dataclass(frozen=True)
class StepRequest:
    """What a step's caller asks for; one tick if nothing is given.

    Attributes:
        ticks: so many ticks, 0 if not given.
        until_us: to the first tick at or after this simulated time, 0 if not given.
        duration_us: to the first tick after so much simulated time, 0 if not given.
    """

    ticks: int = 0
    until_us: int = 0
    duration_us: int = 0

    def goal(self, now_us: int) -> Goal:
        """Return the goal of a step that begins now.

        Raises:
            StepError: more than one is given, or a negative duration.
        """
        if sum(1 for value in (self.ticks, self.until_us, self.duration_us) if value) > 1:
            raise StepError("ticks, until, duration: only one of them can be given")
        if self.duration_us < 0:
            raise StepError(f"duration: {self.duration_us * 1e-6:g} s is not allowed, more than 0")
        if self.until_us:
            return Goal(until_us=self.until_us)
        if self.duration_us:
            return Goal(until_us=now_us + self.duration_us)
        return Goal(ticks=self.ticks or 1)


@dataclass(frozen=True)
class StepAnswer:
    """What a step's caller gets.

    Attributes:
        success: the goal was reached.
        message: what was done, or why not.
        time_us: simulated time now.
        ticks: ticks made.
    """

    success: bool
    message: str
    time_us: int
    ticks: int


@dataclass(frozen=True)
class Status:
    """What is known of the simulation's course, as xtdrone_msgs/SimulationStatus has it; times in microseconds or s."""

    time_us: int
    tick: int
    speed: float
    measured_speed: float
    paused: bool
    stepping: bool
    participants: tuple[str, ...]
    waiting_for: tuple[str, ...]
    waiting: float
    reason: str


@dataclass
class _Asked:
    """A request that waits for the end of the tick; without ``answer`` nobody waits for it."""

    what: StepRequest | Reset
    answer: Future[Any] | None
    until: float


class Control:
    """Decides whether and how fast the world goes on.

    Attributes:
        pacer: the target speed.
        ticks: ticks so far.
        changed: something has changed that the status tells; whoever publishes it sets it back.
        held: participants (how many, or their names) that are waited for before time starts, None once it has.
    """

    def __init__(
        self,
        pacer: Pacer,
        barrier: Barrier,
        now_us: Callable[[], int],
        *,
        paused: bool = False,
        hang_limit: float = 0.0,
        info: Callable[[str], None],
        warn: Callable[[str], None],
        wall: Callable[[], float] = time.monotonic,
    ) -> None:
        """Start with time at a standstill, see :meth:`start`.

        Args:
            pacer: with the speed to start with.
            barrier: the lockstep's server.
            now_us: gives the simulated time, microseconds.
            paused: start paused.
            hang_limit: the server's, for the log.
            info: logs what was done.
            warn: logs what stands still.
            wall: gives the monotonic wall time, s.
        """
        self.pacer = pacer
        self.ticks = 0
        self.changed = True
        self.held: int | Sequence[str] | None = 0
        self._barrier = barrier
        self._now_us = now_us
        self._hang_limit = hang_limit
        self._info = info
        self._warn = warn
        self._wall = wall
        self._stepper = Stepper(paused)
        self._meter = SpeedMeter()
        self._asked: deque[_Asked] = deque()
        self._step_answer: Future[Any] | None = None
        self._names: tuple[str, ...] = ()
        self._next_word = 0.0

    # pace

    @property
    def paused(self) -> bool:
        """Whether it is paused; so it is during a step."""
        return self._stepper.paused

    @property
    def flowing(self) -> bool:
        """Whether the next tick may begin and nothing is to be done before."""
        return self._stepper.moving and not self._asked

    def start(self) -> None:
        """Time starts."""
        self.held = None
        self.changed = True

    def pause(self, caller: str) -> str:
        """Let no further tick begin; return what was done."""
        done = "it is paused already" if self.paused and self._stepper.goal is None else "paused"
        self._end_steps(self._stepper.pause(), "it was paused")
        return self._told(done, caller)

    def resume(self, caller: str) -> str:
        """Go on; return what was done."""
        done = "resumed" if self.paused else "it is running already"
        self._end_steps(self._stepper.resume(), "the simulation was resumed")
        self.pacer.restart()
        return self._told(done, caller)

    def set_speed(self, speed: float, caller: str) -> str:
        """Change the target factor; return what was done.

        Raises:
            ValueError: a speed that is not allowed.
        """
        self.pacer.set_speed(speed)
        return self._told(f"speed {speed:g}" if speed else "speed unlimited", caller)

    def _told(self, done: str, caller: str) -> str:
        self.changed = True
        text = f"{done} at {self._now_us() * 1e-6:.3f} s"
        self._info(f"{text}, by {caller}")
        return text

    # between ticks

    def ask_step(self, request: StepRequest, caller: str, answer: Future[Any]) -> None:
        """Take the wish for a step; ``answer`` gets a StepAnswer when it has ended, or cannot be made."""
        if self.held is not None:
            answer.set_result(self._refusal(f"time has not started: {self._barrier.missing(self.held)}"))
        elif self._waited_for(caller):
            answer.set_result(
                self._refusal(
                    f"{caller} takes part in the lockstep and its turn is not over: the step would wait for {caller} "
                    "for ever; call it from another node"
                )
            )
        else:
            self._asked.append(_Asked(request, answer, self._wall() + PATIENCE))

    def ask_reset(self, kind: Reset, caller: str, answer: Future[Any]) -> None:
        """Take the wish for a reset; ``answer`` gets None when it is done, or a ControlError."""
        self._info(f"reset of the {kind.name.lower()} asked for by {caller}")
        if self.held is not None:
            answer.set_result(None)  # nothing has moved yet
            return
        if self._waited_for(caller):
            answer.set_result(None)
            self._asked.append(_Asked(kind, None, float("inf")))
        else:
            self._asked.append(_Asked(kind, answer, self._wall() + PATIENCE))

    def between_ticks(self, reset: Callable[[Reset], None]) -> bool:
        """Carry out what was asked for.

        Args:
            reset: carries out a reset.

        Returns:
            Whether the next tick may begin.

        Raises:
            Exception: what ``reset`` raises; those who asked for it get it too.
        """
        kinds = [asked.what for asked in self._asked if isinstance(asked.what, Reset)]
        if kinds:
            asking = [asked for asked in self._asked if isinstance(asked.what, Reset)]
            self._asked = deque(asked for asked in self._asked if not isinstance(asked.what, Reset))
            answers = [asked.answer for asked in asking if asked.answer is not None]
            try:
                self._reset(max(kinds), reset)
            except Exception as error:
                for answer in answers:
                    answer.set_exception(ControlError(f"no reset: {type(error).__name__}: {error}"))
                raise
            for answer in answers:
                answer.set_result(None)
        while self._asked:
            asked = self._asked.popleft()
            assert isinstance(asked.what, StepRequest)
            assert asked.answer is not None
            self._begin_step(asked.what, asked.answer)
        return self._stepper.moving

    def _reset(self, kind: Reset, reset: Callable[[Reset], None]) -> None:
        self._finish_step(self._stepper.interrupt("the simulation was reset"))
        before = self._now_us()
        reset(kind)
        self.pacer.restart()
        self._meter.restart()
        self.changed = True
        self._info(f"reset of the {kind.name.lower()} at {before * 1e-6:.3f} s")

    def _begin_step(self, request: StepRequest, answer: Future[Any]) -> None:
        now = self._now_us()
        try:
            self._stepper.begin(request.goal(now), now)
        except StepError as error:
            answer.set_result(self._refusal(str(error)))
            return
        self._step_answer = answer
        self.pacer.restart()
        self.changed = True

    def ticked(self) -> None:
        """Note that a tick has ended."""
        self.ticks += 1
        self._finish_step(self._stepper.ticked(self._now_us()))

    def _end_steps(self, outcome: Outcome | None, reason: str) -> None:
        """End the step that is under way, with ``outcome``, and those that wait, for ``reason``."""
        self._finish_step(outcome)
        for asked in [asked for asked in self._asked if isinstance(asked.what, StepRequest)]:
            self._asked.remove(asked)
            if asked.answer is not None:
                asked.answer.set_result(self._refusal(reason))

    def _finish_step(self, outcome: Outcome | None) -> None:
        if outcome is None or self._step_answer is None:
            return
        answer, self._step_answer = self._step_answer, None
        now = self._now_us()
        made = f"{outcome.ticks} tick{'' if outcome.ticks == 1 else 's'}, simulated time {now * 1e-6:.3f} s"
        text = made if outcome.success else f"ended early, {outcome.reason}: {made}"
        self.changed = True
        answer.set_result(StepAnswer(outcome.success, text, now, outcome.ticks))

    def _refusal(self, reason: str) -> StepAnswer:
        return StepAnswer(False, f"no step: {reason}", self._now_us(), 0)

    # looking after it

    def tend(self) -> None:
        """Give up what has waited too long, and say for whom the world stands still; call it now and then."""
        now = self._wall()
        for asked in [asked for asked in self._asked if now >= asked.until]:
            self._asked.remove(asked)
            reason = f"the present tick has not ended within {PATIENCE:g} s: {self._standstill(now)}"
            if asked.answer is None:
                continue
            if isinstance(asked.what, Reset):
                asked.answer.set_exception(ControlError(f"no reset: {reason}"))
            else:
                asked.answer.set_result(self._refusal(reason))
        names = tuple(self._barrier.participants)
        if names != self._names:
            self._names = names
            self.changed = True
        self._report_waiting(now)

    def close(self) -> None:
        """Tell those who wait for an answer that there will be none."""
        waiting = [asked.answer for asked in self._asked] + [self._step_answer]
        self._asked.clear()
        self._step_answer = None
        for answer in waiting:
            if answer is not None:
                answer.set_exception(ClosedError("the simulator shuts down"))

    def status(self) -> Status:
        """Return how things are."""
        now = self._wall()
        waiting = self._waiting(now, _REPORTED)
        return Status(
            time_us=self._now_us(),
            tick=self.ticks,
            speed=self.pacer.speed,
            measured_speed=self._meter.factor(self._now_us(), now),
            paused=self.paused,
            stepping=self._stepper.goal is not None,
            participants=tuple(self._barrier.participants),
            waiting_for=tuple(waiting),
            waiting=max(waiting.values(), default=0.0),
            reason=self._standstill(now),
        )

    def _waited_for(self, name: str) -> bool:
        participant = self._barrier.participants.get(name)
        return participant is not None and participant.waiting

    def _waiting(self, now: float, least: float) -> dict[str, float]:
        """Return the participants that have been waited for for ``least`` wall seconds or more, with the seconds."""
        return {
            name: now - participant.asked
            for name, participant in self._barrier.participants.items()
            if participant.waiting and now - participant.asked >= least
        }

    def _standstill(self, now: float) -> str:
        """Say why the world stands still; empty while it moves."""
        if self.held is not None:
            return f"time has not started: {self._barrier.missing(self.held)}"
        waiting = self._waiting(now, _REPORTED)
        if waiting:
            return "waiting for " + ", ".join(f"{name} ({seconds:.1f} s)" for name, seconds in waiting.items())
        missing = self._barrier.missing()
        if missing:
            return missing
        return "paused" if not self._stepper.moving else ""

    def _report_waiting(self, now: float) -> None:
        """Name in the log for whom the world stands still, so that nobody has to guess at a breakpoint."""
        waiting = self._waiting(now, _FIRST_WORD)
        if not waiting:
            self._next_word = 0.0
            return
        if now < self._next_word:
            return
        self._next_word = now + _NEXT_WORD
        parts = []
        for name, seconds in waiting.items():
            silent = now - self._barrier.participants[name].heard
            how = "it lives; is it at a breakpoint?" if silent < _LIVES else self._silence(silent)
            parts.append(f"{name} for {seconds:.0f} s ({how})")
        self._warn(f"the world stands still, waiting for {', '.join(parts)}")

    def _silence(self, silent: float) -> str:
        end = f"dropped after {self._hang_limit:g} s" if self._hang_limit else "hang_limit is 0: never dropped"
        return f"silent for {silent:.0f} s; {end}"
