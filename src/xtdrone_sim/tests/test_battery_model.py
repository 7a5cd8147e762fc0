"""The simulator's batteries: PX4 SITL's drain and the physical one, and the currents of motors."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
import yaml

from xtdrone_autopilot.parameters.parameters import Parameters
from xtdrone_autopilot.state import FAILURE_OFF, FAILURES, MAX_ROTORS, SENSORS, SETPOINT, records
from xtdrone_sim.physics.battery_and_motor_currents import Batteries, BatteryModel
from xtdrone_sim.vehicles.vehicle_model import load_vehicle
from xtdrone_worlds.descriptions import ModelError, read_description

HOVER_SPEED = 663.0  # rad/s, of iris


class Bench:
    """Batteries of some vehicles with given rotor speeds."""

    def __init__(self, *models: BatteryModel, **changes: float) -> None:
        count = len(models)
        self.world = SimpleNamespace(plant=np.zeros(count, [("rotor_speed", "f8", MAX_ROTORS)]))
        self.autopilot = SimpleNamespace(
            sensors=records(SENSORS, count),
            failures=records(FAILURES, count),
            setpoint=records(SETPOINT, count),
            time_us=0,
        )
        self.parameters = [Parameters({"BAT1_N_CELLS": 3}) for _ in models]
        for parameters in self.parameters:
            for name, value in changes.items():
                parameters.set(name, value)
        self.batteries = Batteries(self.world, self.autopilot, models, self.parameters)
        self.now_us = 0

    def run(self, seconds: float):
        for _ in range(round(seconds * 10)):
            self.now_us += 100_000
            self.batteries.update(self.now_us)
        return self.autopilot.sensors[0]

    def fly(self, speed: float = HOVER_SPEED) -> None:
        self.world.plant["rotor_speed"][:, :4] = speed
        self.autopilot.setpoint["armed"] = 1


DRAIN = BatteryModel()
CELLS = BatteryModel(cells=True)


def test_on_the_ground_it_remains_as_in_the_reference():
    """The state stays that of PX4's SITL: 4 cells, 16.2 V, -1 A, 100 %."""
    sensors = Bench(DRAIN, BAT1_N_CELLS=4).run(60.0)
    assert sensors["battery_voltage"] == pytest.approx(16.2)
    assert sensors["battery_current"] == -1.0


@pytest.mark.parametrize(("seconds", "charge"), [(15.0, 0.75), (30.0, 0.5), (200.0, 0.5)])
def test_it_drains_by_the_clock_while_armed(seconds, charge):
    bench = Bench(DRAIN)
    bench.fly()
    sensors = bench.run(seconds)
    assert bench.batteries.charge[0] == pytest.approx(charge)
    assert sensors["battery_voltage"] == pytest.approx(3 * (3.6 + 0.45 * charge))
    bench.autopilot.setpoint["armed"] = 0
    bench.run(0.1)
    assert bench.batteries.charge[0] == 1.0


def test_cells_supply_the_motors_current():
    bench = Bench(CELLS)
    bench.fly()
    sensors = bench.run(0.1)
    power = 4 * (CELLS.motor_power * HOVER_SPEED**3 + CELLS.idle_power) + CELLS.avionics_power
    assert sensors["battery_voltage"] * sensors["battery_current"] == pytest.approx(power)
    assert sensors["battery_voltage"] < 3 * 4.18
    assert sensors["esc_current"][:4].sum() == pytest.approx(
        sensors["battery_current"] - CELLS.avionics_power / sensors["battery_voltage"]
    )
    assert not sensors["esc_current"][4:].any()
    assert sensors["esc_rpm"][0] == pytest.approx(HOVER_SPEED * 30.0 / np.pi)


def test_cells_keep_their_charge_and_conserve_it():
    bench = Bench(CELLS)
    bench.fly()
    used = 0.0
    for _ in range(600):
        sensors = bench.run(0.1)
        used += float(sensors["battery_current"]) * 0.1
    assert bench.batteries.charge[0] == pytest.approx(1.0 - used / (3600.0 * CELLS.capacity), rel=1e-6)
    assert 0.88 < bench.batteries.charge[0] < 0.96, "some fifteen minutes of flight"
    bench.autopilot.setpoint["armed"] = 0
    bench.world.plant["rotor_speed"] = 0.0
    before = float(bench.batteries.charge[0])
    bench.run(5.0)
    assert before - 0.001 < bench.batteries.charge[0] < before


def test_an_empty_battery_sags_and_stays_finite():
    bench = Bench(BatteryModel(cells=True, capacity=0.1))
    bench.fly(1100.0)
    sensors = bench.run(200.0)
    assert bench.batteries.charge[0] == 0.0
    assert np.isfinite([sensors["battery_voltage"], sensors["battery_current"]]).all()
    assert sensors["battery_voltage"] < 3 * 3.3


def test_a_failed_battery_is_empty():
    bench = Bench(DRAIN)
    bench.autopilot.failures["battery"] = FAILURE_OFF
    assert bench.run(0.1)["battery_voltage"] == pytest.approx(3 * 3.5)


def test_vehicles_have_their_own():
    bench = Bench(DRAIN, CELLS)
    bench.fly()
    bench.run(10.0)
    assert bench.autopilot.sensors["battery_current"][0] == -1.0
    assert bench.autopilot.sensors["battery_current"][1] > 10.0


def test_an_idling_motor_draws_more_than_the_failure_detectors_limit():
    """FD_ACT_MOT_C2T is 2 A at full throttle, above FD_ACT_MOT_THR 0.2: no false alarm at any command."""
    iris = load_vehicle("iris").record
    for command in np.linspace(0.2, 1.0, 17):
        bench = Bench(DRAIN)
        bench.fly(min(iris["input_scaling"] * command + iris["idle_speed"], iris["max_speed"]))
        assert bench.run(0.1)["esc_current"][0] > 2.0 * command


@pytest.mark.parametrize(
    ("battery", "text"),
    [
        ("{model: magic}", "battery model 'magic' is not allowed, drain or cell"),
        ("{volts: 3}", "field 'volts' is not known"),
        ("{capacity: -1}", "capacity: -1.0 is not allowed"),
    ],
)
def test_descriptions_that_are_rejected(tmp_path, battery, text):
    description = read_description("vehicles", "iris")
    description["battery"] = yaml.safe_load(battery)
    path = tmp_path / "odd.yaml"
    path.write_text(yaml.safe_dump(description))
    with pytest.raises(ModelError, match=text):
        load_vehicle(str(path))


def test_the_defaults_are_those_of_iris():
    assert load_vehicle("iris").battery == BatteryModel()
