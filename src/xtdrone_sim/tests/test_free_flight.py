"""Several steps of all vehicles in one call against the steps of the simulation one by one."""

from __future__ import annotations

import gc

import numpy as np
import pytest
from numba.core.datamodel import default_manager
from numba.core.dispatcher import Dispatcher

from xtdrone_autopilot.state import TASK_RATES
from xtdrone_common.fleet import parse_fleet
from xtdrone_sim.simulation import Simulation
from xtdrone_sim.steps_in_free_flight import FreeFlight

_PLACES = [(5.0 * i, 0.0, 60.0 + i) for i in range(5)]


@pytest.fixture
def simulate():
    """Return a function that creates five vehicles in the air, with a given number of threads.

    With ``aligned`` their estimators run; otherwise they never do, as the vehicles have never been at rest.
    """
    made = []

    def create(threads: int | None = None, *, aligned: bool = False) -> Simulation:
        places = [(x, y, 0.0) for x, y, _ in _PLACES] if aligned else _PLACES
        simulation = Simulation(parse_fleet("iris:5"), places=places, seed=3)
        made.append(simulation)
        if threads is not None:
            simulation._free_flight = FreeFlight(simulation.world, simulation.sensors, simulation.autopilot, threads)
        if aligned:  # at rest on the ground, for a second
            simulation.run_until(1_000_000)
            for i, place in enumerate(_PLACES):
                simulation.world.place_vehicle(i, place, (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
        return simulation

    yield create
    for simulation in made:
        simulation.close()


def _power(simulation: Simulation) -> None:
    """Run the motors of all vehicles but the last, each with its own setpoint."""
    setpoint = simulation.autopilot.setpoint
    setpoint["armed"] = (1, 1, 1, 1, 0)
    setpoint["task"], setpoint["task_changed"] = TASK_RATES, 1
    setpoint["rates"] = np.linspace(-0.3, 0.3, 15).reshape(5, 3)
    setpoint["thrust"] = 0.55


def _bytes(simulation: Simulation) -> list[bytes]:
    a = simulation.autopilot
    records = (simulation.world.plant, a.sensors, a.estimator, a.setpoint, a.control)
    return [record.tobytes() for record in records]


@pytest.mark.parametrize("threads", [1, 2, 5])
def test_results_are_those_of_single_steps(simulate, threads):
    single, many = simulate(aligned=True), simulate(threads, aligned=True)
    for simulation in (single, many):
        _power(simulation)
    for until_us in (1_020_000, 1_812_000, 1_828_000, 3_100_000):  # also within the interval of the contact checks
        while single.time_us < until_us:
            single.step()
        many.run_until(until_us)
        assert many.time_us == until_us
        assert many.autopilot.time_us == until_us
        assert _bytes(many) == _bytes(single)
    assert many.autopilot.estimator["initialised"].all()


def test_vehicles_on_the_ground_and_failed_units_are_left_to_single_steps(simulate):
    simulation = simulate()
    free = simulation._free_flight
    simulation.run_until(4_000)
    assert free._possible_steps(4) == 4
    simulation.autopilot.failures["gyro"][1] = 1
    assert free.advance(1, simulation._steps, simulation.time_us) == 0
    simulation.autopilot.failures["gyro"][1] = 0
    simulation.autopilot.setpoint["failed_rotors"][2] = 1
    assert free.advance(1, simulation._steps, simulation.time_us) == 0
    simulation.run_until(40_000)
    assert simulation.autopilot.failed_rotors.tolist() == [0, 0, 1, 0, 0]
    simulation.world.plant["position"][4, 2] = 0.3
    simulation.run_until(60_000)
    assert free.advance(1, simulation._steps, simulation.time_us) == 0


@pytest.mark.parametrize("speed", [1.0, 8.0, 40.0])
def test_no_contact_check_is_left_out_that_finds_a_contact(simulate, speed):
    single, many = simulate(), simulate(2)
    for simulation in (single, many):
        _power(simulation)
        simulation.world.plant["velocity"][0] = (speed, 0.0, 0.0)
        simulation.world.plant["velocity"][3] = (0.0, 0.0, -speed)
        simulation.world.plant["position"][3, 2] = 4.0
    touched = False
    for until_us in (300_000, 900_000, 1_400_000):
        while single.time_us < until_us:
            single.step()
            touched = touched or (single.time_us > 20_000 and bool(single.world.plant["contact"].any()))
        many.run_until(until_us)
        assert _bytes(many) == _bytes(single)
    assert touched or speed < 2.0


def test_vehicles_near_each_other_or_spinning_are_checked(simulate):
    world = simulate().world
    world.check_contacts(world.plant["contact"] * 0)
    assert world.steps_apart(25) == 25
    world.plant["rates"][2] = (30.0, 0.0, 0.0)
    assert world.steps_apart(25) == 0
    world.plant["rates"][2] = 0.0
    world.plant["position"][1] = world.plant["position"][0] + (1.5, 0.0, 0.0)
    assert world.steps_apart(25) == 0


def test_kernels_without_reference_counts_return_no_arrays(simulate):
    """Their caller would release a reference that it does not hold."""
    simulation = simulate(aligned=True)
    _power(simulation)
    simulation.run_until(simulation.time_us + 400_000)
    simulation.step()
    kernels = [
        one for one in gc.get_objects() if issubclass(type(one), Dispatcher) and not one.targetoptions.get("_nrt", True)
    ]
    returned = {signature.return_type for one in kernels for signature in one.nopython_signatures}
    assert len(returned) > 3
    assert not [one for one in returned if default_manager[one].contains_nrt_meminfo()]
