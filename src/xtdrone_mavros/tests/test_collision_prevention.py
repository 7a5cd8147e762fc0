"""Collision prevention against the closed form of PX4 v1.14's lib/collision_prevention."""

from __future__ import annotations

import math

import numpy as np
import pytest
from mavros_fakes import Bench
from pymavlink.dialects.v20 import common as mavlink
from sensor_msgs.msg import LaserScan
from service_fakes import SYSTEM, Served

from xtdrone_autopilot.flight_tasks.collision_prevention import prevent_collision, start_prevention
from xtdrone_autopilot.parameters.parameters import PARAMS, Parameters
from xtdrone_autopilot.state import ESTIMATOR, OBSTACLE_UNKNOWN, OBSTACLES
from xtdrone_common import modes
from xtdrone_common import rotation_kernels as rotation
from xtdrone_mavros.extras.obstacle_distance import ObstacleDistancePlugin

NOW_US = 20_000_000
PARAMETERS = {"CP_DIST": 3.0, "CP_DELAY": 0.4, "CP_GUIDE_ANG": 0.0}


class Prevention:
    """The kernel with its records; the map is filled with ``see``."""

    def __init__(self, yaw=0.0, **parameters):
        self.map, self.estimate, params = np.zeros(1, OBSTACLES)[0], np.zeros(1, ESTIMATOR)[0], np.zeros(1, PARAMS)
        Parameters(PARAMETERS | parameters).write_to(params[0])
        self.params = params[0]
        self.estimate["q"] = rotation.from_euler(0.0, 0.0, yaw)
        self.estimate["time_imu_us"] = NOW_US
        start_prevention(self.map, NOW_US)
        self.map["least"], self.map["largest"] = 20.0, 6000.0

    def see(self, distances, age_us=0):
        """Write distances (m) by direction; others of the map become free up to 60 m."""
        self.map["distances"], self.map["ranges"], self.map["covered"] = 6001.0, 6000.0, 1
        self.map["times_us"] = NOW_US - age_us
        for i, metres in distances.items():
            self.map["distances"][i] = metres * 100.0
        return self

    def __call__(self, x, y=0.0):
        return prevent_collision(self.map, self.estimate, self.params, x, y)


def speed_within(room, gain=0.95, accel=3.0, jerk=8.0):
    """Return the largest speed (m/s) for a distance of ``room`` m: P-controller, and braking within limits."""
    b = 4.0 * accel**2 / jerk
    return min(gain * room, 0.5 * (-b + math.sqrt(b * b + 8.0 * accel * room)))


@pytest.mark.parametrize("metres", [2.0, 3.0, 3.5, 5.0, 8.0, 14.0])
def test_the_speed_towards_an_obstacle_falls_with_the_distance(metres):
    """One direction of the map holds the obstacle; the velocity is at 0, 30 and 90 degrees from it."""
    room = max(metres - 3.0, 0.0)
    ahead = Prevention().see({0: metres})
    assert ahead(10.0)[0] == pytest.approx(min(speed_within(room), 10.0))
    x, y = Prevention().see({3: metres})(10.0)
    assert (x, y) == pytest.approx((min(10.0, speed_within(room) / math.cos(math.radians(30.0))), 0.0))
    assert Prevention().see({9: metres})(10.0) == pytest.approx((10.0, 0.0))


def test_closing_speed_delay_and_age_shorten_the_room():
    prevention = Prevention().see({0: 8.0}, age_us=200_000)
    prevention.estimate["velocity"] = (4.0, 0.0, 0.0)
    assert prevention(10.0)[0] == pytest.approx(speed_within(8.0 - 3.0 - 4.0 * 0.4 - 4.0 * 0.2))
    prevention = Prevention(CP_DELAY=0.0).see({0: 8.0}, age_us=200_000)
    prevention.estimate["velocity"] = (4.0, 0.0, 0.0)
    assert prevention(10.0)[0] == pytest.approx(speed_within(8.0 - 3.0 - 4.0 * 0.2))


def test_the_heading_turns_the_map():
    prevention = Prevention(yaw=math.pi / 2).see({0: 4.0})
    assert prevention(0.0, 10.0) == pytest.approx((0.0, speed_within(1.0)), abs=1e-9)
    assert prevention(10.0, 0.0) == pytest.approx((10.0, 0.0), abs=1e-9)


def test_the_direction_turns_towards_more_room():
    blocked = {35: 4.0, 0: 4.0, 1: 4.0}
    assert Prevention().see(blocked)(10.0)[1] == 0.0
    turned = Prevention(CP_GUIDE_ANG=30.0).see(blocked)(10.0)
    assert abs(math.degrees(math.atan2(turned[1], turned[0]))) == pytest.approx(30.0)
    assert Prevention(CP_GUIDE_ANG=9.0).see(blocked)(10.0)[1] == 0.0


def test_directions_without_data_are_closed_unless_allowed():
    for allowed, covered, expected in ((0, 0, 0.0), (1, 0, 5.0), (1, 1, 0.0)):
        prevention = Prevention(CP_GO_NO_DATA=allowed).see({})
        prevention.map["distances"][:3], prevention.map["covered"][:3] = OBSTACLE_UNKNOWN, covered
        assert prevention(5.0)[0] == expected, (allowed, covered)
    empty = Prevention(CP_GO_NO_DATA=1)
    assert empty(5.0) == (0.0, 0.0), "no data at all"


def test_without_recent_data_the_vehicle_stops_and_then_asks_for_the_hold_mode():
    prevention = Prevention().see({})
    asked = []
    for after_us in range(0, 8_000_000, 100_000):
        prevention.estimate["time_imu_us"] = NOW_US + after_us
        free = prevention(5.0)[0] > 0.0
        assert free == (after_us < 500_000)
        if prevention.map["hold"]:
            prevention.map["hold"] = 0
            asked.append(after_us)
    assert 5_000_000 < asked[0] <= 6_100_000
    assert np.diff(asked).min() > 1_000_000


# messages


def obstacles(distances, increment, *, frame=12, offset=0.0, least=20, largest=1500):
    cm = [int(100 * value) if math.isfinite(value) else 65535 for value in distances]
    cm += [65535] * (72 - len(cm))
    return mavlink.MAVLink_obstacle_distance_message(0, 0, cm, 0, least, largest, increment, offset, frame)


@pytest.fixture
def served():
    served = Served(Parameters({"MAV_SYS_ID": SYSTEM} | PARAMETERS))
    start_prevention(served.autopilot.control[0]["obstacles"], served.autopilot.time_us)
    return served


def distances(served):
    found = served.autopilot.control[0]["obstacles"]["distances"]
    return {i: value / 100.0 for i, value in enumerate(found.tolist()) if value != OBSTACLE_UNKNOWN}


def test_a_message_fills_the_directions_that_it_covers(served):
    served.ask(obstacles([5.0, 6.0, 7.0], 10.0, offset=-10.0))
    assert distances(served) == {35: 5.0, 0: 6.0, 1: 7.0}
    served.autopilot.time_us += 1000
    served.ask(obstacles([15.01] * 72, 5.0, largest=1500))  # nothing in range, same sensor
    assert set(distances(served).values()) == {15.01}
    assert served.autopilot.control[0]["obstacles"]["time_us"] == served.autopilot.time_us


@pytest.mark.parametrize(("frame", "index"), [(0, 27), (1, 27), (12, 0)])
def test_frames(served, frame, index):
    served.autopilot.place(0, 0.0, 0.0, -5.0, math.pi / 2)
    served.ask(obstacles([5.0], 10.0, frame=frame))
    assert distances(served) == {index: 5.0}


def test_an_unsupported_frame_is_refused_with_a_text(served):
    for _ in range(3):
        served.ask(obstacles([5.0], 10.0, frame=8))
    texts = [text.strip() for _, text in served.commander.texts]
    assert texts.count("Obstacle message received in unsupported frame 8") == 1
    assert not distances(served)


def test_nothing_is_stored_without_collision_prevention():
    served = Served()
    served.ask(obstacles([5.0] * 36, 10.0))
    assert not served.autopilot.control[0]["obstacles"]["distances"].any()


def test_a_sensor_that_sees_farther_does_not_hide_a_near_obstacle(served):
    served.ask(obstacles([5.0], 10.0, largest=1000))
    served.ask(obstacles([20.0], 10.0, largest=3000))
    assert distances(served)[0] == 5.0
    served.ask(obstacles([10.0], 10.0, largest=1000))  # gone
    served.ask(obstacles([20.0], 10.0, largest=3000))
    assert distances(served)[0] == 20.0


@pytest.mark.parametrize(
    ("orientation", "q", "found"),
    [(0, (1, 0, 0, 0), {35, 0, 1}), (2, (1, 0, 0, 0), {7, 8, 9, 10}), (6, (1, 0, 0, 0), {25, 26, 27, 28}),
     (100, (math.sqrt(0.5), 0, 0, math.sqrt(0.5)), {7, 8, 9, 10}), (24, (1, 0, 0, 0), set())],
)  # fmt: skip
def test_range_finders_that_look_sideways(served, orientation, q, found):
    width = math.radians(22.0)  # PX4 rounds the lower bound of a field of view across the nose towards zero
    served.ask(mavlink.MAVLink_distance_sensor_message(0, 20, 1500, 400, 0, 0, orientation, 0, width, 0.0, q, 0))
    assert set(distances(served)) == found
    assert set(distances(served).values()) <= {4.0}


def test_a_laser_scan_of_mavros_reaches_the_map(served):
    bench = Bench([ObstacleDistancePlugin], {"obstacle": {"mav_frame": "BODY_FRD"}})
    scan = LaserScan(angle_min=-math.pi, angle_max=math.pi, angle_increment=2 * math.pi / 360)
    scan.range_min, scan.range_max = 0.2, 15.0
    scan.ranges = [4.0 if 175 <= i <= 185 else 15.5 for i in range(360)]
    bench.call("obstacle/send", scan)
    served.ask(bench.received()[0])
    bench.close()
    near = {i for i, metres in distances(served).items() if metres < 15.0}
    assert near == {0}
    assert len(distances(served)) == 36


def test_the_map_is_sent_while_it_is_in_use(served):
    telemetry = served.link.telemetry.navigation
    assert telemetry.obstacle_distance() is None
    served.ask(obstacles([5.0], 10.0))
    served.autopilot.control[0]["obstacles"]["active_us"] = 0
    served.commander.armed, served.commander._active_mode = True, modes.POSCTL
    values = telemetry.obstacle_distance()
    assert len(values) == 80
    assert values[1:3] == (500, 65535)
    assert values[73:75] == (20, 1500)
    assert values[-3:] == (10.0, 0.0, 12)
