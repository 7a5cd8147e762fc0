"""Vehicles whose motion becomes impossible leave the world, the others fly on, and a reset brings them back."""

from __future__ import annotations

import logging

import numpy as np
import pytest

from xtdrone_common import modes
from xtdrone_common.fleet import parse_fleet
from xtdrone_sim.gazebo.request_limits import HARDEST, HARDEST_TURN, RequestError, check_wrench
from xtdrone_sim.physics.vehicle_dynamics import FASTEST_TURN, LOST
from xtdrone_sim.physics.wrenches import Wrench
from xtdrone_sim.simulation import Simulation

NONE = (0.0, 0.0, 0.0)
KINDS = ("free", "effects")


def nothing(time: float, vehicles: object, models: object, force: object, torque: object) -> None:
    """Add nothing: an effect that selects the steps of Python."""


def flight(kind: str) -> Simulation:
    """Return a simulation of six vehicles: four climb and two stand."""
    simulation = Simulation(parse_fleet("iris:6"), seed=5, effects=[nothing] if kind == "effects" else [])
    simulation.run_until(2_000_000)
    for commander in simulation.commanders[:4]:
        assert commander.request(modes.AUTO_TAKEOFF) == 0
        assert commander.arm_disarm(True) == 0
    simulation.run_until(8_000_000)
    return simulation


def numbers(simulation: Simulation) -> dict[str, np.ndarray]:
    plant = simulation.world.plant
    return {name: plant[name] for name in ("position", "velocity", "q", "rates", "acceleration", "rotor_speed")}


@pytest.mark.parametrize("kind", KINDS)
def test_vehicles_with_impossible_motion_leave_and_come_back(kind: str, caplog: pytest.LogCaptureFixture) -> None:
    """Vehicle 0 is turned by 1e4 N m, 1 and 4 are pushed out of the world, and 2 gets a speed that is no number."""
    simulation = flight(kind)
    world, now = simulation.world, simulation.world.steps
    world.wrenches.add(Wrench(0, NONE, (1e4, 1e4, 1e4), now, now + 250))
    for index in (1, 4):
        world.wrenches.add(Wrench(index, (0.0, 0.0, 1e300), NONE, now, now + 1e9))
    simulation.run_until(8_020_000)
    world.plant["velocity"][2] = np.nan
    with caplog.at_level(logging.ERROR):
        for _ in range(10):
            simulation.run_until(simulation.time_us + 100_000)
            assert all(np.isfinite(values).all() for values in numbers(simulation).values())
            assert np.linalg.norm(world.plant["rates"], axis=1).max() <= FASTEST_TURN * (1.0 + 1e-9)
    assert np.flatnonzero(world.plant["contact"] == LOST).tolist() == [1, 2, 4]
    assert sorted(record.args[0] for record in caplog.records) == ["iris_1", "iris_2", "iris_4"]  # type: ignore[index]
    assert [commander.armed for commander in simulation.commanders] == [True, False, False, True, False, False]
    assert len(world.wrenches) == 0
    simulation.run_until(11_000_000)
    assert world.plant["position"][3, 2] > 1.0
    for index in (0, 1, 2, 4):
        simulation.reset_vehicle(index)
    simulation.run_until(16_000_000)
    lost = [0, 1, 2, 4]
    assert world.plant["position"][lost] == pytest.approx(np.array([[0, 3, 0.055], [3, 3, 0.055], [6, 3, 0.055],
                                                                    [3, 6, 0.055]]), abs=0.01)  # fmt: skip
    for index in lost:
        assert simulation.commanders[index].request(modes.AUTO_TAKEOFF) == 0
        assert simulation.commanders[index].arm_disarm(True) == 0
    simulation.run_until(22_000_000)
    assert (world.plant["position"][lost, 2] > 1.0).all()
    simulation.close()


def test_the_others_fly_the_same_to_the_last_bit() -> None:
    undisturbed, simulation = flight("free"), flight("free")
    simulation.world.plant["rates"][1] = np.inf
    for one in (undisturbed, simulation):
        one.run_until(9_000_000)
    others = [0, 2, 3, 4, 5]
    assert simulation.world.plant["contact"][1] == LOST
    assert simulation.world.plant[others].tobytes() == undisturbed.world.plant[others].tobytes()
    undisturbed.close()
    simulation.close()


def test_a_reset_ends_the_wrenches_of_a_vehicle() -> None:
    simulation = Simulation(parse_fleet("iris:2"))
    simulation.world.wrenches.add(Wrench(0, NONE, (1e4, 0.0, 0.0), 0.0))
    simulation.run_until(500_000)
    simulation.reset_vehicle(0)
    simulation.run_until(1_500_000)
    assert simulation.world.plant["position"][0] == pytest.approx([0.0, 3.0, 0.055], abs=0.01)
    simulation.close()


def test_at_great_heights_the_sensors_stay_finite() -> None:
    simulation = Simulation(parse_fleet("iris:2"))
    simulation.world.place_vehicle(0, (0.0, 0.0, 1e5), (1.0, 0.0, 0.0, 0.0), (1e3, 0.0, 0.0), (1e3, -1e3, 1e3))
    simulation.run_until(500_000)
    sensors, estimator = simulation.autopilot.sensors[0], simulation.autopilot.estimator[0]
    assert np.isfinite([sensors["baro_pressure"], *sensors["gyro"], *sensors["accel"]]).all()
    assert all(np.isfinite(estimator[name]).all() for name in ("q", "velocity", "position", "P", "rates"))
    simulation.close()


def test_wrenches_are_limited_by_mass_and_inertia() -> None:
    check_wrench("iris_0", (1.5 * HARDEST, 0.0, 0.0), (0.0, 0.03 * HARDEST_TURN, 0.0), 1.5, (0.03, 0.03, 0.06))
    with pytest.raises(RequestError, match=r"wrench: force: 1\.6e\+04 N on 'iris_0' is not allowed, at most 1\.5e\+04"):
        check_wrench("iris_0", (0.0, 1.6e4, 0.0), NONE, 1.5, (0.03, 0.03, 0.06))
    with pytest.raises(RequestError, match=r"wrench: torque: 1e\+04 N m on 'iris_0' is not allowed, at most 3e\+03"):
        check_wrench("iris_0", NONE, (1e4, 0.0, 0.0), 1.5, (0.03, 0.03, 0.06))
