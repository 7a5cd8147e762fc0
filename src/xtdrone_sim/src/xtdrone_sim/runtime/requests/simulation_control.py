"""Control of the running simulation: speed, pause, hold, step, reset. Independent of ROS, see ``control_services``.

All methods are called in the simulator's own thread. Changes of speed and pause take effect immediately, even while the
barrier waits for a participant. Steps, resets and changes are executed between ticks, and their callers wait for the
answer. A hold (see ``holds``) is granted at the end of a tick. A participant must not wait for the end of its own tick:
during its turn, its requests for steps and holds are rejected, and its requests for resets and changes are answered
immediately and executed after the tick.
"""

from __future__ import annotations

import enum
import time
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from dataclasses import dataclass
from typing import Any

from xtdrone_lockstep.server import LockstepServer
from xtdrone_sim.mailbox import ClosedError
from xtdrone_sim.runtime.requests.pacing import Pacer, SpeedMeter
from xtdrone_sim.runtime.requests.standstills import HoldAnswer, Holder, Holds, SlowParticipants
from xtdrone_sim.runtime.requests.stepping import Goal, Outcome, StepError, Stepper

PATIENCE = 10.0
"""Longest wait of a step, a hold or a reset for the end of the current tick, wall s."""
STEP_PATIENCE = 30.0
"""Wall s without a tick after which a step is given up that the lockstep holds up."""


class ControlError(RuntimeError):
    """A request that was not carried out; the message gives the reason."""


class Reset(enum.IntEnum):
    """Scope of a reset: the world, or the world and simulated time."""

    WORLD = 1
    SIMULATION = 2


@dataclass(frozen=True)
class WorldChange:
    """A change of the simulated world, made between ticks.

    Attributes:
        what: its name in texts, such as ``reset of iris_3``.
        make: makes it and returns a description; raises ValueError or OSError if it is not allowed, after which
            nothing has changed.
    """

    what: str
    make: Callable[[], Any]


@dataclass(frozen=True)
class StepRequest:
    """A request for a step; one tick if all attributes are 0.

    Attributes:
        ticks: number of ticks, 0 if not given.
        until_us: step to the first tick at or after this simulated time, microseconds; 0 if not given.
        duration_us: step to the first tick at least this much simulated time ahead, microseconds; 0 if not given.
    """

    ticks: int = 0
    until_us: int = 0
    duration_us: int = 0

    def goal(self, now_us: int) -> Goal:
        """Return the goal of a step that begins now.

        Raises:
            StepError: more than one attribute is given, or the duration is negative.
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
    """The response to a step request.

    Attributes:
        success: whether the goal was reached.
        message: summary of the step, or the reason for its failure.
        time_us: current simulated time, microseconds.
        ticks: number of ticks made.
    """

    success: bool
    message: str
    time_us: int
    ticks: int


@dataclass(frozen=True)
class Status:
    """State of the simulation, see xtdrone_msgs/SimulationStatus; ``time_us`` in microseconds, ``waiting`` in s."""

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
    """A request that is queued until the end of the tick.

    Attributes:
        request: the step, the hold, the reset or the change.
        answer: future of the caller; None if the caller has been answered already.
        until: monotonic wall time at which the request times out, s.
        caller: node that asked for a step.
    """

    request: StepRequest | Holder | Reset | WorldChange
    answer: Future[Any] | None
    until: float
    caller: str = ""


class Control:
    """Controls whether and how fast simulated time advances.

    Attributes:
        pacer: the target speed.
        ticks: number of ticks so far.
        changed: the status has changed; the publisher of the status clears the flag.
        held: participants (their number or names) required before time starts; None once it has started.
    """

    def __init__(
        self,
        pacer: Pacer,
        barrier: LockstepServer,
        now_us: Callable[[], int],
        *,
        paused: bool = False,
        hang_limit: float = 0.0,
        info: Callable[[str], None],
        warn: Callable[[str], None],
        wall: Callable[[], float] = time.monotonic,
    ) -> None:
        """Hold time until :meth:`start` is called.

        Args:
            pacer: pacer, set to the initial speed.
            barrier: lockstep server.
            now_us: returns the simulated time, microseconds.
            paused: whether to start paused.
            hang_limit: hang limit of the server, wall s; used in log texts.
            info: logs completed requests.
            warn: logs standstills.
            wall: returns the monotonic wall time, s.
        """
        self.pacer = pacer
        self.ticks = 0
        self.changed = True
        self.held: int | Sequence[str] | None = 0
        self._barrier = barrier
        self._now_us = now_us
        self._info = info
        self._warn = warn
        self._wall = wall
        self._stepper = Stepper(paused)
        self._meter = SpeedMeter()
        self._asked: deque[_Asked] = deque()
        self._step_answer: Future[Any] | None = None
        self._stepper_name = ""  # the caller of the current step
        self._holds = Holds(wall)
        self._holding: list[_Asked] = []  # holds that wait for the end of the next tick
        self._moved = wall()  # when the last tick or step began or ended
        self._names: tuple[str, ...] = ()
        self._slow = SlowParticipants(barrier, hang_limit, warn)

    # pace

    @property
    def paused(self) -> bool:
        """Whether the simulation is paused; also true during a step."""
        return self._stepper.paused

    @property
    def flowing(self) -> bool:
        """Whether the next tick may begin and no request is queued before it."""
        return self._moving and not self._asked

    @property
    def _moving(self) -> bool:
        return self._stepper.moving and not self._holds

    def start(self) -> None:
        """Start simulated time."""
        self.held = None
        self.changed = True

    def pause(self, caller: str) -> str:
        """Pause after the current tick; return a description of the change."""
        done = "it is already paused" if self.paused and self._stepper.goal is None else "paused"
        self._end_steps(self._stepper.pause(), "it was paused")
        return self._log_change(done, caller)

    def resume(self, caller: str) -> str:
        """Resume; return a description of the change."""
        done = "resumed" if self.paused else "it is already running"
        self._end_steps(self._stepper.resume(), "the simulation was resumed")
        self.pacer.restart()
        return self._log_change(done, caller)

    def set_speed(self, speed: float, caller: str) -> str:
        """Set the target real-time factor; return a description of the change.

        Raises:
            ValueError: the speed is not allowed.
        """
        self.pacer.set_speed(speed)
        return self._log_change(f"speed {speed:g}" if speed else "speed unlimited", caller)

    def _log_change(self, done: str, caller: str) -> str:
        self.changed = True
        text = f"{done} at {self._now_us() * 1e-6:.3f} s"
        self._info(f"{text}, by {caller}")
        return text

    # between ticks

    def ask_step(self, request: StepRequest, caller: str, answer: Future[Any]) -> None:
        """Queue a step; ``answer`` receives a StepAnswer when it has ended or was rejected."""
        if self.held is not None:
            answer.set_result(self._refusal(f"time has not started: {self._barrier.missing(self.held)}"))
        elif self._waited_for(caller):
            answer.set_result(
                self._refusal(
                    f"{caller} takes part in the lockstep and its turn is not over: the step would wait for {caller} "
                    "forever; call it from another node"
                )
            )
        else:
            self._asked.append(_Asked(request, answer, self._wall() + PATIENCE, caller))

    def ask_hold(self, holder: Holder, answer: Future[Any]) -> None:
        """Queue a hold; ``answer`` receives a HoldAnswer when time stands still, or the hold was rejected.

        In a running simulation time stands at the end of the next tick that participants take part in, which a replay
        reaches, too; in one that stands still already, at once.
        """
        if self.held is not None:
            self._grant_hold(holder, answer)
        elif self._waited_for(holder.name):
            answer.set_result(self._hold_refusal(f"the turn of {holder.name} in the lockstep is not over"))
        else:
            self._asked.append(_Asked(holder, answer, self._wall() + PATIENCE))

    def let_go(self, holder: Holder) -> str:
        """End a hold; return a description of the change."""
        self._holding = [asked for asked in self._holding if asked.request != holder]
        if not self._holds.end(holder):
            return "time was not held"
        self._time_goes_on()
        return "let go"

    def ask_reset(self, kind: Reset, caller: str, answer: Future[Any]) -> None:
        """Queue a reset; ``answer`` receives None when it is complete, or a ControlError."""
        self._info(f"reset of the {kind.name.lower()} asked for by {caller}")
        if self.held is not None:
            answer.set_result(None)  # nothing has moved yet
            return
        if self._waited_for(caller):
            answer.set_result(None)
            self._asked.append(_Asked(kind, None, float("inf")))
        else:
            self._asked.append(_Asked(kind, answer, self._wall() + PATIENCE))

    def ask_change(self, change: WorldChange, caller: str, answer: Future[Any]) -> None:
        """Queue a change; ``answer`` receives its description when it is made, or a ControlError.

        A participant in its own turn is answered at once, and the change is made after the tick.
        """
        self._info(f"{change.what} asked for by {caller}")
        if self.held is not None:
            self._make(change, answer)
        elif self._waited_for(caller):
            answer.set_result(f"{change.what}: follows after this tick")
            self._asked.append(_Asked(change, None, float("inf")))
        else:
            self._asked.append(_Asked(change, answer, self._wall() + PATIENCE))

    def _make(self, change: WorldChange, answer: Future[Any] | None) -> None:
        try:
            done = change.make()
        except (ValueError, OSError) as error:
            self._warn(f"no {change.what}: {error}")
            if answer is not None:
                answer.set_exception(ControlError(str(error)))
            return
        self.changed = True
        self._info(f"{change.what} at {self._now_us() * 1e-6:.3f} s")
        if answer is not None:
            answer.set_result(done)

    def between_ticks(self, reset: Callable[[Reset], None]) -> bool:
        """Execute the queued requests.

        Args:
            reset: executes a reset.

        Returns:
            Whether the next tick may begin.

        Raises:
            Exception: raised by ``reset``; the callers that requested the reset receive a ControlError.
        """
        kinds = [asked.request for asked in self._asked if isinstance(asked.request, Reset)]
        if kinds:
            asking = [asked for asked in self._asked if isinstance(asked.request, Reset)]
            self._asked = deque(asked for asked in self._asked if not isinstance(asked.request, Reset))
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
            if isinstance(asked.request, WorldChange):
                self._make(asked.request, asked.answer)
                continue
            assert asked.answer is not None
            if isinstance(asked.request, Holder):
                self._begin_hold(asked, asked.request, asked.answer)
                continue
            assert isinstance(asked.request, StepRequest)
            self._begin_step(asked.request, asked.answer, asked.caller)
        if not self._stepper.moving:  # paused before the tick that holds wait for
            self._grant_holds()
        return self._moving

    def _begin_hold(self, asked: _Asked, holder: Holder, answer: Future[Any]) -> None:
        if self._stepper.goal is not None and not self._holds:
            answer.set_result(self._hold_refusal(f"a step of {self._stepper_name} is in progress"))
        elif self._stepper.paused or self._holds or self.ticks == 0:
            self._grant_hold(holder, answer)
        else:
            self._holding.append(asked)
            self.pacer.restart()  # the tick begins at once

    def _grant_holds(self) -> None:
        """Grant the holds that have waited for the end of a tick."""
        for asked in self._holding:
            assert isinstance(asked.request, Holder)
            assert asked.answer is not None
            self._grant_hold(asked.request, asked.answer)
        self._holding.clear()

    def _grant_hold(self, holder: Holder, answer: Future[Any]) -> None:
        self._holds.begin(holder)
        self.changed = True
        answer.set_result(HoldAnswer(True, "held", self.ticks, self._now_us()))

    def _hold_refusal(self, reason: str) -> HoldAnswer:
        return HoldAnswer(False, f"no hold: {reason}", self.ticks, self._now_us())

    def _time_goes_on(self) -> None:
        self.pacer.restart()
        self._moved = self._wall()
        self.changed = True

    def _reset(self, kind: Reset, reset: Callable[[Reset], None]) -> None:
        self._finish_step(self._stepper.interrupt("the simulation was reset"))
        before = self._now_us()
        reset(kind)
        self.pacer.restart()
        self._meter.restart()
        self.changed = True
        self._info(f"reset of the {kind.name.lower()} at {before * 1e-6:.3f} s")

    def _begin_step(self, request: StepRequest, answer: Future[Any], caller: str) -> None:
        now = self._now_us()
        try:
            self._stepper.begin(request.goal(now), now)
        except StepError as error:
            other = f", that of {self._stepper_name}; a pause ends it" if self._stepper.goal is not None else ""
            answer.set_result(self._refusal(f"{error}{other}"))
            return
        self._step_answer, self._stepper_name = answer, caller
        self._time_goes_on()

    def ticked(self) -> None:
        """Count a tick that has ended, finish a step that has reached its goal, and grant the holds that wait."""
        self.ticks += 1
        self._moved = self._wall()
        self._finish_step(self._stepper.ticked(self._now_us()))
        self._grant_holds()

    def _end_steps(self, outcome: Outcome | None, reason: str) -> None:
        """End the current step with ``outcome``, and reject the queued ones for ``reason``."""
        self._finish_step(outcome)
        for asked in [asked for asked in self._asked if isinstance(asked.request, StepRequest)]:
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

    # supervision

    def tend(self) -> None:
        """Time out requests, steps and holds, and log participants that hold up the world; called periodically."""
        now = self._wall()
        self._end_overdue_holds()
        self._give_up_step(now)
        for asked in [asked for asked in (*self._asked, *self._holding) if now >= asked.until]:
            (self._asked if asked in self._asked else self._holding).remove(asked)
            reason = f"the current tick has not ended within {PATIENCE:g} s: {self._standstill(now)}"
            if asked.answer is None:
                continue
            if isinstance(asked.request, Reset):
                asked.answer.set_exception(ControlError(f"no reset: {reason}"))
            elif isinstance(asked.request, WorldChange):
                asked.answer.set_exception(ControlError(f"no {asked.request.what}: {reason}"))
            elif isinstance(asked.request, Holder):
                asked.answer.set_result(self._hold_refusal(reason))
            else:
                asked.answer.set_result(self._refusal(reason))
        names = tuple(self._barrier.participants)
        if names != self._names:
            self._names = names
            self.changed = True
        self._slow.report(now)

    def _end_overdue_holds(self) -> None:
        texts = self._holds.end_overdue()
        for text in texts:
            self._warn(text)
        if texts:
            self._time_goes_on()

    def _give_up_step(self, now: float) -> None:
        """End a step that the lockstep holds up: its caller would wait for ever."""
        if self._stepper.goal is None or self._holds or now - self._moved < STEP_PATIENCE:
            return
        if not (self._slow.waiting(now) or self._barrier.missing()):
            return  # a slow speed
        reason = f"no tick has ended within {STEP_PATIENCE:g} s: {self._standstill(now)}"
        self._warn(f"the step of {self._stepper_name} is given up: {reason}")
        self._finish_step(self._stepper.interrupt(reason))

    def close(self) -> None:
        """Answer all pending requests with a ClosedError."""
        waiting = [asked.answer for asked in (*self._asked, *self._holding)] + [self._step_answer]
        self._asked.clear()
        self._holding.clear()
        self._step_answer = None
        for answer in waiting:
            if answer is not None:
                answer.set_exception(ClosedError("the simulator shuts down"))

    def status(self) -> Status:
        """Return the current status."""
        now = self._wall()
        waiting = self._slow.waiting(now)
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

    def _standstill(self, now: float) -> str:
        """Return the reason why the world stands still; "" while it moves."""
        if self.held is not None:
            return f"time has not started: {self._barrier.missing(self.held)}"
        waiting = self._slow.waiting(now)
        if waiting:
            return "waiting for " + ", ".join(f"{name} ({seconds:.1f} s)" for name, seconds in waiting.items())
        missing = self._barrier.missing()
        if missing:
            return missing
        if self._holds:
            return f"held by {self._holds.names}"
        return "paused" if not self._stepper.moving else ""
