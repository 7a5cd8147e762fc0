"""Floors of rooms without ROS: a true map, vehicles that fly along their routes, and a planar lidar."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, field

import numpy as np

from xtdrone_planning.exploration.choice_of_frontier import AT_GOAL, HOME, Explorer
from xtdrone_planning.exploration.floor_map import FREE, OCCUPIED, UNKNOWN, FloorMap
from xtdrone_planning.exploration.frontiers import Ways
from xtdrone_planning.exploration.settings import ExplorationSettings

PERIOD = 0.5  # s
SPEED = 1.5  # m/s
REACH = 9.0  # m of the lidar
_BEARINGS = np.linspace(0.0, 2.0 * math.pi, 400, endpoint=False)
_STEPS = np.arange(0.0, REACH, 0.12)


def rooms(seed: int, length: float = 30.0, width: float = 20.0, door: float = 1.5) -> list[tuple[float, ...]]:
    """Return the walls x0, y0, x1, y1, m, of a floor with two corridors, rooms beside them, and some pillars."""
    rng = np.random.default_rng(seed)
    thick, lobby = 0.2, 2.6
    walls = [(0, 0, length, thick), (0, width - thick, length, width), (length - thick, 0, length, width)]
    walls += [(0, 0, thick, width / 2 - 1.2), (0, width / 2 + 1.2, thick, width)]
    for base in (0.0, width / 2):
        deep = (width / 2 - 2.4) / 2
        if base:
            walls.append((lobby, base - thick / 2, length, base + thick / 2))
        for low, inner in ((base, base + deep), (base + width / 2 - deep, base + width / 2 - deep)):
            edges = np.cumsum([lobby, *(rng.uniform(0.75, 1.25, 5) * (length - lobby) / 5)])
            edges = lobby + (edges - lobby) * (length - lobby) / (edges[-1] - lobby)
            for a, b in itertools.pairwise(edges):
                at = rng.uniform(a + 0.3, b - 0.3 - door)
                walls += [(a, inner, at, inner + thick), (at + door, inner, b, inner + thick)]
                walls.append((a, low, a + thick, low + deep))
                if rng.uniform() < 0.5:
                    x, y = rng.uniform(a + 1.5, b - 1.5), rng.uniform(low + 1.3, low + deep - 1.3)
                    walls.append((x, y, x + 0.4, y + 0.4))
    return walls


@dataclass
class ToyFloor:
    """Vehicles that explore a floor.

    Attributes:
        walls: see ``rooms``.
        starts: x, y of each vehicle.
        loss: share of lost messages.
        dies: time, s, at which the last vehicle stops and sends no more messages.
    """

    walls: list[tuple[float, ...]]
    starts: list[tuple[float, float]]
    bounds: tuple[float, float, float, float] = (0.0, 0.0, 30.0, 20.0)
    loss: float = 0.0
    dies: float = math.inf
    time: float = 0.0
    explored: float = math.nan
    curve: list[tuple[float, float]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.settings = ExplorationSettings(bounds=self.bounds, margin=4.0, cell=0.25)
        self.names = [f"uav_{n}" for n in range(len(self.starts))]
        self.explorers = [Explorer(self.settings, name, self.names) for name in self.names]
        self.positions = [np.array(start) for start in self.starts]
        self.tracks = [[start] for start in self.starts]
        self.planners = ["waiting" for _ in self.starts]
        self.messages = 0
        self._rng = np.random.default_rng(5)
        floor = FloorMap(self.settings)
        self.truth = np.full(floor.own.shape, FREE, np.int8)
        x, y = (floor.middles(np.arange(n), axis) for axis, n in enumerate(floor.own.shape))
        for x0, y0, x1, y1 in self.walls:
            self.truth[np.ix_((x >= x0) & (x <= x1), (y >= y0) & (y <= y1))] = OCCUPIED
        self.visible = self._visible(floor)

    def _visible(self, floor: FloorMap) -> np.ndarray:
        """Return the cells to explore that are visible from positions that a vehicle can reach."""
        floor.own = self.truth
        floor.merge()
        costs = Ways(floor, floor.index(self.starts[0]), self.settings.clearance).costs
        floor.own = np.full(self.truth.shape, UNKNOWN, np.int8)
        for i, j in np.argwhere(np.isfinite(costs))[::9]:
            self.scan(floor, floor.middle((i, j)))
        return (floor.own != UNKNOWN) & floor.inside

    def scan(self, floor: FloorMap, position: np.ndarray) -> None:
        """Pass the lidar's scan at a position to the map."""
        x = position[0] + np.outer(np.cos(_BEARINGS), _STEPS)
        y = position[1] + np.outer(np.sin(_BEARINGS), _STEPS)
        i = np.clip(np.floor(x / floor.cell).astype(int) - floor.first[0], 0, self.truth.shape[0] - 1)
        j = np.clip(np.floor(y / floor.cell).astype(int) - floor.first[1], 0, self.truth.shape[1] - 1)
        solid = self.truth[i, j] == OCCUPIED
        seen = np.cumsum(solid, axis=1) - solid == 0
        values = np.full(self.truth.shape, UNKNOWN, np.int8)
        values[i[seen & ~solid], j[seen & ~solid]] = FREE
        values[i[seen & solid], j[seen & solid]] = OCCUPIED
        floor.enter(floor.first * floor.cell, values)

    def coverage(self) -> float:
        """Return the share of the visible cells that the vehicles have seen."""
        known = np.any([explorer.floor.own != UNKNOWN for explorer in self.explorers], axis=0)
        return float(known[self.visible].mean())

    def fly(self, limit: float = 600.0) -> None:
        """Explore until all vehicles are home or time is up."""
        for explorer, start in zip(self.explorers, self.starts, strict=True):
            explorer.start(np.array(start))
        alive = list(range(len(self.names)))
        while self.time < limit and any(self.explorers[n].state != HOME for n in alive):
            if self.time >= self.dies and len(alive) == len(self.names):
                alive = alive[:-1]
            for n in alive:
                self._turn(n, alive)
            self.time += PERIOD
            self.curve.append((self.time, self.coverage()))
            if math.isnan(self.explored) and all(self.explorers[n].state in ("returning", HOME) for n in alive):
                self.explored = self.time

    def _turn(self, n: int, alive: list[int]) -> None:
        explorer, position = self.explorers[n], self.positions[n]
        self.scan(explorer.floor, position)
        decision = explorer.step(self.time, position, self.planners[n])
        for other in alive:
            if other == n:
                continue
            if self._rng.uniform() >= self.loss:
                floor = explorer.floor
                self.explorers[other].floor.hear(self.names[n], floor.first * floor.cell, 0.0, floor.own.copy())
            for message in decision.messages:
                self.messages += 1
                if self._rng.uniform() >= self.loss:
                    self.explorers[other].sharing.hear(message, self.time)
        self._move(n, decision.route)

    def _move(self, n: int, route: np.ndarray) -> None:
        left = SPEED * PERIOD
        for place in route[1:]:
            step = place - self.positions[n]
            length = float(np.hypot(*step))
            if length > left:
                self.positions[n] = self.positions[n] + step * (left / length)
                left = 0.0
                break
            self.positions[n], left = place, left - length
        self.planners[n] = AT_GOAL if left > 0.0 else "following"
        self.tracks[n].append(tuple(self.positions[n]))
