"""Pause, step, speed and reset with a clock and a barrier moved by the test: no ROS, no waiting."""

from __future__ import annotations

import threading
from collections.abc import Iterable
from concurrent.futures import Future
from dataclasses import dataclass, field

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from xtdrone_sim.mailbox import ClosedError, Mailbox
from xtdrone_sim.runtime.requests.pacing import Pacer
from xtdrone_sim.runtime.requests.simulation_control import (
    PATIENCE,
    STEP_PATIENCE,
    Control,
    ControlError,
    Reset,
    StepAnswer,
    StepRequest,
)
from xtdrone_sim.runtime.requests.standstills import LONGEST_HOLD, HoldAnswer, Holder
from xtdrone_sim.runtime.requests.stepping import Goal, StepError, Stepper

TICK_US = 20_000
TICK = TICK_US * 1e-6


@dataclass
class FakeParticipant:
    waiting: bool = False
    asked: float = 0.0
    heard: float = 0.0


@dataclass
class FakeBarrier:
    participants: dict[str, FakeParticipant] = field(default_factory=dict)
    text: str = ""

    def missing(self, expected: int | Iterable[str] = 0) -> str:
        return self.text


@dataclass(eq=False)
class FakeConnection:
    is_open: bool = True

    def is_alive(self) -> bool:
        return self.is_open


class Loop:
    """The simulator's loop as in the node, with a wall clock set by the test."""

    def __init__(self, speed: float = 1.0, *, paused: bool = False, cost: float = 0.0, started: bool = True) -> None:
        self.wall = 100.0
        self.now_us = 0
        self.cost = cost
        self.barrier = FakeBarrier()
        self.words: list[str] = []
        self.resets: list[Reset] = []
        self.control = Control(
            Pacer(speed),
            self.barrier,
            lambda: self.now_us,
            paused=paused,
            info=lambda text: None,
            warn=self.words.append,
            wall=lambda: self.wall,
        )
        if started:
            self.control.start()
        self._pacing = False

    def run(self, seconds: float) -> None:
        """Wait in wall time."""
        until = self.wall + seconds
        while self.wall < until:
            if self._pacing:
                self._pace(until)
            elif self.control.between_ticks(self._reset):
                self.now_us += TICK_US
                self.wall += self.cost
                self.control.ticked()
                self._pacing = True
            else:
                self.wall = until

    def _pace(self, until: float) -> None:
        if self.control.flowing:
            delay = self.control.pacer.delay(self.now_us, self.wall)
            if delay > 0.0:
                self.wall = min(self.wall + delay, until)
                return
        self._pacing = False

    def _reset(self, kind: Reset) -> None:
        self.resets.append(kind)
        if kind is Reset.SIMULATION:
            self.now_us = 0

    def step(self, caller: str = "/user", **request: int) -> Future[StepAnswer]:
        answer: Future[StepAnswer] = Future()
        self.control.ask_step(StepRequest(**request), caller, answer)
        return answer

    def reset(self, kind: Reset, caller: str = "/user") -> Future[None]:
        answer: Future[None] = Future()
        self.control.ask_reset(kind, caller, answer)
        return answer

    def hold(self, holder: Holder) -> Future[HoldAnswer]:
        answer: Future[HoldAnswer] = Future()
        self.control.ask_hold(holder, answer)
        return answer

    def stuck(self, name: str, caller_waits: float = 0.0) -> None:
        """Make the barrier wait for a participant for some seconds."""
        participant = self.barrier.participants[name]
        participant.waiting, participant.asked = True, self.wall
        self.wall += caller_waits
        self.control.tend()


ACTIONS = st.one_of(
    st.tuples(st.just("speed"), st.sampled_from([0.01, 0.2, 1.0, 5.0])),
    st.tuples(st.just("pause"), st.none()),
    st.tuples(st.just("resume"), st.none()),
    st.tuples(st.just("step"), st.integers(1, 50)),
)


@settings(deadline=None, max_examples=150)
@given(
    actions=st.lists(st.tuples(ACTIONS, st.floats(0.05, 3.0)), min_size=1, max_size=12),
    cost=st.sampled_from([0.0, 0.001]),
    paused=st.booleans(),
)
def test_simulated_time_follows_the_requested_speed(actions, cost, paused):
    loop = Loop(1.0, paused=paused, cost=cost)
    steps: list[tuple[Future, int]] = []
    for (kind, value), seconds in actions:
        if kind == "speed":
            loop.control.set_speed(value, "/user")
        elif kind == "pause":
            loop.control.pause("/user")
        elif kind == "resume":
            loop.control.resume("/user")
        else:
            steps.append((loop.step(ticks=value), value))
        still = loop.control.paused and kind != "step" and not loop.control.status().stepping
        before_us, before = loop.now_us, loop.wall
        loop.run(seconds)
        passed, wall = (loop.now_us - before_us) * 1e-6, loop.wall - before
        speed = loop.control.pacer.speed
        if still:
            assert passed == 0.0
        assert passed <= speed * wall + 2.0 * TICK + 1e-9
        if not loop.control.paused and cost * speed < TICK:
            assert passed >= speed * wall - 2.0 * TICK - 1e-9
    loop.control.resume("/user")
    loop.run(0.1)
    for answer, wanted in steps:
        result = answer.result(timeout=0)
        assert result.ticks == wanted if result.success else result.ticks < wanted


def test_five_ticks_are_five():
    loop = Loop(1.0, paused=True)
    answer = loop.step(ticks=5)
    loop.run(10.0)
    assert answer.result(timeout=0) == StepAnswer(True, "5 ticks, simulated time 0.100 s", 5 * TICK_US, 5)
    assert loop.now_us == 5 * TICK_US
    assert loop.control.paused


def test_a_step_without_anything_is_one_tick():
    loop = Loop(1.0, paused=True)
    assert loop.step() is not None
    loop.run(1.0)
    assert loop.now_us == TICK_US


@pytest.mark.parametrize(("request_us", "end_us"), [(90_000, 100_000), (100_000, 100_000), (1, 20_000)])
def test_until_ends_at_the_first_tick_not_before_it(request_us, end_us):
    loop = Loop(0.0, paused=True)
    answer = loop.step(until_us=request_us)
    loop.run(1.0)
    assert answer.result(timeout=0).time_us == loop.now_us == end_us


def test_duration_counts_from_now():
    loop = Loop(0.0, paused=True)
    for _ in range(2):
        answer = loop.step(duration_us=50_000)
        loop.run(1.0)
    assert answer.result(timeout=0).time_us == 120_000


@pytest.mark.parametrize(
    ("request_", "words"),
    [
        ({"until_us": 20_000}, "until: 0.020 s is not allowed, the simulated time is already 0.020 s"),
        ({"duration_us": -4000}, "duration: -0.004 s is not allowed"),
        ({"ticks": 1, "until_us": 4000}, "only one of them"),
    ],
)
def test_impossible_steps_are_rejected(request_, words):
    loop = Loop(0.0, paused=True)
    loop.step()
    loop.run(1.0)
    answer = loop.step(**request_)
    loop.run(1.0)
    result = answer.result(timeout=0)
    assert not result.success
    assert words in result.message
    assert loop.now_us == TICK_US


def test_a_running_step_is_ended_by_the_next_command():
    for end, words in (
        (lambda loop: loop.control.pause("/user"), "it was paused"),
        (lambda loop: loop.control.resume("/user"), "resumed"),
        (lambda loop: loop.reset(Reset.WORLD), "reset"),
    ):
        loop = Loop(1.0, paused=True)
        first = loop.step(ticks=100)
        loop.run(0.21)
        second = loop.step(ticks=1)
        loop.run(0.01)
        assert "another step is in progress" in second.result(timeout=0).message
        end(loop)
        loop.run(0.01)
        result = first.result(timeout=0)
        assert not result.success
        assert 10 <= result.ticks <= 14
        assert words in result.message


def test_a_participant_in_its_turn_cannot_step_but_pause_and_reset():
    loop = Loop(1.0)
    loop.barrier.participants["/follower"] = FakeParticipant(waiting=True, asked=loop.wall)
    refused = loop.step("/follower").result(timeout=0)
    assert not refused.success
    assert "/follower" in refused.message
    done = loop.reset(Reset.SIMULATION, "/follower")
    assert done.done()  # at once: a client inside a tick cannot wait for the end of that tick
    assert loop.resets == []  # but nothing has changed yet
    loop.barrier.participants["/follower"].waiting = False
    loop.run(0.001)
    assert loop.resets == [Reset.SIMULATION]


def test_resets_of_one_tick_are_one():
    loop = Loop(1.0)
    answers = [loop.reset(kind) for kind in (Reset.WORLD, Reset.SIMULATION, Reset.WORLD)]
    loop.run(0.001)
    assert loop.resets == [Reset.SIMULATION]
    assert all(answer.done() for answer in answers)


def test_runs_that_cannot_start_fail_with_the_reason():
    loop = Loop(1.0)
    loop.barrier.participants["/follower"] = FakeParticipant()
    step, reset = loop.step(), loop.reset(Reset.WORLD)
    loop.stuck("/follower", PATIENCE - 0.1)
    assert not step.done()
    loop.wall += 0.2
    loop.control.tend()
    assert "waiting for /follower (10.1 s)" in step.result(timeout=0).message
    with pytest.raises(ControlError, match="waiting for /follower"):
        reset.result(timeout=0)
    loop.barrier.participants["/follower"].waiting = False
    loop.run(1.0)
    assert loop.resets == []  # the client has been told that no reset was made


# ---- holds


def holder(name: str = "/station") -> Holder:
    return Holder(name, FakeConnection())


def test_a_hold_stands_between_two_ticks_until_it_is_let_go():
    loop = Loop(1.0)
    loop.run(0.1)
    station = holder()
    answer = loop.hold(station)
    loop.run(1.0)
    held = answer.result(timeout=0)
    assert (held.success, held.tick, held.time_us) == (True, loop.control.ticks, loop.now_us)
    assert loop.control.status().reason == "held by /station"
    assert not loop.control.paused
    step = loop.step(ticks=3)  # a user's
    loop.run(1.0)
    assert loop.now_us == held.time_us
    loop.control.let_go(station)
    loop.run(1.0)
    assert step.result(timeout=0).ticks == 3
    assert loop.control.paused  # as the user asked: a hold changes no pause
    assert loop.control.let_go(station) == "time was not held"


@pytest.mark.parametrize("end", ["killed", "suspended"])
@pytest.mark.parametrize("paused", [False, True])
def test_a_hold_ends_with_its_holder_and_a_pause_does_not(end, paused):
    loop = Loop(1.0, paused=paused)
    killed, other = holder(), holder("/other")
    loop.run(0.1)
    for one in (killed, other):
        loop.hold(one)
    loop.run(0.1)
    before = loop.now_us
    if end == "killed":
        killed.connection.is_open = False
    else:
        loop.run(LONGEST_HOLD - 1.0)
        loop.hold(other)  # once more
    loop.run(1.0)
    loop.control.tend()
    why = "its connection has closed" if end == "killed" else "it has held time for 5 s"
    assert loop.words == [f"the hold of /station ends: {why}"]
    loop.run(1.0)
    assert loop.now_us == before  # the other one holds
    loop.control.let_go(other)
    loop.run(100.0)
    assert (loop.now_us == before) is paused


def test_a_hold_that_cannot_begin_is_refused_with_the_reason():
    loop = Loop(1.0)
    loop.barrier.participants["/follower"] = FakeParticipant(waiting=True, asked=loop.wall)
    assert "turn of /follower" in loop.hold(holder("/follower")).result(timeout=0).message
    loop.run(0.1)
    waiting = loop.hold(holder())
    assert loop.control.between_ticks(loop._reset)  # the tick that the hold waits for begins, and hangs
    loop.stuck("/follower", PATIENCE + 1.0)
    assert "waiting for /follower (11.0 s)" in waiting.result(timeout=0).message
    loop.barrier.participants.clear()
    step = loop.step(ticks=100)
    loop.run(0.1)
    assert loop.hold(holder()) is not None
    refused = loop.hold(holder())
    loop.run(0.1)
    assert refused.result(timeout=0).message == "no hold: a step of /user is in progress"
    assert not step.done()


def test_a_pause_before_the_tick_that_a_hold_waits_for_grants_it():
    loop = Loop(1.0)
    loop.run(0.1)
    answer = loop.hold(holder())
    assert loop.control.between_ticks(loop._reset)
    loop.control.pause("/user")
    loop.run(0.1)
    assert answer.result(timeout=0).success


def test_a_step_that_cannot_end_is_given_up_and_a_slow_one_is_not():
    loop = Loop(0.01, paused=True)
    slow = loop.step(ticks=50)  # 2 s of wall time each
    loop.run(STEP_PATIENCE + 10.0)
    loop.control.tend()
    assert not slow.done()
    loop.barrier.participants["/follower"] = FakeParticipant()
    loop.stuck("/follower", STEP_PATIENCE)
    loop.stuck("/follower", 0.0)
    result = slow.result(timeout=0)
    assert not result.success
    assert "no tick has ended within 30 s: waiting for /follower (30.0 s)" in result.message
    assert "the step of /user is given up" in " ".join(loop.words)
    assert loop.control.paused


def test_the_log_names_the_participant_that_time_waits_for():
    loop = Loop(1.0)
    loop.barrier.participants |= {"/quick": FakeParticipant(), "/slow": FakeParticipant(heard=loop.wall + 5.0)}
    loop.stuck("/slow", 4.0)
    assert loop.words == []
    assert loop.control.status().waiting_for == ("/slow",)
    loop.wall += 2.0
    loop.control.tend()
    loop.control.tend()
    assert loop.words == ["the world stands still, waiting for /slow for 6 s (it is alive; is it at a breakpoint?)"]
    loop.wall += 31.0
    loop.control.tend()
    assert "silent for 32 s; hang_limit is 0" in loop.words[1]


def test_nothing_steps_before_time_starts():
    loop = Loop(1.0, started=False)
    loop.barrier.text = "1 of 3 participants have joined"
    assert "1 of 3 participants" in loop.step().result(timeout=0).message
    assert loop.reset(Reset.SIMULATION).done()
    assert loop.control.status().reason == "time has not started: 1 of 3 participants have joined"


def test_the_end_releases_all_waiting_clients():
    loop = Loop(1.0, paused=True)
    answers = [loop.step(ticks=100)]
    loop.run(0.1)
    answers += [loop.step(), loop.reset(Reset.WORLD)]
    loop.control.close()
    for answer in answers:
        with pytest.raises(ClosedError):
            answer.result(timeout=0)


def test_a_goal_is_needed():
    with pytest.raises(StepError, match="no goal"):
        Stepper().begin(Goal(), 0)
    with pytest.raises(StepError, match="ticks: 0"):
        Stepper().begin(Goal(ticks=0), 0)


def test_mailbox_brings_requests_to_the_thread_that_serves():
    mailbox = Mailbox()
    threads: list[int] = []

    def act(answer: Future) -> None:
        threads.append(threading.get_ident())
        answer.set_result("done")

    def fail(answer: Future) -> None:
        raise ValueError("bad")

    answers: list[Future] = []
    caller = threading.Thread(target=lambda: answers.extend([mailbox.put(act), mailbox.put(fail)]))
    caller.start()
    caller.join()
    mailbox.serve()
    assert answers[0].result(timeout=0) == "done"
    assert threads == [threading.get_ident()]
    with pytest.raises(ValueError, match="bad"):
        answers[1].result(timeout=0)
    late = mailbox.put(act)
    mailbox.close()
    for answer in (late, mailbox.put(act)):
        with pytest.raises(ClosedError):
            answer.result(timeout=0)
    assert len(threads) == 1


def test_a_failed_reset_is_reported_to_its_clients_and_the_simulator():
    loop = Loop(1.0, paused=True)
    answers = [loop.reset(Reset.WORLD), loop.reset(Reset.SIMULATION)]

    def fail(kind: Reset) -> None:
        raise RuntimeError(f"{kind.name} cannot be set back")

    with pytest.raises(RuntimeError, match="SIMULATION cannot be set back"):
        loop.control.between_ticks(fail)
    for answer in answers:
        with pytest.raises(ControlError, match="no reset: RuntimeError: SIMULATION cannot"):
            answer.result(timeout=0)
