"""Benchmark of the planner: updates of the local map and plans of vehicles in a forest, processor time on one core.

``python -m benchmarks.programs.planning --vehicles 1`` prints a table; ``--json FILE`` writes it. Vehicles fly exactly
along their trajectories, and a lidar of 32 x 512 rays sees trunks every 0.1 s; each update of the map is that of the
node, without the message, and each plan is the search of a path and the trajectory along it.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.programs.program_frame import Column, Row, run
from xtdrone_common.settings import check_range
from xtdrone_planning.mapping.range_images import RangeImage
from xtdrone_planning.mapping.voxel_grid import LocalMap, MapSettings
from xtdrone_planning.planner_settings import PlannerSettings, TrajectorySettings
from xtdrone_planning.replanning.flight_states import Situation
from xtdrone_planning.replanning.planner import Planner

Array = NDArray[np.float64]

_CHANNELS, _COLUMNS, _REACH = 32, 512, 30.0  # as iris_3d_lidar; m
_TURN, _SCAN_TURNS = 0.05, 2  # s; turns between two scans
_DENSITY, _SIDE, _RADIUS = 0.1, 60.0, 0.2  # trunks a square metre, m, m
_APART = 6.0  # m between the vehicles' starts
_MOST_TURNS = 4000
_WARM = 10  # durations of each kind that are not counted: kernels are loaded


class _Durations:
    """Processor times of one kind, s."""

    def __init__(self) -> None:
        self.seconds: list[float] = []

    @contextmanager
    def measuring(self) -> Iterator[None]:
        begin = time.thread_time()
        yield
        self.seconds.append(time.thread_time() - begin)

    @property
    def counted(self) -> Array:
        return 1000.0 * np.array(self.seconds[_WARM:])


def _directions() -> Array:
    """Return the directions (channels, columns, 3) of a spinning lidar, +-15 degrees."""
    azimuth = np.linspace(-math.pi, math.pi, _COLUMNS, endpoint=False)
    elevation = np.radians(np.linspace(-15.0, 15.0, _CHANNELS))[:, None]
    parts = np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)
    return np.stack([np.broadcast_to(part, (_CHANNELS, _COLUMNS)) for part in parts], axis=-1)


def _trunks(seed: int) -> Array:
    """Return places (n, 2), m, of trunks, none near a start."""
    rng = np.random.default_rng(seed)
    places = rng.uniform([3.0, -0.5 * _SIDE], [3.0 + _SIDE, 0.5 * _SIDE], (round(_DENSITY * _SIDE**2), 2))
    kept: list[Array] = []
    for place in places:
        if all(math.dist(place, other) > 1.9 for other in kept):
            kept.append(place)
    return np.array(kept)


def _ranges(position: Array, trunks: Array, directions: Array) -> Array:
    """Return the distances (channels, columns) to trunks and the ground, m; infinite without a hit."""
    level = np.hypot(directions[0, :, 0], directions[0, :, 1])
    unit = directions[0, :, :2] / level[:, None]
    to = trunks - position[:2]
    along, across = to @ unit.T, to[:, :1] * unit[:, 1] - to[:, 1:] * unit[:, 0]
    depth = np.where((along > 0.0) & (np.abs(across) < _RADIUS), along, np.inf).min(axis=0)
    ranges = depth / np.hypot(directions[..., 0], directions[..., 1])
    ground = np.where(directions[..., 2] < 0.0, position[2] / np.maximum(-directions[..., 2], 1e-9), np.inf)
    ranges = np.minimum(ranges, ground)
    return np.where(ranges <= _REACH, ranges, np.inf)


class _Vehicle:
    """A vehicle that follows its setpoints exactly."""

    def __init__(self, number: int, plans: _Durations, maps: _Durations) -> None:
        self.position = np.array([0.0, _APART * number, 2.0])
        self.velocity = np.zeros(3)
        self.map = LocalMap(MapSettings(), 0.8)
        self.planner = Planner(self.map.grid, PlannerSettings(lead=0.0), TrajectorySettings(), plans.measuring)
        self._maps, self._scans = maps, 0

    def see(self, now: float, trunks: Array, directions: Array) -> None:
        """Insert a scan into the map."""
        for moment in (now - 0.05, now, now + 0.05):
            self.map.poses.add(round(moment * 1e9), np.array([*self.position, 1.0, 0.0, 0.0, 0.0]))
        ranges = _ranges(self.position, trunks, directions)
        with self._maps.measuring():
            self.map.enter(RangeImage(ranges, directions, np.zeros_like(ranges), _REACH), round(now * 1e9), (0, 0, 0))
        self._scans += 1

    def step(self, now: float) -> None:
        """Advance by one turn; after reaching a goal, set the next one on the opposite side."""
        if self.planner.goal is None or self.planner.state.name == "hovering at the goal":
            away = 0.0 if self.position[0] > 0.5 * _SIDE else _SIDE + 6.0
            self.planner.set_goal(np.array([away, self.position[1], 2.0]))
        situation = Situation(now, self.position, self.velocity, 0.0, True, True, self._scans)
        command = self.planner.step(situation)
        if command is not None:
            self.position, self.velocity = command.position, command.velocity


def measure(vehicles: int, seconds: float) -> dict[str, Any]:
    """Measure the planners of some vehicles in one process.

    Args:
        vehicles: 1 or more.
        seconds: minimum wall time of the measurement, above 0.

    Returns:
        vehicles, plans, and in ms of processor time of one vehicle: plan_milliseconds (median), plan_p95,
        map_milliseconds (median), map_p95.
    """
    plans, maps = _Durations(), _Durations()
    directions, trunks = _directions(), _trunks(0)
    fleet = [_Vehicle(number, plans, maps) for number in range(vehicles)]
    begin = time.perf_counter()
    for turn in range(_MOST_TURNS):
        now = 1.0 + turn * _TURN
        for vehicle in fleet:
            if turn % _SCAN_TURNS == 0:
                vehicle.see(now, trunks, directions)
            vehicle.step(now)
        if len(plans.seconds) > 2 * _WARM and time.perf_counter() - begin >= seconds:
            break
    return {
        "vehicles": vehicles,
        "plans": len(plans.counted),
        "plan_milliseconds": float(np.median(plans.counted)),
        "plan_p95": float(np.percentile(plans.counted, 95)),
        "map_milliseconds": float(np.median(maps.counted)),
        "map_p95": float(np.percentile(maps.counted, 95)),
    }


COLUMNS = (
    Column("vehicles", "{vehicles}"),
    Column("ms/plan", "{plan_milliseconds:.2f}"),
    Column("p95", "{plan_p95:.2f}"),
    Column("ms/map", "{map_milliseconds:.2f}"),
    Column("p95", "{map_p95:.2f}"),
)


def main() -> int:
    """Measure the numbers of the command line and return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--vehicles", type=int, nargs="+", default=[1, 4])
    parser.add_argument("--seconds", type=float, default=3.0, help="minimum time of one measurement, s")
    return run(parser, _cases, COLUMNS)


def _cases(arguments: argparse.Namespace) -> Iterator[Row]:
    check_range("--seconds", arguments.seconds, 0.001, unit="s")
    for vehicles in arguments.vehicles:
        check_range("--vehicles", vehicles, 1, 10)
        yield measure(vehicles, arguments.seconds)


if __name__ == "__main__":
    sys.exit(main())
