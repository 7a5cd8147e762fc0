"""PX4's battery estimate, and the arming checks that use it."""

from __future__ import annotations

import math

import pytest
from autopilot_fakes import Flight

from xtdrone_autopilot.commander.commander import Result
from xtdrone_autopilot.commander.failsafe import BATTERY_CRITICAL, BATTERY_EMERGENCY, BATTERY_LOW, BATTERY_OK
from xtdrone_autopilot.commander.health_and_arming_checks.battery_estimate import BatteryEstimate
from xtdrone_autopilot.parameters.parameters import Parameters

STEP_US = 100_000


class Bench:
    """A battery on the bench, measured at 10 Hz."""

    def __init__(self, **changes):
        self.parameters = Parameters({"BAT1_N_CELLS": 4})
        for name, value in changes.items():
            self.parameters.set(name, value)
        self.battery = BatteryEstimate(self.parameters.get)
        self.now_us = 0

    def measure(self, voltage, current=-1.0, thrust=0.0, seconds=0.1, armed=True):
        for _ in range(round(seconds * 10)):
            self.now_us += STEP_US
            self.battery.update(self.now_us, voltage, current, thrust, armed)
        return self.battery


@pytest.mark.parametrize(
    ("cell", "remaining"), [(4.05, 1.0), (4.3, 1.0), (3.825, 0.5), (3.6, 0.0), (3.0, 0.0), (3.69, 0.2)]
)
def test_charge_by_voltage(cell, remaining):
    assert Bench().measure(4 * cell).remaining == pytest.approx(remaining)


def test_voltage_is_corrected_for_load():
    by_thrust = Bench().measure(4 * 3.8, thrust=0.5)
    assert by_thrust.remaining == pytest.approx((3.85 - 3.6) / 0.45)
    by_current = Bench().measure(4 * 3.8, current=10.0, thrust=0.5)
    assert by_current.remaining == pytest.approx((3.85 - 3.6) / 0.45)
    without = Bench(BAT1_R_INTERNAL=-1.0).measure(4 * 3.8, current=10.0)
    assert without.remaining == pytest.approx((3.8 - 3.6) / 0.45)


@pytest.mark.parametrize(
    ("charge", "warning"),
    [(0.16, BATTERY_OK), (0.14, BATTERY_LOW), (0.06, BATTERY_CRITICAL), (0.04, BATTERY_EMERGENCY)],
)
def test_warning_levels(charge, warning):
    bench = Bench()
    voltage = 4 * (3.6 + 0.45 * charge)
    assert bench.measure(voltage, seconds=1.9).warning == BATTERY_OK, "not within two seconds of plugging in"
    assert bench.measure(voltage, seconds=0.5).warning == warning


def test_a_known_capacity_is_counted_down():
    bench = Bench(BAT1_CAPACITY=5000.0)
    bench.measure(16.2, current=0.0, seconds=3.0)
    battery = bench.measure(16.2, current=36.0, seconds=50.0)
    assert battery.discharged == pytest.approx(500.0)
    assert battery.remaining == pytest.approx(0.9, abs=0.005)
    # the average goes to 36 A from the 15 A that BAT_AVRG_CURRENT expects, over 50 s
    average = 36.0 - (36.0 - 15.0) * math.exp(-1.0)
    assert battery.time_remaining == pytest.approx(0.9 * 5000.0 * 3.6 / average, rel=0.05)


def test_a_low_voltage_pulls_the_count_down():
    bench = Bench(BAT1_CAPACITY=5000.0)
    bench.measure(16.2, current=0.0, seconds=3.0)
    assert bench.measure(4 * 3.6, current=0.0, seconds=60.0).remaining < 0.2


def test_no_battery():
    battery = Bench().measure(0.0)
    assert not battery.connected
    assert math.isnan(battery.time_remaining)


# arming


@pytest.mark.parametrize(
    ("charge", "result", "name"),
    [
        (0.5, Result.ACCEPTED, ""),
        (0.1, Result.ACCEPTED, "check_battery_low"),
        (0.06, Result.TEMPORARILY_REJECTED, "check_battery_critical"),
        (0.01, Result.TEMPORARILY_REJECTED, "check_battery_emergency"),
        (None, Result.TEMPORARILY_REJECTED, "check_battery_unhealthy"),
    ],
)
def test_arming_by_charge(charge, result, name):
    flight = Flight()
    cells = flight.parameters.get("BAT1_N_CELLS")
    voltage = 0.0 if charge is None else cells * (3.6 + 0.45 * charge)
    flight.autopilot.sensors["battery_voltage"] = voltage
    flight.run(5.0)
    assert flight.commander.arm_disarm(True) is result
    names = [event.name for event in flight.commander.events]
    assert not name or name in names
    assert name or not any("battery" in found for found in names)


def test_without_the_supply_check_any_battery_will_do():
    flight = Flight(CBRK_SUPPLY_CHK=894281)
    flight.autopilot.sensors["battery_voltage"] = 0.0
    flight.run(3.0)
    assert flight.commander.arm_disarm(True) is Result.ACCEPTED


def test_a_warning_never_improves_in_flight():
    flight = Flight()
    cells = flight.parameters.get("BAT1_N_CELLS")
    flight.run(3.0)
    flight.commander.arm_disarm(True)
    flight.place(0.0, 0.0, -5.0)
    flight.autopilot.sensors["battery_voltage"] = cells * (3.6 + 0.45 * 0.1)
    flight.run(0.5)
    flight.autopilot.sensors["battery_voltage"] = cells * 4.05
    flight.run(0.5)
    assert flight.commander.health.flags.battery == BATTERY_LOW
