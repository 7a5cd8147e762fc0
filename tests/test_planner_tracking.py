"""Vehicle and autopilot on a planner's trajectory: they stay on it, and stop where it ends."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from xtdrone_common import modes
from xtdrone_common.fleet import parse_fleet
from xtdrone_planning.planner_settings import PlannerSettings
from xtdrone_planning.replanning.planner import acceleration_setpoint
from xtdrone_planning.trajectories.speed_profile import SpeedProfile
from xtdrone_planning.trajectories.splines.uniform_spline import UniformSpline
from xtdrone_sim.simulation import Simulation

HEIGHT, LENGTH = 2.0, 20.0  # m
SPEED, ACCELERATION = 4.0, 2.1  # m/s, m/s^2, as planned within the default limits
KNOT, PERIOD, AFTER = 0.25, 0.06, 6.0  # s
UNCOMPENSATED = PlannerSettings(attitude_lag=0.0, drag=0.0, damping=0.0)


class Tracking(NamedTuple):
    """Greatest distance from the trajectory's place at the time; way beyond its end; distance from it in the end; m."""

    deviation: float
    overshoot: float
    rest: float


def line(start: float, place: np.ndarray) -> UniformSpline:
    """Return a trajectory to the north from rest to rest, in NED."""
    law = SpeedProfile.along(LENGTH, 0.0, SPEED, ACCELERATION)
    ways = np.concatenate([np.zeros(2), law.way(np.arange(math.ceil(law.duration / KNOT) + 2) * KNOT), [LENGTH] * 2])
    return UniformSpline(start, KNOT, place + ways[:, np.newaxis] * np.array([1.0, 0.0, 0.0]))


def flown(fleet: str, settings: PlannerSettings) -> Tracking:
    simulation = Simulation(parse_fleet(fleet))
    commander = simulation.commanders[0]

    def fly(seconds: float) -> None:
        simulation.run_until(simulation.time_us + round(seconds * 1e6))

    def estimate() -> np.ndarray:
        return np.array(commander.view.estimator["position"])

    fly(2.0)
    commander.parameters.set("MIS_TAKEOFF_ALT", HEIGHT)
    assert commander.request(modes.AUTO_TAKEOFF) == 0
    assert commander.arm_disarm(True) == 0
    fly(14.0)
    way = line(simulation.time_us * 1e-6 + 1.0, estimate())
    rows = []
    while (time := simulation.time_us * 1e-6) < way.end + AFTER:
        position, velocity, _ = way.at(time + settings.lead)
        acceleration = acceleration_setpoint(way, time + settings.lead, settings)
        commander.offboard.set_trajectory(tuple(position), tuple(velocity), tuple(acceleration), math.nan, math.nan)
        if commander.mode is not modes.OFFBOARD:
            fly(0.1)
            assert commander.request(modes.OFFBOARD) == 0
        fly(PERIOD)
        rows.append([estimate()[0] - way.points[0, 0], way.at(simulation.time_us * 1e-6)[0][0] - way.points[0, 0]])
    true, planned = np.array(rows).T
    return Tracking(np.abs(true - planned).max(), true.max() - LENGTH, abs(true[-1] - LENGTH))


def test_an_iris_stays_on_its_trajectory_and_stops_where_it_ends() -> None:
    found = flown("iris:1", PlannerSettings())
    assert found.deviation < 0.15
    assert found.overshoot < 0.1
    assert found.rest < 0.05


def test_without_compensation_the_integrator_carries_it_beyond_the_end() -> None:
    assert flown("iris:1", UNCOMPENSATED).overshoot > 0.25


def test_another_vehicle_overshoots_less_than_without_compensation() -> None:
    assert flown("typhoon_h480:1", PlannerSettings()).overshoot < 0.5 * flown("typhoon_h480:1", UNCOMPENSATED).overshoot
