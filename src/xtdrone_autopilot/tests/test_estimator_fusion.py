"""Each measurement model against finite differences of its prediction; updates and resets against dense algebra."""

from __future__ import annotations

import math

import numpy as np
import pytest

from xtdrone_autopilot.estimator import fusion
from xtdrone_autopilot.parameters.parameters import PARAMS, Parameters
from xtdrone_autopilot.state import ESTIMATOR, N_STATES, SENSORS
from xtdrone_common.rotation_kernels import from_euler, integrate, rotate, rotate_inverse

ATTITUDES = [(0.0, 0.0, 0.0), (0.3, -0.2, 1.1), (-0.6, 0.4, -2.5), (0.1, 1.0, 3.0)]
STEP = 1e-6
DECLINATION = 0.05
FIELD = (0.21, 0.02, 0.43)


def estimate(angles=(0.3, -0.2, 1.1)) -> np.ndarray:
    """Return an ESTIMATOR record with an arbitrary state and a positive covariance."""
    e = np.zeros(1, ESTIMATOR)
    e["q"][0] = from_euler(*angles)
    e["velocity"][0] = (2.0, -1.0, 0.4)
    e["position"][0] = (3.0, 4.0, -5.0)
    e["mag_bias"][0] = (0.01, -0.02, 0.005)
    root = np.random.default_rng(3).standard_normal((N_STATES, N_STATES))
    e["P"][0] = 0.01 * (root @ root.T + np.eye(N_STATES))
    return e


def moved(e: np.ndarray, state: int, amount: float) -> np.ndarray:
    """Return a copy whose error state ``state`` has been moved: q * exp(dtheta), the others added."""
    other = e.copy()
    if state < 3:
        turn = np.zeros(3)
        turn[state] = amount
        integrate(other["q"][0], *turn)
        return other
    names = ("velocity", "position", "gyro_bias", "accel_bias", "mag_bias")
    other[names[state // 3 - 1]][0, state % 3] += amount
    return other


def gradient(predict, e: np.ndarray) -> np.ndarray:
    """Return the central differences of ``predict`` with respect to each error state."""
    sides = [[predict(moved(e, i, sign * STEP)) for sign in (1, -1)] for i in range(N_STATES)]
    return np.array([math.remainder(up - down, math.tau) / (2 * STEP) for up, down in sides])


def row(**blocks) -> np.ndarray:
    h = np.zeros(N_STATES)
    for name, values in blocks.items():
        start = {"attitude": 0, "velocity": 3, "mag_bias": 15}[name]
        h[start : start + 3] = values
    return h


@pytest.mark.parametrize("angles", ATTITUDES)
def test_magnetic_heading(angles):
    """The prediction is the angle of the local field; the innovation is the declination minus the prediction."""
    e = estimate(angles)
    s = np.zeros(1, SENSORS)
    s["mag"][0] = np.array(rotate_inverse(e["q"][0], *FIELD)) + e["mag_bias"][0] + (0.01, 0.0, -0.01)

    def angle(state):
        x, y, _ = rotate(state["q"][0], *(s["mag"][0] - state["mag_bias"][0]))
        return math.atan2(y, x)

    fusion.track_field(e[0]["field"], e[0], s[0])
    innovation, attitude, bias, found = fusion.magnetic_heading(e[0], s[0], DECLINATION)
    assert found
    assert innovation == pytest.approx(math.remainder(DECLINATION - angle(e), math.tau))
    # the derivatives hold where the field points to the declination, whatever the sample's noise
    north, east, down = rotate(e["q"][0], *(s["mag"][0] - e["mag_bias"][0]))
    cos, sin = math.cos(innovation), math.sin(innovation)
    field = (cos * north - sin * east, sin * north + cos * east, down)
    s["mag"][0] = e["mag_bias"][0] + rotate_inverse(e["q"][0], *field)
    np.testing.assert_allclose(row(attitude=attitude, mag_bias=bias), gradient(angle, e), atol=1e-6)


def test_a_vertical_field_has_no_heading():
    e, s = estimate((0.0, 0.0, 0.0)), np.zeros(1, SENSORS)
    s["mag"][0] = e["mag_bias"][0] + (0.0, 0.0, 0.5)
    assert not fusion.magnetic_heading(e[0], s[0], 0.0)[3]


@pytest.mark.parametrize("angles", ATTITUDES)
def test_euler_yaw(angles):
    e = estimate(angles)

    def yaw(state):
        x, y, _ = rotate(state["q"][0], 1.0, 0.0, 0.0)
        return math.atan2(y, x)

    hy, hz = fusion.yaw_derivative(e["q"][0])
    np.testing.assert_allclose(row(attitude=(0.0, hy, hz)), gradient(yaw, e), atol=1e-6)


@pytest.mark.parametrize("angles", ATTITUDES[:3])
def test_optical_flow(angles):
    """The prediction is the flow of the point of level ground on the body's z axis."""
    e, hagl = estimate(angles), 4.0

    def flow(state, axis):
        """Return the rate of the line of sight to the ground point, by geometry: transverse velocity over distance."""
        q = state["q"][0]
        distance = hagl / rotate(q, 0.0, 0.0, 1.0)[2]
        vx, vy, _ = rotate_inverse(q, *state["velocity"][0])
        return (-vy, vx)[axis] / distance

    predicted, x_attitude, x_velocity, y_attitude, y_velocity = fusion.flow_prediction(e[0], hagl)
    rows = (row(attitude=x_attitude, velocity=x_velocity), row(attitude=y_attitude, velocity=y_velocity))
    for axis in range(2):
        assert predicted[axis] == pytest.approx(flow(e, axis))
        np.testing.assert_allclose(rows[axis], gradient(lambda state, a=axis: flow(state, a), e), atol=1e-6)


def test_update_equals_the_dense_kalman_update():
    e = estimate()
    before, p = e.copy(), e["P"][0].copy()
    work = np.zeros((2, N_STATES))
    hy, hz = fusion.yaw_derivative(e["q"][0])
    h = row(attitude=(0.0, hy, hz))
    innovation, noise = 0.02, 0.003
    variance = h @ p @ h + noise
    ratio = fusion.fuse_yaw(e[0], innovation, noise, 3.0, work)
    assert ratio == pytest.approx(innovation**2 / (9.0 * variance))
    gain = p @ h / variance
    np.testing.assert_allclose(e["P"][0], p - np.outer(gain, h @ p), atol=1e-12)
    np.testing.assert_allclose(e["velocity"][0], before["velocity"][0] + gain[3:6] * innovation, atol=1e-12)
    np.testing.assert_allclose(e["mag_bias"][0], before["mag_bias"][0] + gain[15:18] * innovation, atol=1e-12)
    q = before["q"][0].copy()
    integrate(q, *(gain[:3] * innovation))
    np.testing.assert_allclose(e["q"][0], q, atol=1e-12)


def test_an_innovation_beyond_the_gate_changes_nothing():
    e = estimate()
    before = e.copy()
    assert fusion.fuse_state(e[0], 6, 10.0, 0.01, 3.0, np.zeros((2, N_STATES))) > 1.0
    for name in ESTIMATOR.names:
        np.testing.assert_array_equal(e[name], before[name], err_msg=name)


def test_heading_update_reads_its_parameters():
    e, s, p = estimate(), np.zeros(1, SENSORS), np.zeros(1, PARAMS)
    Parameters({"EKF2_MAG_DECL": math.degrees(DECLINATION), "EKF2_HEAD_NOISE": 0.1}).write_to(p[0])
    s["mag"][0] = np.array(rotate_inverse(e["q"][0], *FIELD)) + e["mag_bias"][0]
    s["time_us"] = 5
    fusion.track_field(e[0]["field"], e[0], s[0])
    fusion.fuse_heading(e[0], s[0], p[0], np.zeros((2, N_STATES)))
    assert e["innovation"]["yaw"][0] == pytest.approx(DECLINATION - math.atan2(FIELD[1], FIELD[0]))
    assert 0.0 < e["test_ratio"]["mag"][0] < 1.0
    assert e["time_heading_fuse_us"][0] == 5


def test_resets_count_and_publish_their_deltas():
    e = estimate()
    e["located"] = e["altitude_valid"] = 1
    fusion.reset_position(e[0], 10.0, -10.0, 0.25)
    fusion.reset_velocity(e[0], 0.0, 0.0, 0.5)
    fusion.reset_height(e[0], -8.0, 2.0)
    fusion.reset_vertical_velocity(e[0], 0.0, 3.0)
    r = e[0]
    assert r["position"].tolist() == [10.0, -10.0, -8.0]
    assert r["shifts"]["xy"] == pytest.approx((7.0, -14.0))
    assert r["shifts"]["vxy"] == pytest.approx((-2.0, 1.0))
    assert (r["shifts"]["z"], r["shifts"]["vz"]) == pytest.approx((-3.0, -0.4))
    assert [int(r["resets"][name]) for name in ("xy", "vxy", "z", "vz", "any")] == [1, 1, 1, 1, 4]
    assert np.diagonal(r["P"])[3:9].tolist() == [0.5, 0.5, 3.0, 0.25, 0.25, 2.0]
    assert not r["P"][3:9, :3].any()
    np.testing.assert_array_equal(r["P"], r["P"].T)


@pytest.mark.parametrize("angles", ATTITUDES)
def test_yaw_reset_turns_about_the_vertical_and_keeps_the_tilt(angles):
    e = estimate(angles)
    down = np.array(rotate_inverse(e["q"][0], 0.0, 0.0, 1.0))
    level = np.eye(3) - np.outer(down, down)
    tilt = level @ e["P"][0, :3, :3] @ level
    north = math.atan2(*rotate(e["q"][0], 1.0, 0.0, 0.0)[1::-1])
    fusion.reset_yaw(e[0], 0.8, 0.04)
    assert math.remainder(
        math.atan2(*rotate(e["q"][0], 1.0, 0.0, 0.0)[1::-1]) - north - 0.8, math.tau
    ) == pytest.approx(0.0, abs=1e-12)
    np.testing.assert_allclose(rotate_inverse(e["q"][0], 0.0, 0.0, 1.0), down, atol=1e-12)
    np.testing.assert_allclose(e["P"][0, :3, :3], tilt + 0.04 * np.outer(down, down), atol=1e-12)
    np.testing.assert_allclose(down @ e["P"][0, :3, 3:], 0.0, atol=1e-12)
    assert (e["resets"]["heading"][0], e["shifts"]["heading"][0]) == (1, 0.8)
