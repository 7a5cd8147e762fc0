"""The estimator in flight: lost and regained GPS, vision, optical flow, frames, and failures."""

from __future__ import annotations

import math
import struct
from functools import partial

import numpy as np
import pytest

from xtdrone_autopilot.commander.commander import Result
from xtdrone_autopilot.mavlink.streams.telemetry import Telemetry
from xtdrone_autopilot.state import (
    FAILURE_GARBAGE,
    FAILURE_OFF,
    FAILURE_OK,
    FAILURE_SLOW,
    FAILURE_STUCK,
    FAILURE_WRONG,
    HEIGHT_BARO,
    HEIGHT_GPS,
    VISION_FRD,
    VISION_NED,
)
from xtdrone_autopilot.vehicle_view import move_origin
from xtdrone_common import frames, modes
from xtdrone_common.fleet import parse_fleet
from xtdrone_sim.autopilots.builtin_autopilot import BuiltinAutopilot
from xtdrone_sim.simulation import Simulation

UNSET = (math.nan, math.nan, math.nan)
STEP_US = 20_000


class Flight:
    """One vehicle flown by its commander, with vision if ``vision`` is given."""

    def __init__(self, kind: str = "iris", parameters: dict[str, float] | None = None, **options) -> None:
        self.simulation = Simulation(parse_fleet(f"{kind}:1"), **options)
        self.commander = self.simulation.commanders[0]
        for name, value in (parameters or {}).items():
            self.commander.parameters.set(name, value)
        self.e = self.simulation.autopilot.estimator[0]
        self.failures = self.simulation.autopilot.failures[0]
        self.vision = None
        self.setpoint = None

    @property
    def position(self) -> np.ndarray:
        return np.array(frames.enu_to_ned(*self.simulation.world.plant["position"][0]))

    @property
    def velocity(self) -> np.ndarray:
        return np.array(frames.enu_to_ned(*self.simulation.world.plant["velocity"][0]))

    @property
    def attitude(self) -> tuple[float, ...]:
        return frames.attitude_enu_to_ned(*self.simulation.world.plant["q"][0])

    @property
    def error(self) -> float:
        return float(np.linalg.norm(self.e["position"] - self.position))

    def run(self, seconds: float) -> None:
        end = self.simulation.time_us + round(seconds * 1e6)
        while self.simulation.time_us < end:
            if self.setpoint is not None:
                self.commander.offboard.set_trajectory(*self.setpoint)
            if self.vision is not None:
                self.vision(self)
            self.simulation.run_until(min(self.simulation.time_us + STEP_US, end))

    def until(self, field: str, value: int, limit: float) -> float:
        """Run until a field of the estimate has ``value``; return the elapsed time, s."""
        start = self.simulation.time_us
        while self.e[field] != value:
            assert self.simulation.time_us - start < limit * 1e6, f"{field} is still {self.e[field]}"
            self.run(0.02)
        return (self.simulation.time_us - start) * 1e-6

    def take_off(self, height: float) -> None:
        self.run(2.0)
        self.commander.parameters.set("MIS_TAKEOFF_ALT", height)
        assert self.commander.request(modes.AUTO_TAKEOFF) == 0
        assert self.commander.arm_disarm(True) == 0
        self.run(6.0 + height / 1.5)
        assert -self.position[2] > 0.6 * height

    def hold(self) -> None:
        """Hold the present estimated position in OFFBOARD."""
        self.setpoint = (tuple(self.e["position"].tolist()), UNSET, UNSET, math.nan, 0.0)
        self.run(0.2)
        assert self.commander.request(modes.OFFBOARD) == 0


def camera(frame: int = VISION_NED, yaw: float = 0.0, offset=(0.0, 0.0, 0.0), noise: float = 0.01, resets=lambda: 0):
    """Return a vision system whose frame is turned by ``yaw`` (rad) and moved by ``offset`` (m) against NED."""
    rng = np.random.default_rng(5)

    def see(flight: Flight) -> None:
        x, y, z = flight.position
        cos, sin = math.cos(yaw), math.sin(yaw)
        s = flight.simulation.autopilot.sensors[0]
        s["vision_frame"] = frame
        s["vision_position"] = np.array([cos * x + sin * y, -sin * x + cos * y, z]) + offset
        s["vision_position"] += noise * rng.standard_normal(3)
        s["vision_position_variance"] = noise**2
        turn = frames.quaternion_from_rpy(0.0, 0.0, -yaw)
        s["vision_q"] = _product(turn, flight.attitude)
        s["vision_yaw_variance"] = 1e-4
        s["vision_velocity"] = math.nan
        s["vision_quality"] = -1
        s["vision_reset_counter"] = resets()
        s["vision_fresh"] = 1

    return see


def _product(a, b):
    w, x, y, z = a
    return (
        w * b[0] - x * b[1] - y * b[2] - z * b[3],
        w * b[1] + x * b[0] + y * b[3] - z * b[2],
        w * b[2] - x * b[3] + y * b[0] + z * b[1],
        w * b[3] + x * b[2] - y * b[1] + z * b[0],
    )


VISION_ONLY = {"EKF2_GPS_CTRL": 0, "EKF2_HGT_REF": 3, "EKF2_EVP_NOISE": 0.02}


# GPS


def test_on_the_ground_with_gps_the_flags_are_those_of_px4():
    flight = Flight()
    flight.run(3.0)
    e = flight.e
    assert e["flags"] == 831
    for field in ("attitude_valid", "velocity_valid", "position_valid", "altitude_valid", "global_valid"):
        assert e[field] == 1
    for field in ("heading_good", "gps_good", "baro_good", "mag_good", "gps_used", "mag_used"):
        assert e[field] == 1
    assert not e["dead_reckoning"]
    assert e["resets"]["any"] == 0
    assert e["height_used"][HEIGHT_GPS] == e["height_used"][HEIGHT_BARO] == 1


def test_lost_gps_leads_to_dead_reckoning_and_returns_with_a_reset():
    flight = Flight()
    flight.take_off(25.0)
    flight.hold()
    flight.run(2.0)
    flight.failures["gps"] = FAILURE_OFF
    assert flight.until("dead_reckoning", 1, 2.0) == pytest.approx(1.0, abs=0.2)
    assert flight.e["position_valid"] == 1
    assert flight.until("position_valid", 0, 6.0) == pytest.approx(4.0, abs=0.2)  # EKF2_NOAID_TOUT after the last fix
    assert flight.e["velocity_valid"] == 0
    assert flight.e["altitude_valid"] == 1, "the barometer goes on"
    assert flight.simulation.autopilot.sensors["gps_fix"][0] == 0
    flight.setpoint = None
    flight.run(6.0)
    assert not flight.e["flags"] & 0x318, "no horizontal aiding after ten seconds of silence"
    assert flight.e["flags"] & 0x80
    counters = [int(flight.e["resets"][name]) for name in ("any", "xy", "vxy")]
    before = flight.e["position"][:2].copy()
    flight.failures["gps"] = FAILURE_OK
    assert flight.until("position_valid", 1, 2.0) < 1.0
    flight.run(1.0)
    assert flight.error < 0.2
    after = [int(flight.e["resets"][name]) for name in ("any", "xy", "vxy")]
    assert after[1:] == [counters[1] + 1, counters[2] + 1]
    assert after[0] > counters[0]
    moved = np.linalg.norm(before - flight.position[:2])
    assert np.linalg.norm(flight.e["shifts"]["xy"]) == pytest.approx(moved, abs=1.5)


def test_a_short_gap_in_gps_needs_no_reset():
    flight = Flight()
    flight.take_off(6.0)
    flight.hold()
    flight.failures["gps"] = FAILURE_OFF
    flight.run(3.0)
    assert flight.e["position_valid"] == 1
    flight.failures["gps"] = FAILURE_OK
    flight.run(2.0)
    assert flight.error < 0.2
    assert flight.e["resets"]["xy"] == 0
    assert flight.commander.mode is modes.OFFBOARD


def test_gps_that_fails_its_checks_is_not_used():
    flight = Flight(parameters={"EKF2_REQ_NSATS": 12})
    flight.simulation.world.models["gps_satellites"] = 8
    flight.run(4.0)
    assert (flight.e["gps_good"], flight.e["gps_used"], flight.e["position_valid"]) == (0, 0, 0)
    flight.simulation.world.models["gps_satellites"] = 14
    assert flight.until("position_valid", 1, 2.0) == pytest.approx(0.5, abs=0.25)  # EKF2_REQ_GPS_H


def test_a_gps_jump_is_rejected_until_it_persists():
    flight = Flight()
    flight.take_off(25.0)
    flight.hold()
    flight.failures["gps"] = FAILURE_WRONG
    flight.run(3.0)
    assert flight.e["flags"] & 1024
    assert flight.error < 3.0
    flight.setpoint = None
    flight.run(5.0)  # PX4's reset after seven seconds of refusal
    assert np.linalg.norm((flight.e["position"] - flight.position)[:2]) > 90.0
    assert flight.e["resets"]["xy"] == 1
    assert flight.e["shifts"]["xy"][0] == pytest.approx(100.0, abs=10.0)


@pytest.mark.parametrize("shared", [True, False])
def test_frames_share_a_datum_or_start_at_home(shared):
    flight = Flight(shared_datum=shared, places=[(30.0, 20.0, 0.0)])
    flight.run(3.0)
    expected = flight.position if shared else np.zeros(3)
    np.testing.assert_allclose(flight.e["position"], expected, atol=0.15)
    assert flight.e["global_valid"] == 1
    place = flight.commander.view.to_global(flight.commander.view.position)
    datum = flight.simulation.world.model.datum
    assert (place[0] - datum.latitude) * 111_194.9 == pytest.approx(20.0, abs=0.1)


# vision


def test_vision_alone_provides_position_in_its_frame():
    flight = Flight(parameters=VISION_ONLY, shared_datum=False)
    flight.run(2.0)
    assert flight.e["position_valid"] == 0
    flight.vision = camera(offset=(5.0, -3.0, -1.0))
    flight.take_off(4.0)
    flight.run(5.0)
    np.testing.assert_allclose(flight.e["position"], flight.position + np.array([5.0, -3.0, -1.0]), atol=0.05)
    np.testing.assert_allclose(flight.e["velocity"], flight.velocity, atol=0.1)
    assert (flight.e["vision_position_used"], flight.e["gps_used"], flight.e["global_valid"]) == (1, 0, 0)
    assert flight.e["flags"] & 0x3F == 0x3F
    move_origin(flight.e, 47.0, 8.0, 400.0)
    flight.run(0.2)
    assert flight.e["global_valid"] == 1
    np.testing.assert_allclose(flight.e["position"], flight.position + np.array([5.0, -3.0, -1.0]), atol=0.05)


def test_with_vision_alone_there_is_no_home_until_there_is_an_origin():
    """The vehicle flies by local position; global functions wait for an origin, as with PX4.

    Modes: mode_requirements.cpp; a takeoff without a successor: UserModeIntention.cpp, change. A shared frame changes
    nothing: the vehicle does not know its place on Earth.
    """
    flight = Flight(parameters={**VISION_ONLY, "COM_HOME_IN_AIR": 1}, shared_datum=True)
    commander = flight.commander
    flight.vision = camera()
    flight.take_off(4.0)
    assert commander.mode is modes.AUTO_TAKEOFF
    assert flight.e["global_valid"] == flight.e["origin"]["set"] == 0
    for mode in (modes.AUTO_LOITER, modes.AUTO_RTL, modes.AUTO_MISSION):
        assert commander.request(mode) is Result.TEMPORARILY_REJECTED
    assert commander.home is None
    assert commander.commands.set_home(None) is Result.TEMPORARILY_REJECTED
    assert commander.commands.set_home((47.0, 8.0, 400.0)) is Result.TEMPORARILY_REJECTED
    assert commander.commands.reposition((47.0, 8.0, 410.0), math.nan, math.nan) is Result.TEMPORARILY_REJECTED
    assert commander.commands.change_altitude(410.0) is Result.TEMPORARILY_REJECTED
    assert commander.request(modes.AUTO_RTL) is not Result.ACCEPTED
    telemetry = Telemetry(commander, flight.simulation.autopilot, 0)
    telemetry.refresh(flight.simulation.time_us)
    reports = telemetry.flight
    assert reports.local_position_ned() is not None
    for report in (reports.global_position_int, reports.home_position, reports.gps_global_origin):
        assert report() is None
    (above_sea,) = struct.unpack_from("<f", reports.altitude(), 8)
    assert math.isnan(above_sea)
    flight.hold()
    flight.run(2.0)
    assert commander.mode is modes.OFFBOARD
    move_origin(flight.e, 47.0, 8.0, 400.0)
    flight.run(0.3)
    assert commander.home is not None
    assert (commander.home.latitude, commander.home.longitude) == pytest.approx((47.0, 8.0), abs=1e-4)
    assert commander.request(modes.AUTO_LOITER) is Result.ACCEPTED
    assert commander.request(modes.AUTO_LAND) is Result.ACCEPTED
    flight.setpoint = None
    flight.run(12.0)
    assert commander.view.landed
    assert not commander.armed


def test_vision_in_a_frame_of_its_own_brings_its_heading():
    flight = Flight(parameters=VISION_ONLY)
    flight.vision = camera(VISION_FRD, yaw=1.2)
    flight.take_off(4.0)
    cos, sin = math.cos(1.2), math.sin(1.2)
    x, y, z = flight.position
    np.testing.assert_allclose(flight.e["position"], (cos * x + sin * y, -sin * x + cos * y, z), atol=0.05)
    yaw = frames.yaw_from_quaternion(tuple(flight.e["q"])) - frames.yaw_from_quaternion(flight.attitude)
    assert math.remainder(yaw + 1.2, math.tau) == pytest.approx(0.0, abs=0.03)
    assert (flight.e["vision_yaw_used"], flight.e["heading_aligned"], flight.e["mag_used"]) == (1, 0, 0)
    assert flight.e["heading_good"] == 0


def test_vision_that_begins_anew_resets_the_position():
    resets = [0]
    offset = np.zeros(3)
    flight = Flight(parameters=VISION_ONLY)
    flight.vision = camera(offset=offset, resets=lambda: resets[0])
    flight.take_off(4.0)
    before = int(flight.e["resets"]["xy"])
    offset[:2] = (2.0, -1.0)
    resets[0] = 1
    flight.run(0.2)
    np.testing.assert_allclose(flight.e["position"], flight.position + offset, atol=0.1)
    assert flight.e["resets"]["xy"] == before + 1
    np.testing.assert_allclose(flight.e["shifts"]["xy"], (2.0, -1.0), atol=0.1)


def test_vision_beside_gps_estimates_its_frame():
    flight = Flight()
    flight.run(2.0)
    flight.vision = camera(offset=(40.0, 7.0, 3.0))
    flight.take_off(4.0)
    flight.run(4.0)
    assert flight.e["vision_position_used"] == flight.e["gps_used"] == 1
    assert flight.error < 0.15
    np.testing.assert_allclose(flight.e["vision_offset"], (40.0, 7.0), atol=0.2)
    flight.hold()
    flight.failures["gps"] = FAILURE_OFF
    flight.run(10.0)
    assert flight.e["position_valid"] == 1, "vision carries on where GPS was"
    assert flight.error < 0.3


def test_lost_vision_times_out():
    flight = Flight(parameters=VISION_ONLY)
    flight.vision = camera()
    flight.take_off(15.0)
    flight.hold()
    flight.failures["vio"] = FAILURE_OFF
    assert flight.until("vision_good", 0, 1.0) < 0.6
    assert flight.until("position_valid", 0, 6.0) == pytest.approx(4.5, abs=0.4)


# optical flow and range


def test_flow_and_range_hold_a_hover_without_gps():
    flight = Flight("iris_opt_flow")
    flight.run(2.0)
    e = flight.e
    assert (e["position_valid"], e["flow_used"], e["terrain_valid"], e["gps_used"]) == (1, 1, 1, 0)
    assert e["flags"] & 0x10 == 0, "a position, but none that is absolute"
    flight.take_off(4.0)
    flight.hold()
    start, estimate = flight.position, e["position"].copy()
    flight.run(30.0)
    assert np.linalg.norm((flight.position - start)[:2]) < 1.0
    assert np.linalg.norm((e["position"] - estimate)[:2]) < 0.3
    assert e["terrain"] - e["position"][2] == pytest.approx(-flight.position[2], abs=0.1)
    flight.failures["optical_flow"] = FAILURE_OFF
    flight.until("position_valid", 0, 6.0)
    flight.failures["optical_flow"] = FAILURE_OK
    flight.until("position_valid", 1, 1.0)


def test_range_finder_holds_the_height_where_it_counts():
    flight = Flight("iris_opt_flow")
    flight.take_off(4.0)
    flight.hold()
    flight.failures["baro"] = FAILURE_WRONG
    flight.run(8.0)
    assert flight.e["position"][2] == pytest.approx(flight.position[2], abs=0.1)


# failures


def test_without_gyroscope_nothing_is_valid_until_it_is_back():
    flight = Flight()
    flight.run(3.0)
    flight.failures["gyro"] = FAILURE_OFF
    flight.run(0.3)
    assert (flight.e["attitude_valid"], flight.e["position_valid"], flight.e["altitude_valid"]) == (0, 0, 0)
    flight.failures["gyro"] = FAILURE_OK
    flight.run(1.0)
    assert (flight.e["attitude_valid"], flight.e["position_valid"], flight.e["altitude_valid"]) == (1, 1, 1)


@pytest.mark.parametrize("kind", [FAILURE_STUCK, FAILURE_GARBAGE, FAILURE_WRONG, FAILURE_OFF])
def test_a_hover_outlasts_a_bad_barometer_and_a_bad_magnetometer(kind):
    flight = Flight()
    flight.take_off(6.0)
    flight.hold()
    flight.failures["baro"] = flight.failures["mag"] = kind
    flight.run(9.0)
    assert flight.error < 0.4
    assert np.linalg.norm(flight.velocity) < 0.5
    if kind in (FAILURE_WRONG, FAILURE_OFF):
        assert flight.e["mag_good"] == 0


@pytest.mark.parametrize(
    ("unit", "field", "kind"),
    [
        ("gyro", "gyro", FAILURE_STUCK),
        ("accel", "accel", FAILURE_WRONG),
        ("mag", "mag", FAILURE_GARBAGE),
        ("baro", "baro_alt", FAILURE_STUCK),
        ("gps", "gps_lat", FAILURE_WRONG),
        ("optical_flow", "flow_rate", FAILURE_GARBAGE),
        ("distance_sensor", "range_distance", FAILURE_WRONG),
    ],
)
def test_failures_change_the_samples_and_end(unit, field, kind):
    """Compared with a twin without failure, samples differ during the failure, and the noise is the same after it."""
    flights = [Flight("iris_opt_flow"), Flight("iris_opt_flow")]
    for flight in flights:
        flight.run(1.0)
    flights[0].failures[unit] = kind
    samples = [np.array(f.simulation.autopilot.sensors[0][field]) for f in flights]
    np.testing.assert_array_equal(*samples)
    for flight in flights:
        flight.run(0.5)
    samples = [np.array(f.simulation.autopilot.sensors[0][field]) for f in flights]
    assert not np.array_equal(*samples)
    flights[0].failures[unit] = FAILURE_OK
    for flight in flights:
        flight.run(0.5)
    samples = [np.array(f.simulation.autopilot.sensors[0][field]) for f in flights]
    np.testing.assert_array_equal(*samples)


def test_a_slow_sensor_publishes_a_tenth_of_its_samples():
    flight = Flight()
    flight.run(1.0)
    counts = []
    for kind in (FAILURE_OK, FAILURE_SLOW):
        flight.failures["mag"] = kind
        count = 0
        for _ in range(1000):
            flight.simulation.step()
            count += int(flight.simulation.autopilot.sensors["mag_fresh"][0])
        counts.append(count)
    assert counts == [200, pytest.approx(20, abs=1)]


@pytest.mark.parametrize(("kind", "speed"), [(FAILURE_OFF, 0.0), (FAILURE_STUCK, None), (FAILURE_SLOW, None)])
def test_a_motor_fails(kind, speed):
    flight = Flight()
    flight.take_off(10.0)
    before = flight.simulation.world.plant["rotor_speed"][0].copy()
    flight.failures["motor"][1] = kind
    flight.run(0.3)
    after = flight.simulation.world.plant["rotor_speed"][0]
    if speed is not None:
        assert after[1] == pytest.approx(speed, abs=1.0)
    elif kind == FAILURE_STUCK:
        assert after[1] == pytest.approx(before[1], rel=0.2)
    else:
        assert after[1] < 600.1 < before[1], "at most half of what it can be told, above its idle speed"
    assert after[0] > 100.0


def test_the_same_failure_repeats_the_flight():
    finals = []
    for _ in range(2):
        flight = Flight()
        flight.take_off(6.0)
        flight.failures["gps"] = flight.failures["baro"] = FAILURE_GARBAGE
        flight.run(2.0)
        finals.append(flight.simulation.world.plant[0].tobytes())
    assert finals[0] == finals[1]


def test_a_loiter_continues_smoothly_over_a_reset():
    """The goal is fixed in the world: the vehicle flies there from its corrected position without a jerk."""
    resets = [0]
    offset = np.zeros(3)
    flight = Flight(parameters=VISION_ONLY, autopilots=partial(BuiltinAutopilot, datum_known=True))
    flight.vision = camera(offset=offset, resets=lambda: resets[0])
    flight.take_off(5.0)
    flight.run(3.0)
    assert flight.commander.mode is modes.AUTO_LOITER
    goal = flight.e["position"].copy()
    offset[:2] = (3.0, 0.0)
    resets[0] = 1
    tilts = []
    for _ in range(500):
        flight.run(0.02)
        down = frames.rotate(flight.attitude, (0.0, 0.0, 1.0))
        tilts.append(math.degrees(math.acos(min(down[2], 1.0))))
    assert max(tilts) < 17.0  # 20 degrees when the smoothed path does not follow the reset
    np.testing.assert_allclose(flight.e["position"], goal, atol=0.4)
