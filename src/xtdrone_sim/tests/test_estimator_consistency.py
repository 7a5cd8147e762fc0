"""Consistency of the estimator: its covariance matches its errors (Y. Bar-Shalom, X. R. Li, T. Kirubarajan,
"Estimation with Applications to Tracking and Navigation", 2001, section 5.4.2).

Fifty flights of the whole core at once: the vehicles of one simulation have noise streams of their own and do not
touch. Over N flights N times the average normalised estimation error squared (NEES) of an n-dimensional error is
chi-square distributed with N n degrees of freedom. Position, velocity and attitude are judged against the truth, each
alone and all nine together. The GPS receiver's slow wander, for which PX4's filter and this one have no state, is
covered by a larger EKF2_GPS_P_NOISE (iris.yaml); biases of gyroscope, accelerometer and magnetometer are states.
"""

from __future__ import annotations

import functools
import math

import numpy as np
import pytest

from xtdrone_common import frames, modes
from xtdrone_common.fleet import parse_fleet
from xtdrone_sim.simulation import Simulation

FLIGHTS = 50
UNSET = (math.nan, math.nan, math.nan)
BLOCKS = {"position": slice(6, 9), "velocity": slice(3, 6), "attitude": slice(0, 3), "all": slice(0, 9)}
# 95 % bounds of chi-square with 150 and 450 degrees of freedom, over 50 flights (tables, two-sided)
BOUNDS = {3: (117.985 / 50.0, 185.800 / 50.0), 9: (393.118 / 50.0, 510.670 / 50.0)}
TAKE_OFF = 7.5  # s after the start: all are well off the ground
LENGTH = 18.0  # s
FIRST_LOOK = 9.0  # s, in the air and manoeuvring
PERIOD = 0.5  # s between looks


def errors(simulation: Simulation) -> np.ndarray:
    """Return (n, 9) true minus estimated: attitude (rad, body), velocity (m/s) and position (m), NED."""
    plant, estimator = simulation.world.plant, simulation.autopilot.estimator
    rows = []
    for v, e in zip(plant, estimator, strict=True):
        true = frames.attitude_enu_to_ned(*v["q"])
        w, x, y, z = e["q"]
        turn = _product((w, -x, -y, -z), true)
        attitude = 2.0 * np.copysign(1.0, turn[0]) * np.array(turn[1:])
        velocity = np.array(frames.enu_to_ned(*v["velocity"])) - e["velocity"]
        position = np.array(frames.enu_to_ned(*v["position"])) - e["position"]
        rows.append(np.concatenate([attitude, velocity, position]))
    return np.array(rows)


def _product(a, b):
    return (
        a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
        a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
        a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
        a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0],
    )


def nees(simulation: Simulation) -> dict[str, float]:
    """Return the present average NEES of every block over the flights."""
    error, covariance = errors(simulation), simulation.autopilot.estimator["P"]
    averages = {}
    for name, part in BLOCKS.items():
        e, p = error[:, part], covariance[:, part, part]
        averages[name] = float(np.einsum("ni,ni->n", e, np.linalg.solve(p, e[:, :, None])[:, :, 0]).mean())
    return averages


@functools.cache
def fly(**parameters: float) -> dict[str, np.ndarray]:
    """Fly 50 vehicles on different paths; return the average NEES of every block at each sample."""
    places = [(60.0 * (i % 10), 60.0 * (i // 10), 0.0) for i in range(FLIGHTS)]
    simulation = Simulation(parse_fleet(f"iris:{FLIGHTS}"), seed=0, places=places)
    for commander in simulation.commanders:
        commander.parameters.set("MIS_TAKEOFF_ALT", 3.0)
        for name, value in parameters.items():
            commander.parameters.set(name, value)
    simulation.run_until(1_000_000)
    for commander in simulation.commanders:
        assert commander.request(modes.AUTO_TAKEOFF) == 0
        assert commander.arm_disarm(True) == 0
    simulation.run_until(round(TAKE_OFF * 1e6))
    looks = _wander(simulation)
    assert not simulation.world.collisions
    assert {commander.mode for commander in simulation.commanders} == {modes.OFFBOARD}
    simulation.close()
    return {name: np.array([look[name] for look in looks]) for name in BLOCKS}


def _wander(simulation: Simulation) -> list[dict[str, float]]:
    """Fly all vehicles with new velocity and yaw rate each second; return the samples."""
    rng = np.random.default_rng(100)
    looks = []
    for tick in range(round((LENGTH - TAKE_OFF) * 10.0)):
        if tick % 10 == 0:
            course, speed = rng.uniform(-math.pi, math.pi, FLIGHTS), rng.uniform(1.0, 4.0, FLIGHTS)
            climb, turn = rng.uniform(-1.0, 0.3, FLIGHTS), rng.uniform(-1.0, 1.0, FLIGHTS)
        for i, commander in enumerate(simulation.commanders):
            velocity = (speed[i] * math.cos(course[i]), speed[i] * math.sin(course[i]), climb[i])
            commander.offboard.set_trajectory(UNSET, velocity, UNSET, math.nan, turn[i])
            if tick == 0:
                assert commander.request(modes.OFFBOARD) == 0
        simulation.run_until(simulation.time_us + 100_000)
        seconds = simulation.time_us * 1e-6
        if seconds >= FIRST_LOOK and simulation.time_us % round(PERIOD * 1e6) == 0:
            looks.append(nees(simulation))
    return looks


def within(values: np.ndarray, dimension: int) -> np.ndarray:
    low, high = BOUNDS[dimension]
    return (values > low) & (values < high)


@pytest.mark.parametrize("block", list(BLOCKS))
def test_average_nees_lies_in_its_bounds(block):
    """They hold on the average of all samples, and at three samples of four, as neighbouring samples are dependent."""
    dimension = BLOCKS[block].stop - BLOCKS[block].start
    seen = fly()[block]
    assert within(seen.mean(keepdims=True), dimension).all(), seen.mean()
    assert within(seen, dimension).mean() >= 0.75, seen


@pytest.mark.parametrize(
    ("parameter", "factor", "block"),
    [
        ("EKF2_GPS_V_NOISE", 2.0, "velocity"),
        ("EKF2_GPS_P_NOISE", 2.0, "position"),
        ("EKF2_GPS_P_NOISE", 0.5, "position"),
        ("EKF2_MAG_NOISE", 0.2, "attitude"),
    ],
)
def test_wrong_noise_is_found_out(parameter, factor, block):
    """A filter with four times the variance, or a quarter, is inconsistent."""
    simulation = Simulation(parse_fleet("iris:1"))
    told = simulation.commanders[0].parameters.get(parameter)
    simulation.close()
    dimension = BLOCKS[block].stop - BLOCKS[block].start
    assert not within(fly(**{parameter: factor * told})[block].mean(keepdims=True), dimension).any()
