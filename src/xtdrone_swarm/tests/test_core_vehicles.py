"""Full physics behind the interface of the simplified simulator: flights, rejections, restart."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest

from xtdrone_common.fleet import FleetError
from xtdrone_lockstep.protocol import Schedule
from xtdrone_swarm.full_vehicles import CoreVehicles
from xtdrone_swarm.swarm_vehicles import ACCELERATION, HOLD, POSITION, VELOCITY

TURNS = Schedule(30)
COUNT = 2


@pytest.fixture
def vehicles():
    made = CoreVehicles(COUNT, seed=3)
    yield made
    made.close()


def run(vehicles: CoreVehicles, seconds: float, each_turn: Callable[[], None] = lambda: None) -> None:
    end = vehicles.time_us + round(seconds * 1e6)
    while vehicles.time_us < end:
        each_turn()
        vehicles.advance(TURNS.after_us(vehicles.time_us))


def until(vehicles: CoreVehicles, reached: Callable[[], bool], limit: float) -> None:
    end = vehicles.time_us + limit * 1e6
    while not reached():
        assert vehicles.time_us < end, (vehicles.mode, vehicles.armed, vehicles.position)
        vehicles.advance(TURNS.after_us(vehicles.time_us))


def command_all(vehicles: CoreVehicles, text: str) -> None:
    assert [vehicles.command(i, text) for i in range(COUNT)] == [""] * COUNT


def take_off(vehicles: CoreVehicles) -> None:
    run(vehicles, 3.0)
    command_all(vehicles, "AUTO.TAKEOFF")
    command_all(vehicles, "ARM")
    until(vehicles, lambda: vehicles.mode == ["AUTO.LOITER"] * COUNT, 20.0)
    command_all(vehicles, "HOVER")
    run(vehicles, 0.5)
    command_all(vehicles, "OFFBOARD")


def test_a_flight_from_takeoff_to_landing(vehicles: CoreVehicles) -> None:
    assert vehicles.names == ("iris_0", "iris_1")
    assert np.isnan(vehicles.position).all()  # no estimate yet
    np.testing.assert_allclose(vehicles.true_position[1] - vehicles.true_position[0], [0.0, 3.0, 0.0], atol=1e-6)
    spawned = vehicles.true_position[:, 2].copy()
    take_off(vehicles)
    assert vehicles.mode == ["OFFBOARD"] * COUNT
    assert vehicles.armed == [True] * COUNT
    assert (vehicles.position[:, 2] > 1.8).all()
    run(vehicles, 2.0)
    before, heading = vehicles.true_position.copy(), vehicles.yaw.copy()
    wanted = np.array([[0.0, 0.0, 0.0], [1.0, 0.5, 0.5]])
    vehicles.steer(VELOCITY, wanted, np.array([False, True]))
    run(vehicles, 4.0)
    moved = vehicles.true_position - before
    assert np.linalg.norm(moved[0]) < 0.15  # no position in the command: it holds
    np.testing.assert_allclose(vehicles.velocity[1], wanted[1], atol=0.1)
    assert 3.0 < moved[1, 0] < 4.1
    np.testing.assert_allclose(vehicles.yaw, heading, atol=0.05)
    assert np.abs(vehicles.position - vehicles.true_position).max() < 0.15
    command_all(vehicles, "AUTO.LAND")
    until(vehicles, lambda: not any(vehicles.armed), 40.0)
    np.testing.assert_allclose(vehicles.true_position[:, 2], spawned, atol=0.05)


def test_hold_turn_position_and_acceleration(vehicles: CoreVehicles) -> None:
    take_off(vehicles)
    vehicles.steer_one(0, VELOCITY, (1.0, 0.0, 0.0), 0.5)
    run(vehicles, 1.5)
    turned = vehicles.yaw[0]
    vehicles.steer_one(0, HOLD, (0.0, 0.0, 0.0))
    place = vehicles.position[0].copy()
    goal = vehicles.position[1] + np.array([0.0, 1.0, 1.0])
    vehicles.steer_one(1, POSITION, (goal[0], goal[1], goal[2]))
    run(vehicles, 6.0)
    assert 0.4 < turned < 1.1
    np.testing.assert_allclose(vehicles.position[0], place, atol=0.15)
    np.testing.assert_allclose(vehicles.position[1], goal, atol=0.15)
    vehicles.steer_one(1, ACCELERATION, (0.5, 0.0, 0.0))
    run(vehicles, 1.5)
    assert 0.4 < vehicles.velocity[1, 0] < 0.9


def test_rejections_have_a_reason(vehicles: CoreVehicles) -> None:
    assert vehicles.command(1, "ARM") == "iris_1: arming denied: No valid attitude estimate"
    run(vehicles, 3.0)
    assert "iris_0: 'FLY' is neither a command (ARM, DISARM, HOVER) nor a PX4 mode (MANUAL," in vehicles.command(
        0, "FLY"
    )
    assert vehicles.command(0, "AUTO.READY").startswith("iris_0: mode AUTO.READY is not supported; there")
    assert vehicles.command(0, "AUTO.LAND") == ""
    assert vehicles.command(0, "ARM") == "iris_0: arming denied: Mode not suitable for arming"
    assert not vehicles.armed[0]
    take_off(vehicles)
    assert vehicles.command(0, "DISARM") == "iris_0: disarming denied: Not landed"
    assert vehicles.command(0, "POSCTL").startswith("iris_0: POSCTL is not available now: ")
    assert vehicles.mode[0] == "OFFBOARD"
    with pytest.raises(ValueError, match="kind of setpoint: 7 is not allowed"):
        vehicles.steer_one(0, 7, (0.0, 0.0, 0.0))


def test_a_restart_flies_the_same_to_the_bit(vehicles: CoreVehicles) -> None:
    def fly() -> list[np.ndarray]:
        seen = []

        def steer() -> None:
            angle = vehicles.time_us * 1e-6
            wanted = np.array([[math.cos(angle), math.sin(angle), 0.2], [0.3, 0.0, 0.0]])
            vehicles.steer(VELOCITY, wanted, np.array([True, True]))
            seen.append(np.hstack([vehicles.true_position, vehicles.position, vehicles.velocity]))

        take_off(vehicles)
        run(vehicles, 1.0, steer)
        return seen

    first = fly()
    vehicles.restart()
    assert vehicles.time_us == 0
    assert vehicles.armed == [False] * COUNT
    assert np.isnan(vehicles.position).all()
    np.testing.assert_array_equal(first, fly())


def test_invalid_values_are_rejected() -> None:
    with pytest.raises(FleetError, match="number of vehicles: 251 is not allowed in full physics; 1 to 250"):
        CoreVehicles(251)
    with pytest.raises(ValueError, match="places: 2 x 2 numbers are not allowed; 2 x 3 finite ones"):
        CoreVehicles(2, places=[(0.0, 0.0), (1.0, 1.0)])  # type: ignore[list-item]
    with pytest.raises(ValueError, match="cmd_timeout: -1"):
        CoreVehicles(1, cmd_timeout=-1.0)


def test_time_goes_forward_by_steps(vehicles: CoreVehicles) -> None:
    with pytest.raises(ValueError, match="time: 4001 us is not allowed, a multiple of 4000 us"):
        vehicles.advance(4001)
    vehicles.advance(8000)
    with pytest.raises(ValueError, match="from 8000 us on"):
        vehicles.advance(4000)
