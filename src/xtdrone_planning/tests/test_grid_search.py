"""Paths on the local grid."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra

from xtdrone_planning.mapping.voxel_grid import MapSettings, VoxelGrid
from xtdrone_planning.paths.grid_search import BLOCKED, REACHED, UNDECIDED
from xtdrone_planning.paths.local_path import STOPPING_ROOM, PathQuery, PathSearch

HEIGHTS = (-10.0, 10.0)


def a_grid(seed: int = 0, share: float = 0.0) -> VoxelGrid:
    grid = VoxelGrid(MapSettings(resolution=0.5, side=10.0, height=2.0))
    grid.evidence[:] = -100
    rng = np.random.default_rng(seed)
    grid.evidence[rng.uniform(size=grid.evidence.shape) < share] = 100
    grid.update_distance()
    return grid


def find(grid, start, goal, most=100_000, **others):
    options = {"clearance": 0.1, "radius": 0.0, "heights": HEIGHTS, "farthest": 100.0, **others}
    return PathSearch(most).find(grid, PathQuery(np.array(start, float), np.array(goal, float), **options))


def test_in_the_open_it_is_the_straight_line():
    path = find(a_grid(), (-4.0, -4.0, 0.0), (4.0, 3.0, 0.5))
    assert path.outcome == REACHED
    assert path.is_whole
    assert np.allclose(path.points, [(-4.0, -4.0, 0.0), (4.0, 3.0, 0.5)])


@pytest.mark.parametrize("seed", range(8))
def test_it_reaches_what_dijkstra_reaches(seed):
    grid = a_grid(seed, 0.45)
    free = grid.distance >= 0.1
    cells = np.argwhere(free)
    start, goal = cells[seed], cells[-1 - seed]
    graph = _neighbours(free)
    number = {tuple(cell): n for n, cell in enumerate(cells)}
    reachable = np.isfinite(dijkstra(graph, indices=number[tuple(start)], unweighted=True)[number[tuple(goal)]])
    path = find(grid, grid.middle(start), grid.middle(goal))
    assert (path.outcome == REACHED) == reachable
    assert (path.outcome == BLOCKED) != reachable


def _neighbours(free):
    cells = np.argwhere(free)
    number = {tuple(cell): n for n, cell in enumerate(cells)}
    rows, columns = [], []
    for cell, n in number.items():
        for step in np.ndindex(3, 3, 3):
            other = number.get(tuple(np.add(cell, step) - 1))
            if other is not None and other != n:
                rows.append(n)
                columns.append(other)
    return csr_matrix((np.ones(len(rows)), (rows, columns)), shape=(len(cells), len(cells)))


def test_a_goal_outside_leads_to_the_edge():
    path = find(a_grid(), (0.0, 0.0, 0.0), (50.0, 10.0, 0.0))
    assert path.outcome == REACHED
    assert not path.is_whole
    assert path.points[-1][0] > 4.5
    assert 0.0 < path.points[-1][1] < 2.0


def test_a_search_that_is_cut_short_leads_towards_the_goal():
    grid = a_grid(3, 0.2)
    path = find(grid, grid.middle(np.argwhere(grid.distance > 0.4)[0]), (4.5, 4.5, 0.0), most=12)
    assert path.outcome == UNDECIDED


def test_the_path_ends_where_nothing_was_seen():
    grid = a_grid()
    grid.evidence[14:] = 0
    path = find(grid, (-4.0, 0.0, 0.0), (4.0, 0.0, 0.0), radius=0.3)
    assert path.outcome == REACHED
    assert not path.is_whole
    assert 1.0 < path.points[-1][0] < 2.0


def test_from_too_near_an_obstacle_it_only_leads_away():
    grid = a_grid()
    grid.evidence[10, 10, 2] = 100
    grid.update_distance()
    path = find(grid, grid.middle(np.array([10, 11, 2])), (4.0, 4.0, 0.0), clearance=0.8)
    assert path.outcome == REACHED
    blocked = find(grid, grid.middle(np.array([5, 5, 2])), grid.middle(np.array([10, 11, 2])), clearance=0.8)
    assert blocked.outcome == BLOCKED


def test_a_path_that_is_cut_short_ends_where_there_is_room_to_stop():
    grid = a_grid()
    grid.evidence[14, 10] = 100  # a post at x = 2.25 m, beside the path along y = 0
    grid.update_distance()
    options = {"clearance": 0.3, "farthest": 6.0}  # the seen part would end beside the post
    cut = find(grid, (-4.0, -0.25, 0.0), (4.5, -0.25, 0.0), **options)
    assert not cut.is_whole
    assert grid.distance[grid.index(cut.points[-1])] >= 0.3 + STOPPING_ROOM
    assert 4.0 < cut.points[-1, 0] + 4.0 <= 6.0  # as far as there is room
    assert find(grid, (-4.0, -0.25, 0.0), (2.25, -0.25, 0.0), clearance=0.3).is_whole  # a goal may be closer
