"""Due measurements of a sensor: each once, in order, none before the first time, for turns of any length."""

from __future__ import annotations

from dataclasses import dataclass

import pytest
from hypothesis import given
from hypothesis import strategies as st

from xtdrone_common.settings import SettingError, Settings
from xtdrone_sim.sensors.sensor_nodes import Due, rate_setting, time_us

RATES = st.floats(0.1, 50.0)


@given(RATES, st.integers(0, 1), st.integers(0, 10**9), st.lists(st.integers(0, 200_000), min_size=1, max_size=20))
def test_each_measurement_is_due_once(rate: float, periods: int, first_us: int, turns_us: list[int]) -> None:
    due, last_us, numbers = Due(rate, periods), first_us, []
    for turn_us in turns_us:
        last_us += turn_us
        numbers += due.numbers(first_us, last_us)
    near = range(max(0, int(first_us * 1e-6 * rate) - 2), int(last_us * 1e-6 * rate) + 3)
    expected = [k for k in near if time_us(rate, k) >= first_us and time_us(rate, k + periods) <= last_us]
    assert numbers == expected


def test_after_a_restart_it_begins_at_the_time_that_is_given_then() -> None:
    due = Due(10.0)
    assert list(due.numbers(250_000, 500_000)) == [3, 4, 5]
    due.restart()
    assert list(due.numbers(0, 100_000)) == [0, 1]


@dataclass(frozen=True)
class _Node(Settings):
    rate: float = rate_setting(0.5, 50.0, "measurements per second")


@pytest.mark.parametrize("rate", [0.0, 0.5, 50.0])
def test_a_rate_is_that_of_each_sensor_or_within_the_limits(rate: float) -> None:
    assert _Node(rate).rate == rate


@pytest.mark.parametrize("rate", [-1.0, 0.1, 51.0])
def test_another_rate_is_an_error(rate: float) -> None:
    with pytest.raises(SettingError, match=r"0, or 0\.5 to 50 Hz"):
        _Node(rate)
