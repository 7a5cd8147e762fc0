"""A vehicle that is always at its setpoint, with a lidar that sees trunks: planners fly without a simulator."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from xtdrone_planning.mapping.range_images import RangeImage
from xtdrone_planning.mapping.voxel_grid import LocalMap, MapSettings
from xtdrone_planning.planner_settings import PlannerSettings, TrajectorySettings
from xtdrone_planning.replanning.flight_states import Situation
from xtdrone_planning.replanning.planner import Planner

PERIOD = 0.05  # s, one turn; a scan arrives in every second turn
RANGE = 20.0
LIMITS = TrajectorySettings()


def lidar_directions(columns: int = 360, channels: int = 24) -> np.ndarray:
    """Return the directions (channels, columns, 3) of a spinning lidar, +-15 degrees."""
    azimuth = np.linspace(-math.pi, math.pi, columns, endpoint=False)
    elevation = np.radians(np.linspace(-15.0, 15.0, channels))[:, None]
    shape = (channels, columns)
    parts = np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)
    return np.stack([np.broadcast_to(part, shape) for part in parts], axis=-1)


DIRECTIONS = lidar_directions()


@dataclass
class ToyFlight:
    """A flight.

    Attributes:
        trunks: (n, 3) x, y and radius of infinite vertical cylinders, m.
        position: (3,) m.
        silent: whether the lidar publishes nothing.
        fault: of the sensor, passed to the planner.
    """

    trunks: np.ndarray
    position: np.ndarray = field(default_factory=lambda: np.array([0.0, 0.0, 2.0]))
    settings: PlannerSettings = field(default_factory=lambda: PlannerSettings(lead=0.0))
    limits: TrajectorySettings = LIMITS
    silent: bool = False
    fault: str = ""

    def __post_init__(self) -> None:
        self.map = LocalMap(MapSettings(side=20.0, height=3.2), 0.8)
        self.planner = Planner(self.map.grid, self.settings, self.limits)
        self.velocity = np.zeros(3)
        self.time = 0.0
        self.turn = 0
        self.scans = 0
        self.offboard = True
        self.flying = True
        self.track: list[np.ndarray] = []
        self.commands: list = []
        self.states: list[str] = []

    def scan(self) -> None:
        """Pass the lidar's scan to the planner."""
        level = np.hypot(DIRECTIONS[..., 0], DIRECTIONS[..., 1])
        ranges = np.full(level.shape, np.nan)
        down = DIRECTIONS[..., 2] < -1e-6
        ranges[down] = self.position[2] / -DIRECTIONS[..., 2][down]
        for x, y, radius in self.trunks:
            dx, dy = x - self.position[0], y - self.position[1]
            along = (DIRECTIONS[..., 0] * dx + DIRECTIONS[..., 1] * dy) / level
            square = along**2 - dx * dx - dy * dy + radius * radius
            hit = (square > 0.0) & (along > 0.0)
            near = np.where(hit, along - np.sqrt(np.maximum(square, 0.0)), np.inf) / level
            ranges = np.fmin(ranges, np.where(hit, near, np.nan))
        ranges[~(ranges <= RANGE)] = np.nan
        self.map.poses.add(round(self.time * 1e9), np.array([*self.position, 1.0, 0.0, 0.0, 0.0]))
        image = RangeImage(ranges, DIRECTIONS, np.zeros_like(ranges), RANGE, round=True)
        assert self.map.enter(image, round(self.time * 1e9), (0.0, 0.0, 0.0))
        self.scans += 1

    def step(self) -> None:
        """Advance by a turn."""
        if self.turn % 2 == 0 and not self.silent:
            self.scan()
        now = Situation(
            self.time, self.position, self.velocity, 0.0, self.flying, self.offboard, self.scans, self.fault
        )
        command = self.planner.step(now)
        if command is not None:
            self.position, self.velocity = command.position, command.velocity
            self.commands.append(command)
        self.track.append(self.position)
        if not self.states or self.states[-1] != self.planner.state.name:
            self.states.append(self.planner.state.name)
        self.turn += 1
        self.time = self.turn * PERIOD

    def run(self, seconds: float, until: str = "") -> None:
        """Advance, at most until the planner is in a state."""
        for _ in range(round(seconds / PERIOD)):
            self.step()
            if until and self.planner.state.name == until:
                return

    def clearance(self) -> float:
        """Return the least distance so far between the vehicle's centre and a trunk, m."""
        track = np.array(self.track)
        if not len(self.trunks):
            return math.inf
        away = np.hypot(track[:, None, 0] - self.trunks[:, 0], track[:, None, 1] - self.trunks[:, 1])
        return float((away - self.trunks[:, 2]).min())


def forest(seed: int, count: int = 60, apart: float = 2.4) -> np.ndarray:
    """Return trunks at random positions, x from 4 to 24 m, at least ``apart`` m from each other."""
    rng = np.random.default_rng(seed)
    found: list[tuple[float, float, float]] = []
    for x, y in rng.uniform((4.0, -9.0), (24.0, 9.0), (20 * count, 2)):
        if len(found) < count and all(math.hypot(x - a, y - b) >= apart for a, b, _ in found):
            found.append((x, y, float(rng.uniform(0.12, 0.3))))
    return np.array(found)


def wall(x: float, y0: float, y1: float) -> np.ndarray:
    """Return trunks so close to each other that they form a wall."""
    return np.array([(x, y, 0.3) for y in np.arange(y0, y1 + 0.01, 0.4)])
