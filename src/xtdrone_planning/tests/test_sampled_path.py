"""Paths by OMPL's planners: clear, seeded, hardly longer than those of A*, and flown."""

from __future__ import annotations

import ctypes
import gc

import numpy as np
import pytest
from toy_flight import ToyFlight, forest, wall

from xtdrone_planning.mapping.voxel_grid import MapSettings, VoxelGrid
from xtdrone_planning.paths.grid_search import BLOCKED, REACHED, UNDECIDED
from xtdrone_planning.paths.local_path import LocalPath, PathQuery, PathSearch, Search
from xtdrone_planning.paths.sampled_path import SampledSearch
from xtdrone_planning.planner_settings import PlannerSettings

PLANNERS = ["rrt_star", "bit_star", "informed_rrt_star"]
CLEARANCE, START, GOAL = 0.5, np.array([-7.0, -7.0, 0.3]), np.array([7.0, 7.0, 0.1])


def a_grid(seed: int) -> VoxelGrid:
    """Return an observed map of 16 x 16 m with columns."""
    grid = VoxelGrid(MapSettings(resolution=0.2, side=16.0, height=2.0))
    grid.evidence[:] = -100
    for x, y in np.random.default_rng(seed).integers(10, 70, (25, 2)).tolist():
        grid.evidence[x : x + 2, y : y + 2] = 100
    grid.update_distance()
    return grid


def find(search: Search, grid: VoxelGrid, goal: np.ndarray = GOAL) -> LocalPath:
    return search.find(grid, PathQuery(START, goal, CLEARANCE, 0.3, (-0.8, 0.8), 100.0))


def length(path: LocalPath) -> float:
    return float(np.linalg.norm(np.diff(path.points, axis=0), axis=1).sum())


@pytest.mark.parametrize("planner", PLANNERS)
@pytest.mark.parametrize("seed", range(3))
def test_paths_are_clear_the_same_each_time_and_hardly_longer_than_those_of_a_star(planner: str, seed: int) -> None:
    grid = a_grid(seed)
    path, again = (find(SampledSearch(planner, 400, 1), grid) for _ in range(2))
    assert path.outcome == REACHED
    assert path.is_whole
    assert np.array_equal(path.points, again.points)
    assert np.allclose(path.points[[0, -1]], [START, GOAL])
    assert length(path) < 1.25 * length(find(PathSearch(100_000), grid))
    for a, b in zip(path.points, path.points[1:], strict=False):
        for part in np.linspace(0.0, 1.0, 60):
            assert grid.distance[grid.index(a + part * (b - a))] > CLEARANCE - grid.resolution


def test_another_seed_gives_another_path() -> None:
    paths = [find(SampledSearch("rrt_star", 200, seed), a_grid(0)).points for seed in (1, 2)]
    assert paths[0].shape != paths[1].shape or not np.allclose(*paths)


@pytest.mark.parametrize("planner", PLANNERS)
def test_without_a_way_or_free_space_nothing_is_found(planner: str) -> None:
    grid = a_grid(0)
    grid.evidence[40] = 100
    grid.update_distance()
    path = find(SampledSearch(planner, 150, 1), grid)
    assert path.outcome == UNDECIDED
    assert np.array_equal(path.points, START[None])
    grid.evidence[:] = 100
    grid.update_distance()
    assert find(SampledSearch(planner, 150, 1), grid, np.array([50.0, 0.0, 0.0])).outcome == BLOCKED


_FIELDS = (
    "arena", "ordblks", "smblks", "hblks", "hblkhd", "usmblks", "fsmblks", "uordblks", "fordblks", "keepcost",
)  # fmt: skip


class MallocInfo(ctypes.Structure):
    """glibc's mallinfo2."""

    _fields_ = [(name, ctypes.c_size_t) for name in _FIELDS]


def used_memory() -> int:
    """Return the bytes allocated by malloc; skip the test without glibc 2.33 or later."""
    library = ctypes.CDLL(None)
    if not hasattr(library, "mallinfo2"):
        pytest.skip("needs glibc's mallinfo2")
    library.mallinfo2.restype = MallocInfo
    gc.collect()
    return int(library.mallinfo2().uordblks)


@pytest.mark.parametrize("planner", PLANNERS)
def test_searches_leave_no_memory_behind(planner: str) -> None:
    grid, search = a_grid(0), SampledSearch(planner, 10, 1)
    for _ in range(50):
        find(search, grid)
    before = used_memory()
    for _ in range(300):
        find(search, grid)
    assert (used_memory() - before) / 300 < 32.0  # bytes: less than a state


def test_a_vehicle_flies_by_them_towards_a_goal_beyond_its_map() -> None:
    settings = PlannerSettings(lead=0.0, global_planner="bit_star", iterations=120)
    flight = ToyFlight(forest(0), settings=settings)
    flight.planner.set_goal(np.array([28.0, 0.0, 2.0]))
    flight.run(40.0, "hovering at the goal")
    assert flight.planner.state.name == "hovering at the goal"
    assert flight.clearance() > flight.limits.radius


def test_a_goal_behind_a_wall_is_not_reached_through_it() -> None:
    flight = ToyFlight(
        wall(6.0, -6.0, 5.0), settings=PlannerSettings(lead=0.0, global_planner="informed_rrt_star", iterations=120)
    )
    flight.planner.set_goal(np.array([9.0, 0.0, 2.0]))
    flight.run(40.0, "hovering at the goal")
    assert flight.planner.state.name == "hovering at the goal"
    assert flight.clearance() > flight.limits.radius
