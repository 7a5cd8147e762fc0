"""A UAV flown by its autopilot lands on the platform of a driving robot, and rides along."""

from __future__ import annotations

import math

import numpy as np
import pytest

from xtdrone_common import modes
from xtdrone_common.fleet import parse_fleet
from xtdrone_common.poses import Pose
from xtdrone_sim.robots.wheel_drives import drive_of
from xtdrone_sim.simulation import Simulation
from xtdrone_worlds.worlds.robots.robot_model import load_robot

UNSET = (math.nan, math.nan, math.nan)
STEP_US = 20_000
SPEED = 0.5  # m/s, of the robot during the landing


class Scene:
    """An iris beside a robot that drives east at a given speed."""

    def __init__(self) -> None:
        self.simulation = Simulation(parse_fleet("iris:1"), seed=3)
        self.commander = self.simulation.commanders[0]
        kind, pose = load_robot("ugv"), Pose((2.0, 3.0, 0.0))
        assert kind.platform is not None
        self.height = kind.platform.height
        self.robot = drive_of(kind, pose)
        self.simulation.world.add_model(0, kind.model("ugv_0", pose), pose, self.robot)
        self.speed = 0.0

    @property
    def offset(self) -> np.ndarray:
        """Return the vehicle's offset from the platform's centre on the ground, m, ENU."""
        state = self.robot.state
        return self.simulation.world.plant["position"][0] - (state.x, state.y, 0.0)

    def run(self, seconds: float, *, rise: float | None = None) -> None:
        """Drive on; with ``rise``, m/s, the vehicle follows the robot by climbing or descending setpoints."""
        for _ in range(round(seconds * 1e6 / STEP_US)):
            self.robot.command(self.speed, 0.0)
            self.simulation.world.bodies.wake(0)
            if rise is not None:
                east, north, _ = (np.array(self.commander.view.estimator["position"])[[1, 0, 2]] - self.offset).tolist()
                self.commander.offboard.set_trajectory(
                    (north, east, math.nan), (0.0, self.speed, -rise), UNSET, math.nan, 0.0
                )
            self.simulation.run_until(self.simulation.time_us + STEP_US)


def test_a_uav_lands_on_a_driving_robot_and_rides_along() -> None:
    scene = Scene()
    simulation, commander = scene.simulation, scene.commander
    scene.run(2.0)
    commander.parameters.set("MIS_TAKEOFF_ALT", 3.0)
    assert commander.request(modes.AUTO_TAKEOFF) == 0
    assert commander.arm_disarm(True) == 0
    scene.run(10.0)
    scene.run(0.2, rise=0.0)
    assert commander.request(modes.OFFBOARD) == 0
    scene.speed = SPEED
    scene.run(10.0, rise=0.0)
    assert math.hypot(*scene.offset[:2]) < 0.25
    for _ in range(200):
        scene.run(0.05, rise=-0.5)
        if scene.offset[2] < scene.height + 0.08:
            break
    assert scene.offset[2] == pytest.approx(scene.height + 0.055, abs=0.03)
    assert commander.request(modes.AUTO_LAND) == 0
    for _ in range(100):
        scene.run(0.1)
        if not commander.armed:
            break
    assert not commander.armed
    assert (0, 1) in simulation.world.collisions
    place = scene.offset
    assert np.abs(place[:2]).max() < 0.6
    scene.speed, before = 2.0, scene.robot.state.x
    scene.run(4.0)
    assert scene.robot.state.x - before > 6.0
    assert simulation.world.plant["velocity"][0][0] == pytest.approx(2.0, abs=0.02)
    assert scene.offset == pytest.approx(place, abs=0.05)
    simulation.close()
