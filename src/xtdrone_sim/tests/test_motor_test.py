"""MAV_CMD_ACTUATOR_TEST: motors of a disarmed vehicle turn, within the rules of PX4 v1.14."""

from __future__ import annotations

import math
import struct

import numpy as np
import pytest

from xtdrone_autopilot.commander.commander import Result
from xtdrone_autopilot.mavlink.streams.telemetry import Telemetry
from xtdrone_common.fleet import parse_fleet
from xtdrone_sim.simulation import Simulation

BOOTED_US = 2_000_000


class Bench:
    """Two disarmed vehicles, of which the first is tested."""

    def __init__(self) -> None:
        self.simulation = Simulation(parse_fleet("iris:2"), seed=3)
        self.simulation.run_until(BOOTED_US)

    @property
    def commander(self):
        return self.simulation.commanders[0]

    def test(self, motor, value, seconds=1.0):
        return self.commander.test_actuator(motor, value, seconds)

    def run(self, seconds):
        self.simulation.run_until(self.simulation.time_us + round(seconds * 1e6))

    def turning(self, vehicle=0):
        """Return the numbers, from 1, of the motors that turn according to ESC telemetry."""
        reports = Telemetry(self.simulation.commanders[vehicle], self.simulation.autopilot, vehicle)
        ((_, *speeds, _, _, _, _, _, _, _, _, _),) = reports.devices.esc_status()
        return [i for i, speed in enumerate(speeds[:4], 1) if speed > 100]


@pytest.fixture
def bench():
    made = Bench()
    yield made
    made.simulation.close()


def test_one_motor_turns_on_the_ground_and_stops_in_time(bench):
    before = bench.simulation.world.plant["position"][0].copy()
    assert bench.test(2, 0.2) == Result.ACCEPTED
    bench.run(0.9)
    assert bench.turning() == [2]
    assert bench.turning(1) == []
    reports = Telemetry(bench.commander, bench.simulation.autopilot, 0)
    assert struct.unpack_from("<4H", reports.flight.servo_output_raw(), 4) == (900, 1200, 900, 900)
    assert np.abs(bench.simulation.world.plant["position"][0] - before).max() < 0.01
    assert bench.commander.view.landed
    assert not bench.commander.armed
    bench.run(1.1)
    assert bench.turning() == []
    assert struct.unpack_from("<4H", reports.flight.servo_output_raw(), 4) == (900, 900, 900, 900)


def test_a_test_lasts_three_seconds_at_most(bench):
    bench.test(1, 0.1, 60.0)
    bench.run(2.9)
    assert bench.turning() == [1]
    bench.run(1.0)
    assert bench.turning() == []


@pytest.mark.parametrize(
    ("value", "seconds", "turns"),
    [
        (math.inf, 1.0, True),
        (0.1, math.inf, True),
        (0.1, -math.inf, False),
        (0.1, math.nan, False),
        (-math.inf, 1.0, False),
    ],
)
def test_numbers_that_are_not_finite(bench, value, seconds, turns):
    assert bench.test(1, value, seconds) == Result.ACCEPTED
    bench.run(0.3)
    assert bench.turning() == ([1] if turns else [])


def test_motors_under_test_share_their_end_and_are_released_one_by_one(bench):
    bench.test(1, 0.1, 3.0)
    bench.test(1104, 0.1, 1.0)  # PX4's own number for motor 4
    bench.run(0.5)
    assert bench.turning() == [1, 4]
    assert bench.test(1, 0.1, 0.0) == Result.ACCEPTED
    bench.run(0.3)
    assert bench.turning() == [4]
    bench.run(1.0)
    assert bench.turning() == []


@pytest.mark.parametrize("value", [math.nan, -1.0])
def test_without_a_value_the_motor_stops(bench, value):
    bench.test(3, 0.1, 3.0)
    bench.run(0.5)
    assert bench.turning() == [3]
    assert bench.test(3, value, 3.0) == Result.ACCEPTED
    bench.run(0.5)
    assert bench.turning() == []


def test_answers(bench):
    assert bench.test(12, 0.1) == Result.ACCEPTED, "a motor that the vehicle does not have"
    assert bench.test(33, 0.1) == Result.ACCEPTED, "a servo"
    assert [bench.test(function, 0.1) for function in (0, 13, 41, 999)] == [None] * 4
    assert not bench.simulation.autopilot.motor_tests
    bench.commander.parameters.set("COM_MOT_TEST_EN", 0)
    try:
        assert bench.test(1, 0.1) == Result.DENIED
    finally:
        bench.commander.parameters.set("COM_MOT_TEST_EN", 1)
    assert bench.commander.arm_disarm(True) == Result.ACCEPTED
    assert bench.test(1, 0.1) == Result.DENIED
    assert bench.test(0, 0.1) == Result.DENIED


def test_arming_ends_a_test_and_all_motors_idle(bench):
    bench.test(1, 0.3, 3.0)
    bench.run(0.3)
    assert bench.commander.arm_disarm(True) == Result.ACCEPTED
    bench.run(0.5)
    assert bench.turning() == [1, 2, 3, 4]
    assert np.ptp(bench.simulation.world.plant["rotor_speed"][0][:4]) < 1e-6
    assert bench.commander.arm_disarm(False) == Result.ACCEPTED
    bench.run(0.5)
    assert bench.turning() == []


def test_the_kill_switch_ends_a_test_and_prevents_the_next(bench):
    bench.test(1, 0.1, 3.0)
    bench.commander.kill(True)
    assert bench.test(1, 0.1, 3.0) == Result.ACCEPTED
    bench.run(0.5)
    assert bench.turning() == []


def test_a_reboot_and_a_reset_end_a_test(bench):
    bench.test(1, 0.1, 3.0)
    bench.run(0.5)
    bench.commander.rebooting = True
    bench.run(1.0)
    assert bench.turning() == []
    bench.test(1, 0.1, 3.0)
    bench.run(0.5)
    bench.simulation.restart()
    bench.run(0.5)
    assert bench.turning() == []


def test_the_other_vehicle_is_not_affected(bench):
    other = Bench()
    bench.test(1, 0.2)
    for one in (bench, other):
        one.run(1.5)
    for records in ("sensors", "estimator", "control"):
        pair = [getattr(one.simulation.autopilot, records)[1].tobytes() for one in (bench, other)]
        assert pair[0] == pair[1]
    other.simulation.close()
