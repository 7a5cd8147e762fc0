"""AUTO.PRECLAND on a standing or driving robot, with observations like a camera's: late, noisy, lost near the tag."""

from __future__ import annotations

import math
from collections import deque

import numpy as np
import pytest

from xtdrone_common import modes
from xtdrone_common.fleet import parse_fleet
from xtdrone_common.poses import Pose
from xtdrone_sim.robots.wheel_drives import drive_of
from xtdrone_sim.simulation import Simulation
from xtdrone_worlds.worlds.robots.robot_model import load_robot

STEP_US = 20_000
OBSERVED_US = 100_000  # period of the camera
LATENCY_US = 140_000  # from exposure to the autopilot
BLIND = 0.25  # m above the platform; nearer, no tag fits into the picture
REACH = 6.0  # m, within which a tag is seen


class Landing:
    """An iris above a robot on which it lands."""

    def __init__(self, seed: int, speed: float, turn: float = 0.0) -> None:
        self.simulation = Simulation(parse_fleet("iris:1"), seed=seed)
        self.commander = self.simulation.commanders[0]
        kind, pose = load_robot("ugv"), Pose((2.0, 3.0, 0.0))
        assert kind.platform is not None
        self.height = kind.platform.height
        self.robot = drive_of(kind, pose)
        self.simulation.world.add_model(0, kind.model("ugv_0", pose), pose, self.robot)
        self.command = (speed, turn)
        self.rng = np.random.default_rng(seed)
        self.sent: deque[tuple[int, tuple[float, float, float]]] = deque()

    @property
    def offset(self) -> np.ndarray:
        """Return the vehicle's offset from the platform's centre, m, ENU."""
        state = self.robot.state
        return self.simulation.world.plant["position"][0] - (state.x, state.y, self.height)

    def run(self, seconds: float, *, drive: bool = True) -> None:
        for _ in range(round(seconds * 1e6 / STEP_US)):
            self.robot.command(*(self.command if drive else (0.0, 0.0)))
            self.simulation.world.bodies.wake(0)
            self.observe()
            self.simulation.run_until(self.simulation.time_us + STEP_US)

    def observe(self) -> None:
        """Report the platform's position relative to the autopilot's own estimate of that time."""
        now = self.simulation.time_us
        east, north, up = self.offset.tolist()
        if now % OBSERVED_US == 0 and BLIND < up < REACH and math.hypot(east, north) < 0.7 * up:
            x, y, z = (float(v) for v in self.commander.view.position)
            noise = self.rng.normal(0.0, 0.01 + 0.005 * up, 2)
            self.sent.append((now, (x - north + noise[0], y - east + noise[1], z + up)))
        while self.sent and self.sent[0][0] <= now - LATENCY_US:
            made, place = self.sent.popleft()
            self.commander.navigator.set_landing_target(place, made)

    def fly(self) -> None:
        """Take off above the driving robot, and land on it."""
        self.run(2.0, drive=False)
        self.commander.parameters.set("MIS_TAKEOFF_ALT", 4.0)
        assert self.commander.request(modes.AUTO_TAKEOFF) == 0
        assert self.commander.arm_disarm(True) == 0
        self.run(8.0, drive=False)
        x, y, z = self.commander.view.position
        east, north, _ = self.offset.tolist()
        self.commander.navigator.reposition((x - north, y - east, z), math.nan)
        self.run(5.0, drive=False)
        assert self.commander.request(modes.AUTO_PRECLAND) == 0
        for _ in range(400):
            self.run(0.1)
            if not self.commander.armed:
                break


@pytest.mark.parametrize(("speed", "turn", "seed"), [(0.0, 0.0, 1), (1.0, 0.0, 2), (1.0, 0.05, 3)])
def test_a_vehicle_lands_in_the_middle_of_a_platform(speed: float, turn: float, seed: int) -> None:
    landing = Landing(seed, speed, turn)
    landing.fly()
    assert not landing.commander.armed
    assert (0, 1) in landing.simulation.world.collisions
    assert math.hypot(*landing.offset[:2]) < 0.15
    landing.simulation.close()
