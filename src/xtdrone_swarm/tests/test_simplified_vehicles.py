"""Simplified vehicles against closed forms, against the communication node's rules, and their pilot's modes."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from xtdrone_control.communication.commands import MultirotorCore
from xtdrone_control.communication.setpoint import IGNORE_POSITION
from xtdrone_swarm import Model
from xtdrone_swarm.full_vehicles import CoreVehicles
from xtdrone_swarm.simplified.simplified_vehicles import SimplifiedVehicles, spawn_places
from xtdrone_swarm.simplified.vehicle_parameters import load_model
from xtdrone_swarm.swarm_vehicles import ACCELERATION, HOLD, POSITION, VELOCITY
from xtdrone_worlds.descriptions import ModelError

HIGH = [[0.0, 0.0, 100.0]]
PLAIN = Model(delay=0.0, delay_vertical=0.0, acceleration=math.inf, acceleration_vertical=math.inf)


def flown(model: Model, **options) -> SimplifiedVehicles:
    return SimplifiedVehicles(1, model=model, places=HIGH, airborne=True, hover_speed=None, **options)


def fly(vehicles: SimplifiedVehicles, seconds: float) -> None:
    vehicles.advance(vehicles.time_us + round(seconds * 1e6))


def test_lag_is_the_closed_form():
    vehicles = flown(PLAIN)
    vehicles.steer_one(0, VELOCITY, (2.0, -1.0, 0.5))
    for _ in range(25):
        fly(vehicles, 0.1)
        t = vehicles.time_us * 1e-6
        for axis, (wanted, tau) in enumerate(((2.0, 0.56), (-1.0, 0.56), (0.5, 0.126))):
            gone = 1.0 - math.exp(-t / tau)
            assert vehicles.velocity[0, axis] == pytest.approx(wanted * gone, abs=1e-12)
            expected = wanted * (t - tau * gone) + HIGH[0][axis]
            assert vehicles.position[0, axis] == pytest.approx(expected, abs=1e-11)


def test_limited_acceleration_is_the_closed_form():
    a, tau, wanted = 3.0, 0.56, 5.0
    vehicles = flown(replace(PLAIN, acceleration=a))
    vehicles.steer_one(0, VELOCITY, (0.6 * wanted, 0.8 * wanted, 0.0))
    straight = wanted / a - tau  # s; no multiple of the base step
    for _ in range(20):
        fly(vehicles, 0.1)
        t = vehicles.time_us * 1e-6
        speed, way = a * t, 0.5 * a * t * t
        if t > straight:
            gone = 1.0 - math.exp(-(t - straight) / tau)
            speed = wanted - a * tau * (1.0 - gone)
            way = 0.5 * a * straight**2 + wanted * (t - straight) - a * tau * tau * gone
        assert vehicles.velocity[0, :2] == pytest.approx([0.6 * speed, 0.8 * speed], abs=1e-11)
        assert vehicles.position[0, :2] == pytest.approx([0.6 * way, 0.8 * way], abs=1e-11)


@pytest.mark.parametrize(("axis", "steps"), [(0, 36), (2, 6)])
def test_delay_is_exact_to_a_step(axis, steps):
    vehicles = flown(Model(delay=0.145, delay_vertical=0.023))
    fly(vehicles, 0.4)
    vector = [0.0, 0.0, 0.0]
    vector[axis] = 1.0
    vehicles.steer_one(0, VELOCITY, tuple(vector))
    fly(vehicles, 0.004 * steps)
    assert vehicles.velocity[0, axis] == 0.0
    fly(vehicles, 0.004)
    assert vehicles.velocity[0, axis] > 0.0


def test_first_order_reaches_the_velocity_at_once_within_the_limits():
    vehicles = flown(replace(load_model("iris"), order=1))
    vehicles.steer_one(0, VELOCITY, (30.0, 40.0, 9.0))
    fly(vehicles, 0.004)
    assert vehicles.velocity[0] == pytest.approx([7.2, 9.6, 3.0])
    vehicles.steer_one(0, VELOCITY, (0.0, 0.0, -9.0))
    fly(vehicles, 1.0)
    assert vehicles.velocity[0].tolist() == [0.0, 0.0, -1.5]
    assert vehicles.position[0, 2] == pytest.approx(100.0 + 0.012 - 1.5)


def test_position_is_approached_as_a_p_controller_does():
    vehicles = flown(Model(order=1))
    vehicles.steer_one(0, POSITION, (1.0, -2.0, 101.0))
    fly(vehicles, 2.0)
    left = (1.0 - 0.95 * 0.004) ** 500
    assert vehicles.position[0, :2] == pytest.approx([1.0 - left, -2.0 + 2.0 * left], abs=1e-12)
    assert vehicles.position[0, 2] == pytest.approx(101.0 - (1.0 - 0.004) ** 500, abs=1e-11)


def test_acceleration_is_integrated_and_limited():
    vehicles = flown(replace(PLAIN, acceleration=2.0))
    vehicles.steer_one(0, ACCELERATION, (0.0, 5.0, 0.5))
    fly(vehicles, 3.0)
    assert vehicles.velocity[0] == pytest.approx([0.0, 6.0, 1.5])
    assert vehicles.position[0] == pytest.approx([0.0, 9.0, 102.25])


def test_heading_turns_by_rate_and_to_a_goal():
    vehicles = flown(Model())
    vehicles.steer_one(0, VELOCITY, (0.0, 0.0, 0.0), 1.0)
    fly(vehicles, 4.0)
    assert vehicles.yaw[0] == pytest.approx(4.0 - 2.0 * math.pi)
    vehicles.steer_one(0, POSITION, tuple(HIGH[0]), yaw=3.0)
    fly(vehicles, 5.0)
    assert vehicles.yaw[0] == pytest.approx(3.0, abs=1e-5)


def test_where_one_stops_on_the_way_changes_nothing():
    rng = np.random.default_rng(1)
    pieces = rng.integers(1, 40, 60).tolist()
    ends = []
    for stops in (pieces, [sum(pieces)]):
        vehicles = SimplifiedVehicles(3)
        vehicles.command(0, "AUTO.TAKEOFF")
        for i in range(2):
            vehicles.command(i, "ARM")
        vehicles.steer_one(0, VELOCITY, (1.0, 0.5, 0.2))
        for steps in stops:
            vehicles.advance(vehicles.time_us + 4000 * steps)
        ends.append((vehicles.position.tobytes(), vehicles.velocity.tobytes(), vehicles.mode, vehicles.armed))
    assert ends[0] == ends[1]


def test_the_fit_of_the_iris_is_its_model():
    assert load_model("iris") == Model()
    assert load_model("iris", "first-order") == Model(order=1)


class Silent:
    def info(self, text):
        pass

    warning = stream_warning = info


def test_hover_and_dead_zone_are_those_of_the_communication_node():
    rng = np.random.default_rng(5)
    vehicles = SimplifiedVehicles(1, places=HIGH, airborne=True, hover_speed=0.02)
    core = MultirotorCore("iris_0", Silent(), hover_speed=0.02)
    core.on_pose(tuple(HIGH[0]), (0.0, 0.0, 0.0, 1.0))  # before OFFBOARD, in which it holds
    inner = vehicles._each[0]
    captured = 0
    for _ in range(1500):
        vehicles.advance(vehicles.time_us + 32000)
        now, place = vehicles.time_us * 1e-6, tuple(vehicles.position[0].tolist())
        core.on_state(vehicles.mode[0], vehicles.armed[0])
        core.on_pose(place, (0.0, 0.0, 0.0, 1.0))
        action = rng.integers(0, 12)
        if action < 6:
            vector = tuple(rng.uniform(-0.04, 0.04, 3).tolist())
            vehicles.steer_one(0, VELOCITY, vector)
            core.on_target_velocity("", vector, 0.0, now, body=False)
        elif action < 9:
            text = ["HOVER", "OFFBOARD", "AUTO.LOITER"][action - 6]
            vehicles.command(0, text)
            request = core.on_command(text, now)
            if request is not None:
                core.on_result(request, True, "", now)
        core.on_state(vehicles.mode[0], vehicles.armed[0])
        setpoint = core.tick(now)
        if setpoint.type_mask & IGNORE_POSITION:
            assert inner.kind == VELOCITY
            assert tuple(inner.setpoint) == setpoint.velocity
        else:
            captured += 1
            assert inner.kind in (POSITION, HOLD)
            if inner.kind == POSITION:
                assert tuple(inner.setpoint) == setpoint.position
    assert captured > 100


def test_takeoff_hold_and_landing():
    vehicles = SimplifiedVehicles(2)
    assert vehicles.mode == ["AUTO.LOITER"] * 2
    assert vehicles.command(0, "AUTO.TAKEOFF") == vehicles.command(0, "ARM") == ""
    fly(vehicles, 0.9)
    assert vehicles.position[0, 2] == 0.0
    fly(vehicles, 8.0)
    assert vehicles.mode == ["AUTO.LOITER"] * 2
    assert vehicles.armed == [True, False]
    assert vehicles.position[0] == pytest.approx([0.0, 3.0, 2.5], abs=0.01)
    assert "disarming denied" in vehicles.command(0, "DISARM")
    assert vehicles.command(0, "AUTO.LAND") == ""
    fly(vehicles, 12.0)
    assert vehicles.position[0].tolist() == [0.0, 3.0, 0.0]
    assert not vehicles.armed[0]
    assert vehicles.mode[0] == "AUTO.LOITER"


def test_return_to_launch():
    vehicles = SimplifiedVehicles(1)
    vehicles.command(0, "AUTO.TAKEOFF")
    vehicles.command(0, "ARM")
    fly(vehicles, 8.0)
    vehicles.steer_one(0, VELOCITY, (5.0, 0.0, 0.0))
    vehicles.command(0, "OFFBOARD")
    fly(vehicles, 6.0)
    assert vehicles.position[0, 0] > 20.0
    vehicles.command(0, "AUTO.RTL")
    fly(vehicles, 20.0)
    assert vehicles.position[0, 2] > 25.0
    fly(vehicles, 60.0)
    assert vehicles.position[0] == pytest.approx([0.0, 3.0, 0.0], abs=0.1)
    assert vehicles.armed == [False]


def test_disarms_without_a_takeoff_and_remains_on_the_ground():
    vehicles = SimplifiedVehicles(1)
    vehicles.steer_one(0, VELOCITY, (1.0, 0.0, -1.0))
    vehicles.command(0, "ARM")
    vehicles.command(0, "OFFBOARD")
    fly(vehicles, 9.9)
    assert vehicles.armed == [True]
    fly(vehicles, 0.2)
    assert vehicles.armed == [False]
    assert vehicles.position[0].tolist() == [0.0, 3.0, 0.0]


def test_offboard_without_a_setpoint_holds():
    vehicles = flown(Model())
    vehicles.steer_one(0, VELOCITY, (2.0, 0.0, 0.0))
    fly(vehicles, 3.0)
    vehicles.command(0, "AUTO.LOITER")
    fly(vehicles, 10.0)
    assert abs(vehicles.velocity[0, 0]) < 1e-3
    assert vehicles.position[0, 0] == pytest.approx(6.0, abs=0.5)
    still = SimplifiedVehicles(1, places=HIGH, airborne=True)
    fly(still, 5.0)
    assert still.position.tolist() == HIGH


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"order": 3}, "order 3"),
        ({"time_constant": math.nan}, "time_constant: nan"),
        ({"speed": 0.0}, "speed: 0.0"),
        ({"speed_up": math.inf}, "speed_up: inf"),
        ({"delay": -0.1}, "delay: -0.1"),
        ({"yaw_rate": "fast"}, "'fast' is not a number"),
    ],
)
def test_bad_models(options, words):
    with pytest.raises(ModelError, match=words):
        Model(**options)


def test_bad_names_and_files(tmp_path):
    file = tmp_path / "mine.yaml"
    file.write_text("{time_constnt: 1.0}\n")
    with pytest.raises(ModelError, match="'time_constnt' is not known; there are order, time_constant"):
        load_model("iris", str(file))
    file.write_text("{time_constant: 1.0}\n")
    assert load_model("iris", str(file)) == Model(time_constant=1.0)
    with pytest.raises(ModelError, match="third-order"):
        load_model("iris", "third-order")
    with pytest.raises(ModelError, match=r"none\.yaml: No such file"):
        load_model("iris", str(tmp_path / "none.yaml"))
    (tmp_path / "folder.yaml").mkdir()
    with pytest.raises(ModelError, match=r"folder\.yaml: Is a directory"):
        load_model("iris", str(tmp_path / "folder.yaml"))
    with pytest.raises(ModelError, match="'zeppelin' is not known"):
        load_model("zeppelin")


def test_bad_places_and_setpoints():
    for places in ([[0.0, 0.0]], [[0.0, 0.0, math.nan]], [[0.0, 0.0, -1.0]], [[0.0, 0.0, 1.0]] * 2):
        with pytest.raises(ValueError, match="places"):
            SimplifiedVehicles(1, places=places)
    vehicles = SimplifiedVehicles(2)
    vectors = np.array([[0.0, 0.0, 0.0], [0.0, math.nan, 0.0]])
    with pytest.raises(ValueError, match="iris_1"):
        vehicles.steer(VELOCITY, vectors, np.array([True, True]))
    with pytest.raises(ValueError, match="shapes"):
        vehicles.steer(VELOCITY, np.zeros((3, 3)), np.zeros(3, bool))
    with pytest.raises(ValueError, match="kind"):
        vehicles.steer_one(0, 7, (0.0, 0.0, 0.0))
    with pytest.raises(IndexError, match="vehicle 2"):
        vehicles.command(2, "ARM")
    with pytest.raises(ValueError, match="multiple of 4000"):
        vehicles.advance(5000)
    assert "nor a PX4 mode" in vehicles.command(0, "FLY")
    assert "not supported" in vehicles.command(0, "ACRO")
    vehicles.command(0, "AUTO.LAND")
    assert "arming denied in mode AUTO.LAND" in vehicles.command(0, "ARM")


def test_the_iris_flies_as_in_full_physics():
    full = CoreVehicles(1)
    fly(full, 2.0)
    assert full.command(0, "AUTO.TAKEOFF") == full.command(0, "ARM") == ""
    fly(full, 12.0)
    full.steer_one(0, VELOCITY, (0.0, 0.0, 0.5))
    assert full.command(0, "OFFBOARD") == ""
    fly(full, 10.0)
    simple = SimplifiedVehicles(1, places=full.position, airborne=True)
    steps = [((0.0, 0.0, 0.0), 6.0)]
    for axis in (0, 2):
        vector = [0.0, 0.0, 0.0]
        vector[axis] = 1.0
        steps += [(tuple(vector), 4.0), ((0.0, 0.0, 0.0), 4.0)]
    differences = []
    for vector, seconds in steps:
        for vehicles in (full, simple):
            vehicles.steer_one(0, VELOCITY, vector)
        for _ in range(round(seconds / 0.1)):
            for vehicles in (full, simple):
                fly(vehicles, 0.1)
            differences.append(full.velocity[0] - simple.velocity[0])
    full.close()
    settled = np.array(differences[60:])
    assert np.sqrt((settled**2).mean(axis=0)).max() < 0.06  # m/s, of steps of 1 m/s
    assert np.abs(simple.velocity).max() < 0.05


def test_one_vehicle_is_put_back_and_the_others_fly_on() -> None:
    flights = []
    for wanted in (False, True):
        vehicles = SimplifiedVehicles(3, airborne=True, headings=[0.0, 1.0, 2.0])
        for index in range(3):
            vehicles.steer_one(index, VELOCITY, (1.0, 0.5, 0.2))
        vehicles.advance(2_000_000)
        if wanted:
            vehicles.reset(1, (5.0, -4.0, 0.0), 7.0)
            assert vehicles.position[1].tolist() == [5.0, -4.0, 0.0]
            assert vehicles.yaw[1] == pytest.approx(7.0 - 2.0 * np.pi)
            assert not vehicles.armed[1]
        vehicles.advance(4_000_000)
        flights.append(vehicles)
    without, reset = flights
    assert np.array_equal(reset.position[[0, 2]], without.position[[0, 2]])
    assert reset.position[1].tolist() == [5.0, -4.0, 0.0]
    reset.reset(1)
    assert reset.armed[1]
    assert reset.yaw[1] == 1.0
    assert reset.position[1].tolist() == spawn_places(3)[1].tolist()
