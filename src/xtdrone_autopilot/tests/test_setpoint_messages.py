"""Setpoint messages: masks, frames and rejections, against a second implementation of PX4 v1.14's rules."""

from __future__ import annotations

import math
from types import SimpleNamespace

import numpy as np
import pytest
from autopilot_fakes import FakeAutopilot
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import common as mavlink
from service_fakes import SYSTEM, Served

from xtdrone_autopilot.commander.offboard_setpoint import SetpointError
from xtdrone_autopilot.mavlink.commands import setpoint_conversion
from xtdrone_autopilot.mavlink.wire import codec, frame_packing
from xtdrone_autopilot.state import TASK_ATTITUDE, TASK_RATES, TASK_TRAJECTORY
from xtdrone_autopilot.vehicle_view import VehicleView

_NAN = math.nan
_ORIGIN_ALTITUDE = 488.0

numbers = st.floats(-1e4, 1e4, width=32)
anything = st.one_of(numbers, st.just(_NAN))
nine = st.tuples(*[anything] * 9)
masks = st.integers(0, 0xFFFF)
angles = st.floats(-math.pi, math.pi)


class Recorder:
    """A commander that keeps its setpoints."""

    def __init__(self, q=(1.0, 0.0, 0.0, 0.0), home=True):
        autopilot = FakeAutopilot()
        autopilot.estimator[0]["q"] = q
        autopilot.estimator[0]["position"] = (10.0, 20.0, -30.0)
        self.view = VehicleView(autopilot, 0)
        self.home = SimpleNamespace(altitude=400.0) if home else None
        self.taken = []
        self.offboard = self

    def offset_start(self, values):
        return self.view.position, self.view.yaw

    def set_trajectory(self, position, velocity, acceleration, yaw, yaw_rate):
        self.taken.append(("trajectory", position, velocity, acceleration, yaw, yaw_rate))

    def set_attitude(self, q, yaw_rate, thrust):
        self.taken.append(("attitude", tuple(q), yaw_rate, thrust))

    def set_rates(self, rates, thrust):
        self.taken.append(("rates", rates, thrust))


def quaternion(roll, pitch, yaw):
    """Return (w, x, y, z) of rotations about z, y and x in turn, multiplied out by hand."""
    result = np.array([1.0, 0.0, 0.0, 0.0])
    for axis, angle in ((3, yaw), (2, pitch), (1, roll)):
        turn = np.zeros(4)
        turn[0], turn[axis] = math.cos(angle / 2), math.sin(angle / 2)
        (a, b), (v, w) = (result[0], turn[0]), (result[1:], turn[1:])
        result = np.array([a * b - v @ w, *(a * w + b * v + np.cross(v, w))])
    return tuple(result)


def matrix(roll, pitch, yaw):
    """Return the rotation from body to local as the product of three plane rotations."""
    c, s = math.cos, math.sin
    z = [[c(yaw), -s(yaw), 0], [s(yaw), c(yaw), 0], [0, 0, 1]]
    y = [[c(pitch), 0, s(pitch)], [0, 1, 0], [-s(pitch), 0, c(pitch)]]
    x = [[1, 0, 0], [0, c(roll), -s(roll)], [0, s(roll), c(roll)]]
    return np.array(z) @ np.array(y) @ np.array(x)


def local(values, mask, frame=1, yaw=0.5, yaw_rate=0.1):
    return mavlink.MAVLink_set_position_target_local_ned_message(0, SYSTEM, 1, frame, mask, *values, yaw, yaw_rate)


def masked(values, mask, first):
    return [_NAN if mask >> bit & 1 else value for bit, value in enumerate(values, first)]


def same(found, wanted):
    return np.allclose(found, wanted, rtol=1e-6, atol=1e-3, equal_nan=True)


@given(nine, masks)
def test_local_masks(values, mask):
    commander = Recorder()
    wanted = [masked(values[i : i + 3], mask, i) for i in (0, 3, 6)]
    is_set = [not all(map(math.isnan, part)) for part in wanted]
    forced = is_set[2] and mask & 512
    if forced or not any(is_set):
        with pytest.raises(
            setpoint_conversion.RefusedSetpointError, match="force not supported" if forced else "invalid"
        ):
            setpoint_conversion.local_target(commander, local(values, mask))
        return
    setpoint_conversion.local_target(commander, local(values, mask))
    ((_, *parts, yaw, yaw_rate),) = commander.taken
    assert same(parts, wanted)
    assert math.isnan(yaw) == bool(mask & 1024)
    assert math.isnan(yaw_rate) == bool(mask & 2048)


@given(nine, masks, angles, st.floats(-1.5, 1.5), angles)
def test_body_frame(values, mask, roll, pitch, yaw):
    commander = Recorder(quaternion(roll, pitch, yaw))
    velocity = None if mask & 0b000111000 else matrix(0.0, 0.0, yaw) @ values[3:6]
    acceleration = None if mask & 0b111000000 else matrix(roll, pitch, yaw) @ values[6:9]
    try:
        setpoint_conversion.local_target(commander, local(values, mask, frame=8))
    except setpoint_conversion.RefusedSetpointError:
        assert velocity is None or np.isnan(velocity).all() or mask & 512
        return
    ((_, *parts, found_yaw, _),) = commander.taken
    unset = [_NAN] * 3
    assert same(parts[0], unset)
    for found, wanted in zip(parts[1:], (velocity, acceleration), strict=True):
        if wanted is None or not np.isnan(wanted).any():  # a NaN part leaves its message subject to rounding
            assert same(found, unset if wanted is None else wanted)
    assert math.isnan(found_yaw) if mask & 1024 else found_yaw == 0.5, "from north"


def test_offset_frame_counts_from_the_vehicle():
    commander = Recorder(quaternion(0.0, 0.0, math.pi / 2))
    setpoint_conversion.local_target(commander, local((1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0), 0, frame=9))
    ((_, position, velocity, acceleration, yaw, _),) = commander.taken
    assert same(position, (8.0, 21.0, -27.0))
    assert same(velocity, (-5.0, 4.0, 6.0))
    assert same(acceleration, (-8.0, 7.0, 9.0))
    assert yaw == pytest.approx(0.5 + math.pi / 2)


@pytest.mark.parametrize("frame", [0, 2, 4, 7, 10, 12, 20, 255])
def test_frames_that_px4_rejects(frame):
    with pytest.raises(setpoint_conversion.RefusedSetpointError, match=f"coordinate frame {frame} unsupported"):
        setpoint_conversion.local_target(Recorder(), local([0.0] * 9, 0, frame))


def place(mask, frame=5, lat=47.3977420, lon=8.5455940, alt=500.0, **extra):
    values = {"vx": 0.0, "vy": 0.0, "vz": 0.0, "afx": 0.0, "afy": 0.0, "afz": 0.0, "yaw": 0.1, "yaw_rate": 0.2, **extra}
    return mavlink.MAVLink_set_position_target_global_int_message(
        0, SYSTEM, 1, frame, mask, round(lat * 1e7), round(lon * 1e7), alt, *values.values()
    )


@pytest.mark.parametrize(("frame", "z"), [(5, _ORIGIN_ALTITUDE - 500.0), (6, _ORIGIN_ALTITUDE - 900.0)])
def test_global_altitudes(frame, z):
    commander = Recorder()
    setpoint_conversion.global_target(commander, place(0b111111000, frame))
    ((_, position, velocity, *_),) = commander.taken
    assert same(position, (0.0, 0.0, z))
    assert all(map(math.isnan, velocity))


def test_a_global_position_is_applied_completely_or_not_at_all():
    commander = Recorder()
    setpoint_conversion.global_target(commander, place(0b111000001, frame=99))
    ((_, position, velocity, *_),) = commander.taken
    assert all(map(math.isnan, position)), "its frame does not matter then"
    assert velocity == (0.0, 0.0, 0.0)


@pytest.mark.parametrize(
    ("message", "aloud", "text"),
    [
        (place(0b111111000, frame=0), True, "invalid coordinate frame 0"),
        (place(0b111111000, frame=3), True, "invalid coordinate frame 3"),
        (place(0b1000000000), True, "force not supported"),
        (place(0b111111000, frame=11), False, "terrain"),
        (place(0b111111000, lat=91.0), False, "not allowed"),
    ],
)
def test_global_targets_that_are_rejected(message, aloud, text):
    with pytest.raises(SetpointError, match=text) as caught:
        setpoint_conversion.global_target(Recorder(), message)
    assert isinstance(caught.value, setpoint_conversion.RefusedSetpointError) == aloud


def test_altitude_over_home_needs_one():
    with pytest.raises(SetpointError, match="home"):
        setpoint_conversion.global_target(Recorder(home=False), place(0b111111000, frame=6))


def attitude(mask, q=(1.0, 0.0, 0.0, 0.0), rates=(0.1, 0.2, 0.3), thrust=0.5, body=(0.0, 0.0, 0.0)):
    """Return a decoded SET_ATTITUDE_TARGET, with the field that pymavlink's class lacks."""
    frame = frame_packing.Format("SET_ATTITUDE_TARGET")
    payload = frame.payload((0, *q, *rates, thrust, SYSTEM, 1, mask, *body))
    return codec.decoder("SET_ATTITUDE_TARGET")(frame.frame(payload, 0, 255, 190))


@given(st.integers(0, 255), st.tuples(*[numbers] * 3), st.floats(0, 1), st.tuples(*[numbers] * 3))
def test_attitude_masks(mask, rates, thrust, body):
    commander = Recorder()
    message = attitude(mask, rates=rates, thrust=thrust, body=body)
    setpoint_conversion.attitude_target(commander, message)
    collective = 0.0 if mask & 64 else thrust
    yaw_rate = _NAN if mask & 4 else rates[2]
    if not mask & 128:
        ((kind, _, found, lift),) = commander.taken
        assert kind == "attitude"
        assert same(found, yaw_rate)
        assert same(lift, -body[2] if mask & 32 else collective)
    elif mask & 3:
        assert commander.taken == [], "no report"
    else:
        ((kind, found, lift),) = commander.taken
        assert kind == "rates"
        assert same(found, (*rates[:2], yaw_rate))
        assert same(lift, collective)


# into the commander


@pytest.fixture
def flying():
    """A vehicle in OFFBOARD flight, with its services."""
    served = Served()
    served.ask(local((0.0, 0.0, -5.0, *[0.0] * 6), 0b110111111000))
    assert served.command(176, 1, 6)[0] == 0
    assert served.command(400, 1)[0] == 0
    served.autopilot.place(0, 0.0, 0.0, -5.0)
    served.commander.update()
    served.commander.texts.clear()
    return served


@pytest.mark.parametrize(
    ("values", "mask"),
    [
        ((1.0, 0, 0, 0, 0, 0, 0, 0, 0), 0b111111110),  # x alone
        ((1.0, 2.0, 0, 0, 0, 0, 0, 0, 0), 0b111111100),  # nothing for z
        ((1.0, 0, 3.0, 0, 2.0, 0, 0, 0, 0), 0b111101010),  # x by position, y by velocity
        ((math.inf, 2.0, 3.0, 0, 0, 0, 0, 0, 0), 0b111111000),
        ((_NAN, 2.0, 3.0, 0, 0, 0, 0, 0, 0), 0b111111000),
    ],
)
def test_unsupported_setpoints_stop_the_vehicle_and_keep_offboard_alive(flying, values, mask):
    for _ in range(20):
        flying.autopilot.time_us += 100_000
        assert not flying.ask(local(values, mask))
        flying.commander.update()
    setpoint = flying.autopilot.setpoint[0]
    assert setpoint["task"] == TASK_TRAJECTORY
    assert setpoint["velocity"].tolist() == [0.0, 0.0, 0.0]
    assert all(map(math.isnan, [*setpoint["position"], *setpoint["acceleration"], setpoint["yaw"]]))
    assert flying.commander.system_status == 4
    assert not flying.commander.texts
    assert any("cannot be flown" in text for text in flying.link.warnings)
    warned = len(flying.link.warnings)
    flying.ask(local((1.0, 2.0, 3.0, *[0.0] * 6), 0b111111000))
    assert len(flying.link.warnings) == warned


def test_rejected_setpoints_are_reported_at_1_hz_and_do_not_keep_offboard_alive(flying):
    before = str(flying.autopilot.setpoint)
    for _ in range(9):
        flying.autopilot.time_us += 100_000
        flying.ask(local((1.0, 2.0, 3.0, *[0.0] * 6), 0b111111000, frame=12))
    assert str(flying.autopilot.setpoint) == before
    text = "SET_POSITION_TARGET_LOCAL_NED coordinate frame 12 unsupported"
    assert list(flying.commander.texts) == [(2, text)]
    assert len(flying.link.warnings) == 9
    flying.autopilot.time_us += 300_000
    flying.commander.update()
    assert flying.commander.system_status == 5


def test_attitudes_and_rates_reach_the_records(flying):
    setpoint = flying.autopilot.setpoint[0]

    def target(mask, q=(1.0, 0.0, 0.0, 0.0), thrust=0.5, body=(0.0, 0.0, 0.0)):
        frame = frame_packing.Format("SET_ATTITUDE_TARGET")
        payload = frame.payload((0, *q, 0.1, 0.2, 0.3, thrust, SYSTEM, 1, mask, *body))
        flying.ask(frame.frame(payload, 0, 255, 190))

    target(0b11, q=(2.0, 0, 0, 0))
    assert setpoint["task"] == TASK_ATTITUDE
    assert setpoint["attitude_q"].tolist() == [1.0, 0.0, 0.0, 0.0]
    assert setpoint["rates"].tolist() == pytest.approx([0.0, 0.0, 0.3])
    target(0b100111, body=(0.0, 0.0, -0.7))
    assert setpoint["thrust"] == pytest.approx(0.7)
    target(0b1000111)
    assert setpoint["thrust"] == 0.0, "thrust that is ignored is none"
    target(0b10000100, thrust=_NAN)
    assert setpoint["task"] == TASK_RATES
    assert same(setpoint["rates"], (0.1, 0.2, _NAN))
    assert setpoint["thrust"] == 0.0
    before = str(flying.autopilot.setpoint)
    target(0, q=(_NAN, 0, 0, 0))
    target(0, q=(0, 0, 0, 0))
    target(0b10000001)
    assert str(flying.autopilot.setpoint) == before
