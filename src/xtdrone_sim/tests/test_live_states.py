"""States by wall time: the rate of publishing, with a clock set by the test."""

from __future__ import annotations

from typing import Any

import pytest

pytest.importorskip("rospy")

from gazebo_msgs.msg import ModelStates

import xtdrone_lockstep as lockstep
from xtdrone_sim.topics.model_states import PERIOD, STANDING_PERIOD, LiveStates


class Topic:
    """The topic's publisher, with fake subscribers."""

    def __init__(self, *_: Any, **__: Any) -> None:
        self.subscribers = 1
        self.messages: list[ModelStates] = []

    def get_num_connections(self) -> int:
        return self.subscribers

    def publish(self, message: ModelStates) -> None:
        self.messages.append(message)


class Bench:
    """Live states with a clock set by the test."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now = 0.0
        self.topic = Topic()
        self.made = 0
        monkeypatch.setattr(lockstep, "UncountedPublisher", lambda *_, **__: self.topic)
        self.live = LiveStates(self._states, lambda: self.now)

    def _states(self) -> ModelStates:
        self.made += 1
        return ModelStates(name=[str(self.made)])

    def tick(self, seconds: float) -> None:
        self.now += seconds
        self.live.ticked()

    def stand(self, seconds: float) -> None:
        self.now += seconds
        self.live.stands()


def test_fast_ticks_are_shown_at_the_rate_of_the_wall_clock(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench(monkeypatch)
    for _ in range(1000):
        bench.tick(0.001)
    assert 1.0 / PERIOD - 2 <= len(bench.topic.messages) <= 1.0 / PERIOD + 1
    assert bench.made == len(bench.topic.messages)  # no message is built in vain


def test_slow_ticks_are_all_shown_and_none_without_subscribers(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench(monkeypatch)
    for _ in range(5):
        bench.tick(2.0 * PERIOD)
    assert len(bench.topic.messages) == 5
    bench.topic.subscribers = 0
    bench.tick(1.0)
    bench.stand(1.0)
    assert bench.made == 5


def test_the_last_tick_is_shown_when_time_stands_and_again_for_newcomers(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench(monkeypatch)
    bench.tick(1.0)
    bench.tick(0.1 * PERIOD)  # the last one, too early
    bench.stand(0.1 * PERIOD)
    assert len(bench.topic.messages) == 1
    bench.stand(PERIOD)
    assert len(bench.topic.messages) == 2
    bench.stand(0.9 * STANDING_PERIOD)
    assert len(bench.topic.messages) == 2
    bench.stand(0.2 * STANDING_PERIOD)
    assert len(bench.topic.messages) == 3
