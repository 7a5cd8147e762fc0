"""The error-state filter against a known motion: convergence, biases, rejected outliers, lost GPS."""

from __future__ import annotations

import math

import numpy as np
import pytest

from xtdrone_autopilot.estimator import ekf
from xtdrone_autopilot.parameters.parameters import PARAMS, Parameters
from xtdrone_autopilot.state import ESTIMATOR, N_STATES, SENSORS
from xtdrone_common.geodesy import projection
from xtdrone_common.rotation_kernels import from_euler, integrate, rotate_inverse

DT = 0.004
DATUM = (47.397742, 8.545594, 488.0)
DECLINATION = 3.0
FIELD = 0.48 * np.array(
    [
        math.cos(math.radians(63.5)) * math.cos(math.radians(DECLINATION)),
        math.cos(math.radians(63.5)) * math.sin(math.radians(DECLINATION)),
        math.sin(math.radians(63.5)),
    ]
)


class Flight:
    """A vehicle that circles and turns, with noisy sensors written into one record, and the filter that fuses them."""

    def __init__(self, seed: int = 1, radius: float = 5.0) -> None:
        self.rng = np.random.default_rng(seed)
        self.radius = radius
        self.e = np.zeros(1, ESTIMATOR)[0:1]
        self.e["q"][:, 0] = 1.0
        for name, value in zip(("lat", "lon", "alt"), DATUM, strict=True):
            self.e["origin"][name] = value
        self.e["origin"]["set"] = 1
        self.s = np.zeros(1, SENSORS)
        self.p = np.zeros(1, PARAMS)
        Parameters({"EKF2_MAG_DECL": DECLINATION, "EKF2_GPS_P_NOISE": 0.1, "EKF2_GPS_V_NOISE": 0.1}).write_to(self.p[0])
        self.q = np.array(from_euler(0.05, -0.03, 0.7))
        self.gyro_bias = np.array([0.01, -0.008, 0.005])
        self.accel_bias = np.array([0.05, 0.03, -0.04])
        self.gps = True
        self.gps_offset = np.zeros(3)
        self.k = 0
        self.work = np.zeros((2, N_STATES))

    def truth(self, t: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return position, velocity and acceleration (NED): 2 s at rest, then a circle that starts from rest."""
        if t < 2.0:
            return np.zeros(3), np.zeros(3), np.zeros(3)
        phase = 0.05 * (t - 2.0) ** 2 if t < 12.0 else 5.0 + (t - 12.0)
        rate = 0.1 * (t - 2.0) if t < 12.0 else 1.0
        gain = 0.1 if t < 12.0 else 0.0
        cos, sin = math.cos(phase), math.sin(phase)
        position = self.radius * np.array([sin, 1.0 - cos, 0.0])
        velocity = self.radius * rate * np.array([cos, sin, 0.0])
        acceleration = self.radius * (gain * np.array([cos, sin, 0.0]) + rate**2 * np.array([-sin, cos, 0.0]))
        return position, velocity, acceleration

    def run(self, seconds: float) -> None:
        for _ in range(round(seconds / DT)):
            self._step()

    def _step(self) -> None:
        t = (self.k + 0.5) * DT
        rates = np.array([0.0, 0.0, 0.3 if t > 2.0 else 0.0])
        _, _, acceleration = self.truth(t)
        half = self.q.copy()
        integrate(half, *(0.5 * DT * rates))
        integrate(self.q, *(DT * rates))
        force = rotate_inverse(half, *(acceleration - np.array([0.0, 0.0, 9.80665])))
        s = self.s[0]
        self.k += 1
        s["time_us"] = self.k * 4000
        s["gyro"] = rates + self.gyro_bias + 0.003 * self.rng.standard_normal(3)
        s["accel"] = np.array(force) + self.accel_bias + 0.03 * self.rng.standard_normal(3)
        s["mag_fresh"] = self.k % 5 == 0
        s["mag"] = np.array(rotate_inverse(self.q, *FIELD)) + 0.002 * self.rng.standard_normal(3)
        position, velocity, _ = self.truth(self.k * DT)
        s["baro_fresh"] = self.k % 10 == 0
        s["baro_alt"] = DATUM[2] - position[2] + 12.0 + 0.1 * self.rng.standard_normal()
        s["gps_fresh"] = self.gps and self.k % 25 == 0
        noisy = position + self.gps_offset + 0.05 * self.rng.standard_normal(3)
        s["gps_lat"], s["gps_lon"] = projection.reproject(noisy[0], noisy[1], DATUM[0], DATUM[1])
        s["gps_alt"] = DATUM[2] - noisy[2]
        s["gps_vel"] = velocity + 0.05 * self.rng.standard_normal(3)
        s["gps_satellites"] = 12
        s["gps_fix"], s["gps_eph"], s["gps_epv"], s["gps_speed_accuracy"] = 3, 0.05, 0.05, 0.05
        ekf.update(self.e[0], s, self.p[0], DT, self.work)

    def errors(self) -> tuple[float, float, float]:
        """Return the present norms of the errors of position (m), velocity (m/s) and attitude (rad)."""
        position, velocity, _ = self.truth(self.k * DT)
        e = self.e[0]
        dot = abs(float(np.dot(self.q, e["q"])))
        return (
            float(np.linalg.norm(e["position"] - position)),
            float(np.linalg.norm(e["velocity"] - velocity)),
            2.0 * math.acos(min(dot, 1.0)),
        )


def test_converges_on_a_circle_and_estimates_the_gyro_bias():
    flight = Flight()
    flight.run(60.0)
    position, velocity, attitude = flight.errors()
    assert position < 0.15
    assert velocity < 0.15
    assert attitude < math.radians(1.5)
    np.testing.assert_allclose(flight.e["gyro_bias"][0], flight.gyro_bias, atol=2e-3)


def test_covariance_stays_symmetric_and_positive():
    flight = Flight()
    flight.run(20.0)
    covariance = flight.e["P"][0]
    np.testing.assert_array_equal(covariance, covariance.T)
    assert np.linalg.eigvalsh(covariance).min() > 0.0


def test_covariance_prediction_equals_the_dense_product():
    """The predicted covariance is Phi P Phi' + Q with the dense Phi of the error dynamics (Sola 2017, eq. 270)."""
    flight = Flight()
    flight.run(10.0)
    e, p = flight.e.copy(), flight.p[0]
    e["increments"]["angle"][0] = (0.01, -0.02, 0.03)
    e["increments"]["velocity"][0] = (0.02, 0.01, -0.08)
    e["increments"]["time"] = dt = 0.008
    before, q = e["P"][0].copy(), e["q"][0].copy()
    rotation = np.stack([np.array(ekf.rotate(q, *row)) for row in np.eye(3)], axis=1)

    def cross(v):
        return np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])

    phi = np.eye(N_STATES)
    phi[0:3, 0:3] -= cross(e["increments"]["angle"][0])
    phi[0:3, 9:12] = -dt * np.eye(3)
    phi[3:6, 0:3] = -rotation @ cross(e["increments"]["velocity"][0])
    phi[3:6, 12:15] = -dt * rotation
    phi[6:9, 3:6] = dt * np.eye(3)
    names = ("ekf2_gyr_noise", "ekf2_acc_noise", None, "ekf2_gyr_b_noise", "ekf2_acc_b_noise", "ekf2_mag_b_noise")
    noise = np.repeat([p[name] if name else 0.0 for name in names], 3)
    ekf.predict_covariance(e[0], p)
    np.testing.assert_allclose(e["P"][0], phi @ before @ phi.T + np.diag((noise * dt) ** 2), rtol=1e-9, atol=1e-12)


def test_an_outlier_is_rejected():
    flight = Flight()
    flight.run(20.0)
    flight.gps_offset[:] = (30.0, 0.0, 0.0)
    flight.run(0.2)
    assert flight.e["test_ratio"]["pos"][0] > 1.0
    assert flight.errors()[0] < 0.5


def test_lost_gps_invalidates_position_after_the_timeout_and_returns():
    flight = Flight()
    flight.run(15.0)
    assert flight.e["position_valid"][0] == 1
    flight.gps = False
    flight.run(5.5)
    assert flight.e["position_valid"][0] == 0
    flight.gps = True
    flight.run(1.0)
    assert flight.e["position_valid"][0] == 1
    assert flight.errors()[0] < 0.5


@pytest.mark.parametrize("yaw", [-3.0, -1.0, 0.0, 1.5, 3.0])
def test_alignment_finds_the_attitude_at_rest(yaw):
    flight = Flight()
    flight.q[:] = from_euler(0.1, -0.05, yaw)
    flight.accel_bias[:] = 0.0
    flight.run(0.6)
    assert flight.errors()[2] < math.radians(2.0)


def test_projection_round_trip_and_scale():
    lat, lon = projection.reproject(1000.0, -2000.0, DATUM[0], DATUM[1])
    np.testing.assert_allclose(projection.project(lat, lon, DATUM[0], DATUM[1]), (1000.0, -2000.0), atol=1e-6)
    north, _ = projection.project(DATUM[0] + 1.0 / 60.0, DATUM[1], DATUM[0], DATUM[1])
    assert north == pytest.approx(1853.0, rel=2e-3)  # a minute of arc on the sphere of PX4's radius
