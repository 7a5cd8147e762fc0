"""AUTO.FOLLOW_TARGET: the estimate of the target, the setpoint relative to it, the acceptance of reports."""

from __future__ import annotations

import math

import numpy as np
import pytest
from autopilot_fakes import ORIGIN, Flight
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import common as mavlink
from service_fakes import Served

from xtdrone_autopilot.commander.commander import Result
from xtdrone_autopilot.flight_tasks.follow_target import TargetEstimate
from xtdrone_autopilot.flight_tasks.tasks.follow_task import follow_task, start_following
from xtdrone_autopilot.state import TASK_FOLLOW, TASK_GOTO
from xtdrone_common import modes

NAN = math.nan
UNKNOWN = (NAN, NAN, NAN)
DT = 0.02  # s between two runs of the flight task
SECOND = 1_000_000  # us


def at(seconds: float) -> int:
    return round(seconds * SECOND)


# the estimate


def test_gains_by_hand():
    """With FLW_TGT_RS 0.125, b = 1/2 for positions; the gains are 1 - b^3, 3/2 (1 - b)^2 (1 + b) and (1 - b)^3."""
    estimate = TargetEstimate()
    estimate.measure(at(1.0), (0.0, 0.0, 0.0), UNKNOWN, 0.125)
    estimate.measure(at(3.0), (8.0, 0.0, -16.0), UNKNOWN, 0.125)  # 2 s later
    np.testing.assert_allclose(estimate.position, (7.0, 0.0, -14.0))
    np.testing.assert_allclose(estimate.velocity, (2.25, 0.0, -4.5))
    np.testing.assert_allclose(estimate.acceleration, (0.25, 0.0, -0.5))


def test_gains_of_a_velocity_by_hand():
    """The gain of velocity is 1 - (0.9 b)^2, that of acceleration (1 - 0.9 b)^2 per second."""
    estimate = TargetEstimate()
    estimate.measure(at(1.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0.125)
    estimate.measure(at(1.4), (0.0, 0.0, 0.0), (1.0, 0.0, 0.0), 0.125)  # too early for another position
    assert estimate.position[0] == 0.0
    assert estimate.velocity[0] == pytest.approx(1.0 - 0.45**2)
    assert estimate.acceleration[0] == pytest.approx(0.55**2 / 0.4)


def test_a_steady_target_is_known_exactly_and_a_lost_one_stops_after_3_s():
    estimate = TargetEstimate()
    for second in range(1, 6):
        estimate.measure(at(second), (2.0 * second, -second, 0.0), (2.0, -1.0, 0.0), 0.5)
    estimate.advance(at(5.5))
    np.testing.assert_allclose(estimate.position, (11.0, -5.5, 0.0))
    np.testing.assert_allclose(estimate.velocity, (2.0, -1.0, 0.0))
    for seconds in (7.9, 8.05, 60.0):
        estimate.advance(at(seconds))
    np.testing.assert_allclose(estimate.position, (16.0, -8.0, 0.0))
    np.testing.assert_allclose(estimate.velocity, 0.0)


def test_a_repeated_position_counts_after_a_second_and_a_second_report_of_a_moment_never():
    estimate = TargetEstimate()
    estimate.measure(at(1.0), (0.0, 0.0, 0.0), (1.0, 0.0, 0.0), 0.1)
    estimate.measure(at(1.0), (5.0, 0.0, 0.0), UNKNOWN, 0.1)
    estimate.measure(at(1.8), (0.0, 0.0, 0.0), UNKNOWN, 0.1)
    assert estimate.position[0] == pytest.approx(0.8)
    estimate.measure(at(2.1), (0.0, 0.0, 0.0), UNKNOWN, 0.1)
    assert estimate.position[0] == pytest.approx(0.1 * 1.1)  # a share of 0.9 of the error


# the mode


class Following(Flight):
    """A vehicle that is always at its setpoint, 10 m above home, and a target."""

    def __init__(self, **parameters: float) -> None:
        super().__init__(**parameters)
        self.commander.arm_disarm(True)
        self.place(3.0, -5.0, -10.0)
        self.run(0.1)
        self.control = self.autopilot.control[0]
        self.records = (self.control, self.setpoint, self.autopilot.estimator[0], self.autopilot.params[0])
        start_following(self.control["followed"])

    def report(self, x: float, y: float, z: float = 0.0, velocity: tuple[float, float, float] = UNKNOWN) -> None:
        place = self.commander.view.to_global((x, y, z))
        self.commander.navigator.follow_target.report(place, velocity)

    def step(self) -> np.ndarray:
        """Run the flight task once; return position, velocity and acceleration of its setpoint, (3, 3)."""
        for name in ("task_position", "task_velocity", "task_acceleration"):
            self.control[name] = NAN
        self.control["armed_time"] += DT
        follow_task(*self.records, DT)
        return np.array([self.control[f"task_{name}"] for name in ("position", "velocity", "acceleration")])

    def fly(self, seconds: float) -> np.ndarray:
        """Move the vehicle along its setpoints for ``seconds``; return the setpoints, (n, 3, 3)."""
        rows = []
        for _ in range(round(seconds * 10)):
            for _ in range(5):
                rows.append(self.step())
                x, y, z = np.where(np.isnan(rows[-1][0]), self.records[2]["position"], rows[-1][0])
                self.place(x, y, z, float(self.control["task_yaw"]))
            self.run(0.1)
        return np.array(rows)


@pytest.mark.parametrize(
    ("speed", "parameters", "z"),
    [
        (0.0, {}, -8.0),
        (2.0, {}, -8.0),
        (2.0, {"FLW_TGT_FA": -90.0, "FLW_TGT_DST": 12.0, "FLW_TGT_HT": 11.0}, -11.0),
        (0.0, {"FLW_TGT_FA": 480.0, "FLW_TGT_ALT_M": 1}, -7.0),  # the ground is 1 m under home; 480 is 120 degrees
        (2.0, {"FLW_TGT_ALT_M": 2, "FLW_TGT_DST": -3.0}, -9.5),  # no nearer than 1 m
    ],
)
def test_position_beside_the_target(speed, parameters, z):
    """Distance, height and angle equal the closed form, for a target 1.5 m above home at rest or moving south-east.

    The filter has no steady error at constant velocity; after 20 s the initial error is below 1 mm: its slowest part,
    the approach to the angle, decays as e^-t.
    """
    course = math.radians(135.0) if speed else 0.0  # north until it moves
    velocity = (speed * math.cos(course), speed * math.sin(course), 0.0)
    flight = Following(**parameters)
    flight.autopilot.estimator[0]["terrain"], flight.autopilot.estimator[0]["terrain_valid"] = 1.0, 1
    flight.report(30.0, 40.0, -1.5, velocity)
    assert flight.commander.request(modes.AUTO_FOLLOW_TARGET) is Result.ACCEPTED
    assert flight.setpoint["task"] == TASK_FOLLOW
    for second in range(1, 21):
        flight.fly(1.0)
        flight.report(30.0 + velocity[0] * second, 40.0 + velocity[1] * second, -1.5, velocity)
    position, feed_forward, acceleration = flight.step()
    get = flight.parameters.get
    angle = course + math.radians(get("FLW_TGT_FA"))
    distance = max(get("FLW_TGT_DST"), 1.0)
    beside = np.array([math.cos(angle), math.sin(angle)]) * distance
    target = np.array([30.0, 40.0]) + np.array(velocity[:2]) * (20.0 + DT)
    np.testing.assert_allclose(position, (*(target + beside), z), atol=2e-3)
    np.testing.assert_allclose(feed_forward, (*velocity[:2], NAN), atol=2e-3)
    np.testing.assert_allclose(acceleration, (0.0, 0.0, NAN), atol=2e-3)
    flight.run(0.1)
    height = -z if get("FLW_TGT_ALT_M") == 0 else get("FLW_TGT_HT")
    # measured from the position to which the vehicle was moved, a step behind
    pitch = flight.commander.navigator.payload.gimbal[1]
    assert pitch == pytest.approx(-math.atan2(height, distance), abs=1e-3 + speed * DT / distance)
    if distance > 1.1:
        assert math.remainder(flight.control["task_yaw"] - angle - math.pi, math.tau) == pytest.approx(0.0, abs=0.01)


reports = st.lists(
    st.tuples(*[st.floats(-20.0, 20.0)] * 2, *[st.one_of(st.floats(-5.0, 5.0), st.just(NAN))] * 2),
    min_size=2,
    max_size=4,
)


@settings(max_examples=10, deadline=None)
@given(reports, st.floats(1.0, 30.0), st.floats(-180.0, 180.0), st.floats(0.0, 20.0))
def test_the_setpoint_has_no_steps(found, distance, angle, speed):
    """For any jump of the reports the setpoint moves by its own velocity, and round the target within the limit."""
    flight = Following(FLW_TGT_DST=distance, FLW_TGT_FA=angle, FLW_TGT_MAX_VEL=speed, FLW_TGT_HT=10.0)
    rows = []
    for x, y, north, east in found:
        flight.report(x, y, 0.0, (north, east, 0.0))
        flight.commander.request(modes.AUTO_FOLLOW_TARGET)
        for row in flight.fly(1.0):
            rows.append(row)
            assert abs(flight.control["followed"]["angle"]["velocity"][0]) * distance <= speed + 1e-9
    position, velocity, _ = np.array(rows).transpose(1, 0, 2)[:, :, :2]
    moved, changed = np.diff(position, axis=0), np.linalg.norm(np.diff(velocity, axis=0), axis=1)
    off = np.linalg.norm(moved - velocity[:-1] * DT, axis=1)
    # the mean velocity of a step differs from its first one by at most the change within it, and the arc's sagitta
    assert (off <= changed * DT + (speed * DT) ** 2 / distance + 1e-9).all()


def test_without_a_target_it_stops_and_with_a_lost_one_it_holds_position():
    flight = Following()
    flight.commander.request(modes.AUTO_FOLLOW_TARGET)
    position, velocity, _ = flight.step()
    assert np.isnan(position).all()
    assert (velocity == 0.0).all()
    flight.report(20.0, 0.0, 0.0, (2.0, 0.0, 0.0))
    flight.fly(15.0)
    assert flight.commander.mode is modes.AUTO_FOLLOW_TARGET
    # 3 s at 2 m/s from the last reported position, 8 m behind
    np.testing.assert_allclose(flight.step(), [(18.0, 0.0, -8.0), (0.0, 0.0, NAN), (0.0, 0.0, NAN)], atol=2e-3)


def test_near_the_ground_it_climbs_and_far_from_its_height_it_goes_nowhere_else():
    flight = Following()
    flight.report(20.0, 0.0)
    flight.commander.request(modes.AUTO_FOLLOW_TARGET)
    flight.place(1.0, 2.0, -0.5)
    position, velocity, _ = flight.step()
    np.testing.assert_array_equal(position, (NAN, NAN, -0.5))
    np.testing.assert_array_equal(velocity, (0.0, 0.0, -0.5))
    assert flight.control["want_takeoff"] == 1
    flight.place(1.0, 2.0, -4.9)
    position, velocity, _ = flight.step()
    np.testing.assert_array_equal(position, (1.0, 2.0, -8.0))
    assert np.isnan(velocity).all()


def test_it_is_rejected_without_a_position_and_prevents_arming():
    flight = Flight()
    assert flight.commander.request(modes.AUTO_FOLLOW_TARGET) is Result.ACCEPTED  # any mode is accepted while disarmed
    assert (flight.commander.base_mode, flight.commander.custom_mode) == (17, 4 << 16 | 8 << 24)
    flight.run(0.1)
    assert flight.commander.arm_disarm(True) is Result.TEMPORARILY_REJECTED
    flight.commander.request(modes.AUTO_LOITER)
    assert flight.commander.arm_disarm(True) is Result.ACCEPTED
    flight.place(0.0, 0.0, -10.0)
    flight.run(2.0)
    flight.autopilot.estimator["position_valid"] = 0
    flight.run(2.0)
    flight.texts()
    assert flight.commander.set_mode(1, 4 << 16 | 8 << 24) is Result.TEMPORARILY_REJECTED
    assert flight.texts() == ["Switching to AUTO_FOLLOW_TARGET is currently not available"]


def test_without_a_home_it_holds_position_until_one_is_set():
    flight = Following()
    navigator = flight.commander.navigator
    home, navigator.home = navigator.home, None
    navigator.activate(modes.AUTO_FOLLOW_TARGET)
    assert flight.setpoint["task"] == TASK_GOTO
    navigator.home = home
    navigator.update()
    assert flight.setpoint["task"] == TASK_FOLLOW


# acceptance of reports


def message(latitude=ORIGIN[0], longitude=ORIGIN[1], altitude=ORIGIN[2], velocity=(1.0, 2.0, 0.0)):
    nothing = (NAN, NAN, NAN)
    place = (round(latitude * 1e7), round(longitude * 1e7), altitude)
    return mavlink.MAVLink_follow_target_message(
        0, 1, *place, velocity, nothing, (1.0, NAN, NAN, NAN), nothing, nothing, 0
    )


@pytest.fixture
def served():
    served = Served()
    served.commander.arm_disarm(True)
    served.autopilot.place(0, 0.0, 0.0, -10.0)
    served.commander.update()
    assert served.commander.request(modes.AUTO_FOLLOW_TARGET) is Result.ACCEPTED
    return served


def estimated(served: Served) -> list[float]:
    setpoint = served.autopilot.setpoint[0]
    return [*setpoint["target_position"], *setpoint["target_velocity"]]


def test_a_report_by_mavlink(served):
    served.ask(message(velocity=(1.0, 2.0, NAN)))
    np.testing.assert_allclose(estimated(served), 0.0, atol=0.02)  # 1e-7 degrees are 1 cm
    served = Served()
    served.ask(message())  # before the mode, too
    served.commander.arm_disarm(True)
    served.commander.request(modes.AUTO_FOLLOW_TARGET)
    np.testing.assert_allclose(estimated(served), (0.0, 0.0, 0.0, 1.0, 2.0, 0.0), atol=0.02)


def test_a_participants_report_waits_for_the_end_of_the_tick(served):
    receiver, link = served.receiver, served.link
    frame = bytes(message().pack(link.client))
    receiver.hold_setpoints()
    receiver.handle_datagram(link, frame, ("127.0.0.1", 14550), served.autopilot.time_us, participant=True)
    assert np.isnan(estimated(served)[0])
    receiver.release_setpoints()
    assert not np.isnan(estimated(served)[0])


@pytest.mark.parametrize(
    "fields",
    [
        {"latitude": 91.0},
        {"longitude": -181.0},
        {"altitude": NAN},
        {"altitude": math.inf},
        {"altitude": 1e30},
        {"velocity": (math.inf, 0.0, 0.0)},
        {"velocity": (0.0, -1e4, 0.0)},
    ],
)
def test_reports_that_make_no_sense_are_rejected(served, fields):
    served.ask(message(**fields))
    assert np.isnan(estimated(served)[:3]).all()
    (warning,) = served.link.warnings
    assert warning.startswith("FOLLOW_TARGET rejected: ")
