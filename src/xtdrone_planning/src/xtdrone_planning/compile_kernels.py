"""Compile the kernels of planning into their cache for a prompt first flight:
``python -m xtdrone_planning.compile_kernels``.

Kernels are compiled for the types with which they are called, so each part here does what its node does in flight.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from xtdrone_planning.exploration.choice_of_frontier import Explorer
from xtdrone_planning.exploration.floor_map import FREE, OCCUPIED, UNKNOWN
from xtdrone_planning.exploration.settings import ExplorationSettings
from xtdrone_planning.mapping.range_images import DepthImages, DepthMapping, LidarImages, LidarMapping, RangeImage
from xtdrone_planning.mapping.voxel_grid import LocalMap, MapSettings
from xtdrone_planning.navigation.global_path import GlobalSearch
from xtdrone_planning.navigation.level_map import LevelMap, ScanRays
from xtdrone_planning.navigation.navigator import Navigator, Turn
from xtdrone_planning.navigation.settings import CostmapSettings, NavigatorSettings, WindowSettings
from xtdrone_planning.octree.octree_format import decode, encode
from xtdrone_planning.octree.octree_map import GlobalMap, OctreeSettings
from xtdrone_planning.octree.octree_messages import seen_from_above
from xtdrone_planning.paths.lines_of_sight import is_open
from xtdrone_planning.planner_settings import AgreementSettings, PlannerSettings, TrajectorySettings
from xtdrone_planning.replanning.flight_states import Situation
from xtdrone_planning.replanning.swarm_planner import SwarmPlanner
from xtdrone_planning.safety.near_points import place_points, without_vehicles
from xtdrone_planning.safety.trajectory_clearance import TrajectoryClearance
from xtdrone_planning.safety.velocity_filter import SafetySettings, VelocityFilter
from xtdrone_planning.trajectories.flown_trajectories import FlownTrajectories
from xtdrone_planning.trajectories.splines.uniform_spline import UniformSpline, coasting, resting

Array = NDArray[np.float64]

_HEIGHT = 2.0  # m of the flights
_PERIOD = 0.1  # s, a turn
_ROOM, _TRUNK = 8.0, 3.0  # m: distances of a round room's wall, and of a trunk ahead
_POINT = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("ring", "<u2"), ("time", "<f4")])


def _cloud() -> NDArray[np.void]:
    """Return the points of a lidar in the middle of the room."""
    settings = LidarMapping()
    azimuth = np.linspace(-math.pi, math.pi, settings.columns, endpoint=False)
    rings = np.arange(settings.channels)
    elevation = np.linspace(settings.vertical_min, settings.vertical_max, settings.channels)
    far = np.where(np.abs(azimuth) < 0.1, _TRUNK, _ROOM)
    points = np.empty((settings.channels, settings.columns), _POINT)
    points["x"], points["y"] = far * np.cos(azimuth), far * np.sin(azimuth)
    points["z"] = far * np.tan(elevation)[:, None]
    points["ring"], points["time"] = rings[:, None], np.linspace(0.0, 0.05, settings.columns)
    return points.ravel()


def _images() -> list[RangeImage]:
    """Return what a lidar and a depth camera measure in the room, and points without order."""
    points = _cloud()
    depths = np.full((120, 160), _TRUNK)
    lidar = LidarImages(LidarMapping())
    return [
        lidar.image(points),
        lidar.image(points[["x", "y", "z"]]),
        DepthImages(DepthMapping()).image(depths, (100.0, 100.0, 80.0, 60.0)),
    ]


def _pose(position: Array) -> Array:
    return np.array([*position, 1.0, 0.0, 0.0, 0.0])


def _maps() -> None:
    """Enter measurements into a local map and an octree, and read the octree."""
    local, octree = LocalMap(MapSettings(), 0.8), GlobalMap(OctreeSettings())
    position = np.array([0.0, 0.0, _HEIGHT])
    for each in (local, octree):
        for stamp_ns in range(0, 60_000_000, 1_000_000):
            each.poses.add(stamp_ns, _pose(position))
    for image in _images():
        local.enter(image, 0, LidarMapping().lidar_position)
        octree.enter(image, 0, LidarMapping().lidar_position)
    octree.update()
    blocks, resolution = octree.octree.blocks(), octree.octree.resolution
    for binary in (True, False):
        decode(encode(*blocks, resolution, binary))
    seen_from_above(*blocks, resolution, (0.0, 3.0))


class _Flight:
    """A vehicle of a group that is where its setpoints are."""

    def __init__(self, rank: int, position: Array, goal: Array) -> None:
        """Begin at ``position``, with a ``goal``, (3,) m."""
        self.rank, self.position, self.velocity = rank, position, np.zeros(3)
        self.map = LocalMap(MapSettings(side=18.0, height=3.2), 0.8)
        settings, agreement = PlannerSettings(lead=0.0), AgreementSettings(check=0.2)
        self.planner = SwarmPlanner(self.map.grid, settings, TrajectorySettings(), agreement, rank)
        self.map.others = self.planner.places_of_others
        self.planner.set_goal(goal)
        self._images = _images()

    def step(self, turn: int) -> None:
        """Map, plan and fly."""
        now = turn * _PERIOD
        stamp_ns = round(now * 1e9)
        for late_ns in range(0, 100_000_000, 10_000_000):
            self.map.poses.add(stamp_ns + late_ns, _pose(self.position))
        self.map.enter(self._images[0], stamp_ns, LidarMapping().lidar_position)
        command = self.planner.step(Situation(now, self.position, self.velocity, 0.0, True, True, turn))
        if command is not None:
            self.position, self.velocity = command.position, command.velocity

    def tell(self, other: SwarmPlanner) -> None:
        """Send what is planned to another vehicle."""
        planner, radius = self.planner, self.planner.limits.radius
        if planner.trajectory is not None:
            other.on_decided(self.rank, planner.number, planner.trajectory, radius)
        if planner.proposal is not None:
            other.on_proposal(planner.proposal, radius)


def _planners() -> None:
    """Fly two vehicles past each other and round the trunk; then one of them finds another in its way, and brakes."""
    ends = np.array([-1.0, 0.0, _HEIGHT]), np.array([5.0, 0.5, _HEIGHT])
    flights = _Flight(0, *ends), _Flight(1, *ends[::-1])
    for turn in range(1, 16):
        for flight, other in (flights, flights[::-1]):
            flight.step(turn)
            flight.tell(other.planner)
    grid, planner = flights[0].map.grid, flights[0].planner
    waiting = resting(flights[0].position + np.array([1.6, 0.0, 0.0]), 0.0)
    planner.on_decided(1, 100, UniformSpline(16 * _PERIOD, waiting.interval, waiting.points), 0.4)
    flights[0].step(16)
    planner.cancel()
    flights[0].step(17)
    is_open(grid.distance, grid.evidence, grid.corner, grid.resolution, *ends, 0.6, 0.4)


def _safety_filter() -> None:
    """Filter a velocity towards another vehicle and an obstacle, on trajectories and without."""
    settings = SafetySettings()
    places = np.array([[0.0, 0.0, _HEIGHT], [4.0, 0.3, _HEIGHT]])
    velocities = np.array([[2.0, 0.0, 0.0], [-2.0, 0.0, 0.0]])
    points = np.stack([_cloud()[axis] for axis in "xyz"], axis=1).astype(np.float64)
    at_rest = 1.0, 0.0, 0.0, 0.0
    points = place_points(points, np.zeros(3), at_rest, places[0], at_rest, settings.range)
    points = without_vehicles(points, places[1:], 0.3)
    trajectories = FlownTrajectories(2, settings.distance, settings.tracking)
    for number, start in ((1, 0.0), (2, 0.3)):
        for index in range(2):
            spline = coasting(places[index] + start * velocities[index], velocities[index], start)
            trajectories.on_trajectory(index, number, spline, 0.4)
        trajectories.update(places + (start + 0.1) * velocities, start + 0.2)
        trajectories.commands(0, places[0].tolist())
        trajectories.agreed(0, 1)
    flown = trajectories.flown(0)
    if flown is not None:
        TrajectoryClearance().least(flown.spline, points, 0.5)
    velocity_filter = VelocityFilter(settings, 1.0 / 30.0)
    velocity_filter.check(velocities[0], places[0], places[1:], velocities[1:], points, np.zeros(1, np.bool_))


def _exploration() -> None:
    """Choose frontiers of a floor that one of two vehicles has seen in part, and divide it."""
    settings = ExplorationSettings(bounds=(0.0, 0.0, 12.0, 9.0))
    names = "first", "second"
    explorers = [Explorer(settings, name, names) for name in names]
    floor = explorers[0].floor
    values = np.full(floor.own.shape, UNKNOWN, np.int8)
    values[20:70, 20:60] = FREE
    values[50, 20:50] = OCCUPIED
    for explorer in explorers:
        explorer.floor.enter(floor.first * floor.cell, values)
        explorer.start(np.array([1.0, 1.0]))
    for turn in range(1, 8):
        for explorer, other, name in zip(explorers, explorers[::-1], names, strict=True):
            decision = explorer.step(0.5 * turn, np.array([1.0, 1.0]), "following")
            other.floor.hear(name, floor.first * floor.cell, 0.0, explorer.floor.own)
            for message in decision.messages:
                other.sharing.hear(message, 0.5 * turn)


def _navigation() -> None:
    """Navigate on a level map with a wall."""
    level = LevelMap(CostmapSettings())
    values = np.zeros((100, 100), np.int8)
    values[50, 20:80] = 100
    level.take(values, np.zeros(2), level.cell)
    scan = ScanRays(np.full(90, 2.0), -1.5, 0.03, 0.0005, (0.1, 10.0), 0.0)
    pose = np.array([2.5, 5.0, 0.0])
    poses = np.tile(_pose(np.array([*pose[:2], 0.0])), (7, 1))
    level.enter(*scan.place(poses, 0.01, np.zeros(3), 0.2))
    level.update_distance_around(pose)
    navigator = Navigator(level, NavigatorSettings(), WindowSettings())
    for goal in ((8.0, 5.0, 0.0), (3.0, 5.0, 1.0)):
        navigator.set_goal(np.array(goal))
        for turn in range(1, 4):
            now = Turn(turn * _PERIOD, _PERIOD, pose)
            navigator.step(now)
            navigator.local_plan(now)
    within_the_wall = np.array([5.0, 5.0])
    GlobalSearch().find_near(level, pose[:2], within_the_wall, navigator.clearance, 3.0)


_PARTS: tuple[tuple[str, Callable[[], None]], ...] = (
    ("maps", _maps),
    ("planners", _planners),
    ("safety filter", _safety_filter),
    ("exploration", _exploration),
    ("navigation", _navigation),
)


def main() -> None:
    """Run all parts; print each, because the installation script shows them as progress."""
    for name, part in _PARTS:
        print(f"planning: {name}", flush=True)
        part()


if __name__ == "__main__":
    main()
