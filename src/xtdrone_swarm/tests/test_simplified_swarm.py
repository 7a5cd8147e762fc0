"""The swarm in one process: the same classes, the order of a turn, repeatability, bad input."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from xtdrone_common.programs.user_classes import load_class
from xtdrone_coordination.follower import Follower
from xtdrone_coordination.leader import CommandError, Leader
from xtdrone_coordination.patterns import PatternError, Patterns
from xtdrone_swarm import Model, NetworkOptions, Swarm
from xtdrone_swarm.simplified.simplified_vehicles import SimplifiedVehicles
from xtdrone_swarm.swarm import MOST_VEHICLES


def test_nine_fly_the_patterns():
    swarm = Swarm(9)
    swarm.run(0.1)
    for pattern in ("cube", "pyramid", "triangle"):
        swarm.choose(pattern)
        assert swarm.run_until(settled=0.05)
        assert swarm.errors().shape == (8,)
        assert swarm.least_distance() > 1.5
    assert [choice.pattern for choice in swarm.record.choices] == ["cube", "pyramid", "triangle"]
    assert swarm.record.positions.shape == (len(swarm.record.times), 9, 3)
    assert swarm.record.times[:4] == pytest.approx([0.036, 0.068, 0.1, 0.136])


def test_the_same_inputs_lead_to_the_same_flight():
    flights = []
    swarm = Swarm(9, model="first-order")
    for _ in range(2):
        swarm.choose("cube")
        swarm.run(2.0)
        swarm.steer((0.5, 0.2, 0.1), 0.3)
        swarm.run(3.0)
        flights.append(swarm.record.positions.tobytes())
        swarm.restart()
    other = Swarm(9, model="first-order")
    other.choose("cube")
    other.run(2.0)
    other.steer((0.5, 0.2, 0.1), 0.3)
    other.run(3.0)
    assert flights[0] == flights[1] == other.record.positions.tobytes()


def test_the_leaders_messages_arrive_one_turn_later():
    swarm = Swarm(4)
    swarm.step()
    swarm.choose("pyramid")
    heard = []
    for _ in range(3):
        swarm.step()
        heard.append(swarm.followers[0].offsets is not None)
    assert heard == [False, True, True]
    assert np.array_equal(np.array(swarm.followers[2].offsets)[1:], swarm.leader.offsets.astype(np.float32))


def test_a_class_of_ones_own_and_its_options():
    class Lower(Follower):
        def control_law(self, position, peers):
            x, y, _ = super().control_law(position, peers)
            return np.array([x, y, -0.5])

    class Fixed(Leader):
        def topology(self, offsets):
            w = np.zeros((self.count, self.count))
            w[1:, 0] = 1.0
            return w

    swarm = Swarm(6, follower=Lower, leader=Fixed, follower_options={"vel_max": 9.0, "avoid": "off"})
    swarm.choose("cube")
    swarm.run(3.0)
    assert all(type(each) is Lower for each in swarm.followers)
    assert (swarm.leader.adjacency[1:, 0] == 1).all()
    assert (swarm.velocities[1:, 2] < -0.4).all()
    assert swarm.velocities[0, 2] == 0.0


def test_steering_holds_in_the_body_frame_until_the_next():
    swarm = Swarm(2, model=Model(order=1))
    swarm.steer((1.0, 0.0, 0.0))
    swarm.run(2.0)
    assert swarm.velocities[0] == pytest.approx([1.0, 0.0, 0.0])
    swarm.steer((1.0, 0.0, 0.5), math.pi / 4)
    swarm.run(2.0)
    assert math.hypot(*swarm.velocities[0, :2]) == pytest.approx(1.0)
    assert swarm.vehicles.yaw[0] == pytest.approx(math.pi / 2, abs=0.05)
    swarm.steer((0.0, 0.0, 0.0))
    swarm.run(3.0)
    assert np.abs(swarm.velocities[0]).max() < 0.01


def test_commands_by_leader_and_vehicle():
    swarm = Swarm(3, airborne=False)
    for i in range(3):
        assert swarm.vehicle(i, "AUTO.TAKEOFF") == swarm.vehicle(i, "ARM") == ""
    swarm.run(8.0)
    assert swarm.positions[:, 2] == pytest.approx([2.5] * 3, abs=0.02)
    swarm.command("OFFBOARD")
    swarm.step()
    assert list(swarm.vehicles.mode) == ["OFFBOARD", "AUTO.LOITER", "AUTO.LOITER"]
    with pytest.raises(CommandError, match="climb to"):
        swarm.command("pyramid")
    with pytest.raises(CommandError, match="'nonsense' is not a pattern of 3 vehicles"):
        swarm.command("nonsense")
    assert "iris_1" in swarm.vehicle(1, "DISARM")


def test_acceleration_mode_settles():
    swarm = Swarm(6, follower_options={"mode": "accel"}, model="first-order")
    swarm.choose("cube")
    assert swarm.run_until(settled=0.15, limit=60.0)


@pytest.mark.parametrize(
    ("options", "error", "words"),
    [
        ({"count": 1}, PatternError, "at least 2"),
        ({"count": 2.5}, ValueError, "2.5"),
        ({"follower": Leader}, TypeError, "inherits Follower"),
        ({"follower": "mine"}, TypeError, "'mine' is not a class"),
        ({"leader": Follower}, TypeError, "inherits Leader"),
        ({"kind": "zeppelin"}, ValueError, "'zeppelin' is not known"),
        ({"model": "fourth"}, ValueError, "'fourth' is not known"),
        ({"places": [[0, 0, 5]]}, ValueError, "9 x 3"),
        ({"altitude": -1.0}, ValueError, "altitude"),
        ({"follower_options": {"Kq": 1.0}}, ValueError, "Kq is not known"),
        ({"follower_options": 3}, TypeError, "FollowerOptions"),
        ({"leader_options": {"avoid": "maybe"}}, ValueError, "maybe"),
        ({"vehicles": SimplifiedVehicles(3)}, ValueError, "3 are given"),
        ({"patterns": Patterns(9), "pattern_file": "mine.yaml"}, ValueError, "'mine.yaml' too"),
        ({"patterns": Patterns(8)}, ValueError, "for 8 vehicles"),
        ({"network": {"loss": 2.0}}, ValueError, "loss"),
        ({"network": {"lossy": 0.1}}, ValueError, "lossy is not known"),
    ],
)
def test_bad_input(options, error, words):
    with pytest.raises(error, match=words):
        Swarm(**{"count": 9, **options})


def test_bad_steering_and_patterns():
    swarm = Swarm(9)
    for velocity, rate in (((math.nan, 0, 0), 0.0), ((1, 2), 0.0), ((0, 0, 0), math.inf)):
        with pytest.raises(ValueError, match="steering"):
            swarm.steer(velocity, rate)
    with pytest.raises(PatternError, match="pattern 'nonsense' is unknown for 9 vehicles"):
        swarm.choose("nonsense")
    with pytest.raises(ValueError, match="seconds"):
        swarm.run(-1.0)


def test_together_is_one_by_one_to_the_last_bit():
    class Alone(Follower):
        def update(self):
            return super().update()

    flights = []
    for cls in (Follower, Alone):
        swarm = Swarm(12, follower=cls)
        swarm.choose("cube")
        swarm.run(3.0)
        swarm.steer((0.5, 0.2, 0.1), 0.2)
        swarm.run(3.0)
        swarm.choose("triangle")
        swarm.run(3.0)
        flights.append(swarm.record.positions.tobytes())
    assert flights[0] == flights[1]


def test_a_network_delays_and_repeats_by_its_seed():
    ends = []
    for seed, options in ((1, {"loss": 0.7}), (1, {"loss": 0.7}), (2, {"loss": 0.7}), (1, {})):
        swarm = Swarm(9, network=options, seed=seed)
        swarm.choose("cube")
        swarm.run(4.0)
        ends.append(swarm.record.positions.tobytes())
        swarm.restart()
        swarm.choose("cube")
        swarm.run(4.0)
        assert swarm.record.positions.tobytes() == ends[-1]
    assert ends[0] == ends[1]
    assert len(set(ends)) == 3
    assert ends[3] == ideal_end()


def ideal_end() -> bytes:
    swarm = Swarm(9)
    swarm.choose("cube")
    swarm.run(4.0)
    return swarm.record.positions.tobytes()


def test_unreachable_vehicles_are_reported(caplog):
    class Chain(Leader):
        def topology(self, offsets):
            w = np.zeros((self.count, self.count))
            w[1, 0] = w[2, 1] = 1.0
            w[3, 4] = w[4, 3] = 1.0
            return w

    swarm = Swarm(5, leader=Chain)
    assert swarm.cut_off() == []
    swarm.choose("cube")
    swarm.step()
    assert swarm.cut_off() == [3, 4]
    assert "cuts off 3-4 of 5 vehicles" in caplog.text
    assert len(caplog.records) == 1


def test_out_of_range_they_stand_still_and_few_warnings_are_logged(caplog):
    swarm = Swarm(30, network=NetworkOptions(range=0.5))
    swarm.choose("cube")
    swarm.run(2.0)
    assert np.abs(swarm.velocities).max() < 1e-6
    assert swarm.cut_off() == list(range(1, 30))
    assert "the network's range cuts off 1-29 of 30 vehicles" in caplog.text
    assert "26 more such warnings" in caplog.text
    assert len(caplog.records) == 5


def test_a_poor_network_does_not_flood_the_log(caplog):
    swarm = Swarm(9, network=NetworkOptions(loss=0.7, burst=2.0))
    swarm.choose("cube")
    swarm.run(25.0)
    logged = {}
    for time, text in (record.getMessage().split(" s: ") for record in caplog.records):
        if "more such" not in text:
            logged.setdefault(text, []).append(float(time))
    assert max(map(len, logged.values())) == 3  # in 25 s
    assert all(np.diff(times).min(initial=10.0) >= 10.0 for times in logged.values())


def test_the_example_is_a_follower_for_all():
    path = Path(__file__).parents[1] / "examples" / "thousand.py"
    swarm = Swarm(9, follower=load_class(str(path), Follower))
    swarm.choose("cube")
    assert swarm.run_until(settled=0.1)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"count": MOST_VEHICLES + 1}, "10001 is not allowed, 2 to 10000"),
        ({"seed": -1}, "seed: -1 is not allowed"),
        ({"seed": "x"}, "seed: 'x' is not allowed"),
    ],
)
def test_numbers_out_of_range_are_rejected(settings, message):
    with pytest.raises(ValueError, match=message):
        Swarm(**settings)


@pytest.mark.parametrize("name", ["settled", "hold", "limit"])
@pytest.mark.parametrize("value", [-1.0, math.nan])
def test_settling_needs_numbers(name, value):
    with pytest.raises(ValueError, match=f"{name}: {value} is not allowed"):
        Swarm(3).run_until(**{name: value})


def test_taken_views_do_not_change():
    swarm = Swarm(3)
    seen = swarm.positions, swarm.velocities, swarm.true_positions
    before = [array.copy() for array in seen]
    swarm.steer((1.0, 0.0, 0.0))
    swarm.run(1.0)
    for array, old in zip(seen, before, strict=True):
        assert (array == old).all()
    assert swarm.positions[0, 0] > 0.3
