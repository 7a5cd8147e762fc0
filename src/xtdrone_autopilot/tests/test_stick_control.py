"""Manual flight's kernels, the hover thrust estimate and the takeoff ramp against closed forms."""

from __future__ import annotations

import math

import numpy as np
import pytest

from xtdrone_autopilot.control import hover_thrust, position_control
from xtdrone_autopilot.flight_tasks.tasks import stick_control
from xtdrone_autopilot.parameters.parameters import PARAMS, Parameters
from xtdrone_autopilot.state import (
    CONTROL,
    ESTIMATOR,
    SETPOINT,
    TAKEOFF_DISARMED,
    TAKEOFF_FLIGHT,
    TAKEOFF_RAMPUP,
    TAKEOFF_READY,
    TAKEOFF_SPOOLUP,
)
from xtdrone_common import rotation_kernels as rotation

DT = 0.004
GRAVITY = 9.80665


@pytest.fixture
def parts():
    """A control record in the air after the spool-up, setpoint, estimate and parameters."""
    control, setpoint = np.zeros(1, CONTROL), np.zeros(1, SETPOINT)
    estimate, params = np.zeros(1, ESTIMATOR), np.zeros(1, PARAMS)
    estimate["q"][:, 0] = 1.0
    Parameters({}).write_to(params[0])
    control["throttle_min"], control["throttle_max"] = params["mpc_manthr_min"], 1.0
    return control[0], setpoint[0], estimate[0], params[0]


@pytest.mark.parametrize(
    ("curve", "throttle", "thrust"),
    [(0, 0.0, 0.08), (0, 0.5, 0.5), (0, 1.0, 1.0), (0, 0.75, 0.75), (1, 0.0, 0.08), (1, 0.5, 0.54), (1, 1.0, 1.0)],
)
def test_thrust_curve(parts, curve, throttle, thrust):
    c, _, _, p = parts
    p["mpc_thr_curve"] = curve
    assert stick_control.stick_thrust(c, p, throttle) == pytest.approx(thrust)


def test_thrust_is_withheld_until_the_motors_have_spooled_up(parts):
    c, _, _, p = parts
    c["armed_time"] = 0.5 * p["com_spoolup_time"]
    stick_control.update_throttle_limits(c, p, 1, DT)
    assert stick_control.stick_thrust(c, p, 1.0) == 0.0
    c["armed_time"] = p["com_spoolup_time"]
    for _ in range(round(1.0 / DT)):
        stick_control.update_throttle_limits(c, p, 1, DT)
    assert stick_control.stick_thrust(c, p, 1.0) == pytest.approx(0.5)  # half a unit a second


def test_least_thrust_is_zero_on_the_ground(parts):
    c, _, _, p = parts
    c["landing"]["landed"] = 1
    for _ in range(round(3.0 / DT)):
        stick_control.update_throttle_limits(c, p, 1, DT)
    assert c["throttle_min"] == 0.0


@pytest.mark.parametrize(("forward", "right"), [(1.0, 0.0), (0.0, -1.0), (0.5, 0.5), (1.0, 1.0)])
def test_sticks_tilt_towards_where_they_point(parts, forward, right):
    c, s, e, p = parts
    e["q"] = rotation.from_euler(0.0, 0.0, 1.0)
    c["path"]["yaw"] = 1.0
    s["stick_x"], s["stick_y"], s["stick_z"] = forward, right, 0.0
    stick_control.stick_attitude(c, s, e, p, DT)
    x, y, z = rotation.rotate(c["sp_q"], 0.0, 0.0, 1.0)
    size = min(math.hypot(forward, right), 1.0)
    assert math.degrees(math.acos(z)) == pytest.approx(size * p["mpc_man_tilt_max"], abs=1e-6)
    # the thrust, opposite to the body's z, leans in the direction of the stick, relative to the heading
    assert math.atan2(-y, -x) == pytest.approx(1.0 + math.atan2(right, forward), abs=1e-6)


def test_yaw_stick_turns_the_heading_unless_the_throttle_is_down(parts):
    c, s, e, p = parts
    s["stick_yaw"] = 0.5
    for _ in range(250):
        stick_control.stick_attitude(c, s, e, p, DT)
    assert math.degrees(c["path"]["yaw"]) == pytest.approx(0.5 * p["mpc_man_y_max"], rel=1e-6)
    s["stick_z"] = -1.0
    before = float(c["path"]["yaw"])
    stick_control.stick_attitude(c, s, e, p, DT)
    assert c["path"]["yaw"] == before
    assert c["sp_yaw_rate"] == 0.0


def test_full_sticks_give_the_largest_rates(parts):
    c, s, _, p = parts
    s["stick_x"], s["stick_y"], s["stick_yaw"], s["stick_z"] = 1.0, -1.0, 1.0, 0.2
    stick_control.stick_rates(c, s, p)
    np.testing.assert_allclose(np.degrees(c["sp_rates"]), (-720.0, -720.0, 540.0))
    assert c["sp_thrust"] == pytest.approx(0.6)


def test_half_a_stick_follows_the_rate_curve(parts):
    """The rate is PX4's superexpo, ((1 - e) x + e x^3) (1 - g) / (1 - |x| g)."""
    c, s, _, p = parts
    s["stick_y"] = 0.5
    stick_control.stick_rates(c, s, p)
    expo, steep = 0.69, 0.7
    share = ((1.0 - expo) * 0.5 + expo * 0.125) * (1.0 - steep) / (1.0 - 0.5 * steep)
    assert math.degrees(c["sp_rates"][0]) == pytest.approx(720.0 * share)


@pytest.mark.parametrize("truth", [0.4, 0.6])
def test_hover_thrust_is_found(parts, truth):
    c, _, e, p = parts
    hover_thrust.reset_hover_thrust(c["hover"], p)
    rng = np.random.default_rng(1)
    for _ in range(800):
        thrust = truth * (1.0 + 0.1 * rng.standard_normal())
        e["acceleration"] = (0.0, 0.0, -GRAVITY * (thrust / truth - 1.0) + 0.3 * rng.standard_normal())
        hover_thrust.estimate_hover_thrust(c["hover"], e, p, thrust, 0.012)
    assert c["hover"]["valid"] == 1
    assert c["hover"]["estimate"] == pytest.approx(truth, rel=0.03)


def test_hover_thrust_is_limited_to_its_range(parts):
    c, _, e, p = parts
    hover_thrust.reset_hover_thrust(c["hover"], p)
    for _ in range(800):
        hover_thrust.estimate_hover_thrust(c["hover"], e, p, 0.95, 0.012)
    assert c["hover"]["estimate"] == pytest.approx(p["mpc_thr_hover"] + p["hte_thr_range"])


def test_takeoff_goes_through_its_stages(parts):
    c, _, _, p = parts
    c["landing"]["landed"] = 1
    seen = []
    for step in range(500):
        c["armed_time"] = step * 0.012
        position_control.update_takeoff(c["takeoff"], c, 1, p, step * 0.012 > 1.5, False)
        position_control.update_ramp(c["takeoff"], p, 3.0, 0.012)
        c["landing"]["landed"] = 1 if c["takeoff"]["state"] < TAKEOFF_RAMPUP else 0
        if not seen or seen[-1][0] != c["takeoff"]["state"]:
            seen.append((int(c["takeoff"]["state"]), step * 0.012))
    states = [state for state, _ in seen]
    assert states == [TAKEOFF_SPOOLUP, TAKEOFF_READY, TAKEOFF_RAMPUP, TAKEOFF_FLIGHT]
    times = dict(seen)
    assert times[TAKEOFF_READY] == pytest.approx(p["com_spoolup_time"], abs=0.02)
    assert times[TAKEOFF_FLIGHT] - times[TAKEOFF_RAMPUP] == pytest.approx(p["mpc_tko_ramp_t"], abs=0.03)
    position_control.update_takeoff(c["takeoff"], c, 0, p, True, False)
    assert c["takeoff"]["state"] == TAKEOFF_DISARMED


def test_ramp_begins_where_no_thrust_is_left(parts):
    c, _, _, p = parts
    c["takeoff"]["state"] = TAKEOFF_RAMPUP
    position_control.update_ramp(c["takeoff"], p, 3.0, 0.0)
    start = -GRAVITY / p["mpc_z_vel_p_acc"]
    assert c["takeoff"]["ramp_speed"] == pytest.approx(start, abs=0.02)
    c["takeoff"]["ramp_progress"] = 0.5
    position_control.update_ramp(c["takeoff"], p, 3.0, 0.0)
    assert c["takeoff"]["ramp_speed"] == pytest.approx(0.5 * (start + 3.0))


def test_nothing_is_ramped_up_where_nothing_controls_the_climb(parts):
    c, _, _, p = parts
    position_control.update_takeoff(c["takeoff"], c, 1, p, False, True)
    assert c["takeoff"]["state"] == TAKEOFF_FLIGHT
