"""The heading over minutes at rest and over turns, and a rejected magnetometer.

At a constant heading a yaw error and a magnetometer bias look the same: no correction may move both together there.
"""

from __future__ import annotations

import functools
import math

import numpy as np
import pytest

from xtdrone_common import frames, modes
from xtdrone_common.fleet import parse_fleet
from xtdrone_sim.simulation import Simulation

UNSET = (math.nan, math.nan, math.nan)
STILL = (0.0, 0.0, 0.0)
VEHICLES = 24
# heading (deg) and how long it is held, s
LEGS = ((90.0, 60.0), (0.0, 30.0), (-90.0, 15.0), (-180.0, 15.0), (90.0, 10.0))
GROUND = 40.0  # s
REFUSED = 7.0  # s until the magnetometer is accepted after all


class Fleet:
    """Vehicles that turn on the spot."""

    def __init__(self, count: int, seed: int, **parameters: float) -> None:
        places = [(10.0 * (i % 6), 10.0 * (i // 6), 0.0) for i in range(count)]
        self.simulation = Simulation(parse_fleet(f"iris:{count}"), seed=seed, places=places)
        self.estimator = self.simulation.autopilot.estimator
        for commander in self.simulation.commanders:
            commander.parameters.set("MIS_TAKEOFF_ALT", 3.0)
            for name, value in parameters.items():
                commander.parameters.set(name, value)

    def run(self, seconds: float) -> None:
        self.simulation.run_until(self.simulation.time_us + round(seconds * 1e6))

    def take_off(self) -> None:
        for commander in self.simulation.commanders:
            assert commander.request(modes.AUTO_TAKEOFF) == 0
            assert commander.arm_disarm(True) == 0
        self.run(6.0)

    def hold(self, heading: float) -> None:
        """Hold the position and a heading (rad) for 0.2 s."""
        for commander in self.simulation.commanders:
            commander.offboard.set_trajectory(UNSET, STILL, UNSET, heading, math.nan)
            if commander.mode is not modes.OFFBOARD:
                assert commander.request(modes.OFFBOARD) == 0
        self.run(0.2)

    def heading_errors(self) -> np.ndarray:
        """Return true minus estimated heading, rad, (n,)."""
        true = [frames.yaw_from_quaternion(frames.attitude_enu_to_ned(*v["q"])) for v in self.simulation.world.plant]
        seen = [frames.yaw_from_quaternion(tuple(e["q"])) for e in self.estimator]
        return np.array([math.remainder(a - b, math.tau) for a, b in zip(true, seen, strict=True)])

    def refused_for(self) -> np.ndarray:
        """Return the time since the last accepted magnetometer sample, s, (n,)."""
        return (self.simulation.time_us - self.estimator["time_heading_fuse_us"]) * 1e-6


@functools.cache
def minutes() -> dict[str, np.ndarray]:
    """Run 24 vehicles on the ground, hovering and turning for three minutes; return samples at 1 Hz."""
    fleet = Fleet(VEHICLES, seed=11)
    seen: dict[str, list] = {"error": [], "refused": [], "deviation": []}

    def look() -> None:
        seen["error"].append(fleet.heading_errors())
        seen["refused"].append(fleet.refused_for())
        seen["deviation"].append(np.sqrt(fleet.estimator["P"][:, 2, 2]))  # level: body z is the vertical

    for _ in range(round(GROUND)):
        fleet.run(1.0)
        look()
    fleet.take_off()
    for heading, seconds in LEGS:
        for tick in range(round(seconds * 5.0)):
            fleet.hold(math.radians(heading))
            if tick % 5 == 4:
                look()
    assert not fleet.simulation.world.collisions
    fleet.simulation.close()
    return {name: np.array(values) for name, values in seen.items()}


def test_the_heading_is_accurate_for_minutes():
    """A bias of 0.005 gauss (1 sigma) in a field of 0.21 gauss is 1.4 degrees; turns reduce it."""
    error = np.degrees(np.abs(minutes()["error"]))
    assert error.max() < 5.0  # 24 vehicles: 3 sigma
    assert error[-10:].max() < 0.5, "after the turns"


def test_the_heading_error_agrees_with_its_variance():
    """No sample exceeds its standard deviation by much, and the average of 24 vehicles is within chi-square bounds."""
    seen = minutes()
    squares = (seen["error"] / seen["deviation"]) ** 2
    low, high = 12.401 / VEHICLES, 39.364 / VEHICLES  # 95 % of chi-square with 24 degrees of freedom
    averages = squares.mean(axis=1)
    assert low < averages.mean() < high
    assert ((averages > low) & (averages < high)).mean() > 0.7, averages


def test_the_heading_does_not_wander_at_rest():
    """While 24 vehicles hover, their errors change by no more than the filter's own corrections."""
    error = minutes()["error"]
    start, end = round(GROUND) + 15, round(GROUND) + 60  # the first leg, once the turn is over
    change = np.degrees(error[end - 5 : end].mean(axis=0) - error[start : start + 5].mean(axis=0))
    assert abs(change.mean()) < 0.2
    assert np.abs(change).max() < 1.0


def test_no_magnetometer_is_rejected_for_long():
    assert minutes()["refused"].max() < 2.0


def test_a_rejected_magnetometer_sets_the_heading_once_and_is_faulty_then():
    """A declination changed in flight makes the magnetometer appear 25 degrees off."""
    fleet = Fleet(1, seed=3, EKF2_MAG_DECL=3.0)
    e, commander = fleet.estimator[0], fleet.simulation.commanders[0]
    fleet.run(3.0)
    fleet.take_off()
    heading = frames.yaw_from_quaternion(tuple(e["q"]))
    for _ in range(25):
        fleet.hold(heading)
    before = [int(e["resets"][name]) for name in ("heading", "any")]
    took = _until_reset(fleet, heading, 28.0)
    assert took == pytest.approx(REFUSED, abs=0.5)
    assert [int(e["resets"][name]) for name in ("heading", "any")] == [before[0] + 1, before[1] + 1]
    assert e["shifts"]["heading"] == pytest.approx(math.radians(25.0), abs=0.04)
    assert math.degrees(fleet.heading_errors()[0]) == pytest.approx(-25.0, abs=3.0)
    fleet.hold(heading)
    assert (e["mag_used"], e["mag_good"], e["mag_fault"]) == (1, 1, 0)
    assert fleet.refused_for()[0] < 0.3

    commander.parameters.set("EKF2_MAG_DECL", 3.0)
    for _ in range(50):
        fleet.hold(heading)
    assert (e["mag_used"], e["mag_good"], e["mag_fault"]) == (0, 0, 1)
    assert e["resets"]["heading"] == before[0] + 1
    assert np.linalg.norm(fleet.simulation.world.plant["velocity"][0]) < 0.5

    assert commander.request(modes.AUTO_LAND) == 0
    fleet.run(20.0)
    assert commander.view.landed
    assert (e["mag_used"], e["mag_good"], e["mag_fault"]) == (1, 1, 0)
    assert abs(math.degrees(fleet.heading_errors()[0])) < 4.0


def _until_reset(fleet: Fleet, heading: float, declination: float) -> float:
    """Change the declination (deg) and wait for the heading's reset; return the elapsed time, s."""
    fleet.simulation.commanders[0].parameters.set("EKF2_MAG_DECL", declination)
    start, counter = fleet.simulation.time_us, int(fleet.estimator["resets"]["heading"][0])
    while fleet.estimator["resets"]["heading"][0] == counter:
        fleet.hold(heading)
        assert fleet.simulation.time_us - start < 12e6
    return (fleet.simulation.time_us - start) * 1e-6
