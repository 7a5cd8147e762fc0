"""Paths by the sampling planners of OMPL, as an alternative to A*.

RRT* (S. Karaman, E. Frazzoli, IJRR 30, 2011), Informed RRT* (J. Gammell, S. Srinivasa, T. Barfoot, IROS 2014) and BIT*
(the same, ICRA 2015), of the Open Motion Planning Library (I. Sucan, M. Moll, L. Kavraki, IEEE RAM 19, 2012). Each
search starts from the same seed and ends after a fixed number of iterations, so its result depends on its inputs alone.
"""

from __future__ import annotations

import itertools

import numpy as np
from numpy.typing import NDArray
from ompl import base, geometric, util

from xtdrone_planning.mapping.voxel_grid import VoxelGrid
from xtdrone_planning.paths.grid_search import BLOCKED, REACHED, STEEP, UNDECIDED
from xtdrone_planning.paths.lines_of_sight import is_clear
from xtdrone_planning.paths.local_path import LocalPath, PathQuery, seen_path

Array = NDArray[np.float64]

RRT_STAR, BIT_STAR, INFORMED_RRT_STAR = "rrt_star", "bit_star", "informed_rrt_star"

_PLANNERS = {RRT_STAR: geometric.RRTstar, BIT_STAR: geometric.BITstar, INFORMED_RRT_STAR: geometric.InformedRRTstar}
_FROM_EDGE = 1.5  # voxels between the edge of the map and a path that leaves it
_SAME = 0.05  # m from the goal within which a path counts as reaching it


class _Lines(base.MotionValidator):  # type: ignore[misc]
    """Checks straight lines against the map."""

    def __init__(
        self, information: base.SpaceInformation, grid: VoxelGrid, distance: NDArray[np.float32], clearance: float
    ) -> None:
        super().__init__(information)
        self._map = distance, grid.corner, grid.resolution
        self._clearance = clearance

    def checkMotion(self, first: base.State, last: base.State) -> bool:  # noqa: N802, OMPL's name
        """Return whether the line between two states keeps the clearance."""
        a, b = _place(first), _place(last)
        return bool(is_clear(*self._map, a, b, self._clearance))


def _place(state: base.State) -> Array:
    """Return the place (3,), m in map, of a state, whose height is scaled because metres up or down cost more."""
    return np.array([state[0], state[1], state[2] / STEEP])


def _state(information: base.SpaceInformation, place: Array) -> base.State:
    """Return the state of a place (3,), m in map.

    States of ``SpaceInformation.allocState`` are freed with their Python object; those of the space itself never are.
    """
    state = information.allocState()
    state[0], state[1], state[2] = float(place[0]), float(place[1]), float(place[2] * STEEP)
    return state


class SampledSearch:
    """Searches paths like ``local_path.PathSearch``."""

    def __init__(self, planner: str, iterations: int, seed: int) -> None:
        """Allocate the search.

        Args:
            planner: RRT_STAR, BIT_STAR or INFORMED_RRT_STAR.
            iterations: of the planner in a search: a sample of RRT* and Informed RRT*; an edge in the queue of BIT*,
                which adds 100 samples at a time whenever the queue is empty.
            seed: Seed of each search.
        """
        util.noOutputHandler()
        self._planner, self._iterations, self._seed = _PLANNERS[planner], iterations, seed

    def find(self, grid: VoxelGrid, query: PathQuery, distance: NDArray[np.float32] | None = None) -> LocalPath:
        """Search a path; see ``Search.find``. A goal outside of the map is replaced by the nearest place within."""
        start, goal = query.start, query.goal
        distance = grid.distance if distance is None else distance
        target = goal if grid.is_inside(goal) else _nearest_within(grid, distance, query)
        if target is None:
            return LocalPath(BLOCKED, start[None].copy(), start.copy(), is_whole=False)
        corners = self._corners(grid, distance, target, query)
        if corners is None:
            return LocalPath(UNDECIDED, start[None].copy(), start.copy(), is_whole=False)
        points = _dense(corners, grid.resolution)
        return seen_path(grid, distance, REACHED, points, query)

    def _corners(self, grid: VoxelGrid, distance: NDArray[np.float32], target: Array, query: PathQuery) -> Array | None:
        """Return the corners (n, 3) of the best path to ``target`` that was found, m in map; None without one."""
        start, heights = query.start, query.heights
        util.RNG.setSeed(self._seed)
        space = base.RealVectorStateSpace(3)
        bounds = base.RealVectorBounds(3)
        low, high = grid.origin.copy(), grid.upper.copy()
        low[2] = max(low[2], min(heights[0], start[2], target[2]))
        high[2] = min(high[2], max(heights[1], start[2], target[2]))
        for axis, scale in enumerate((1.0, 1.0, STEEP)):
            bounds.setLow(axis, float(low[axis] * scale))
            bounds.setHigh(axis, float(high[axis] * scale))
        space.setBounds(bounds)
        information = base.SpaceInformation(space)
        information.setStateValidityChecker(lambda state: True)  # a state counts with the lines to it
        lines = _Lines(information, grid, distance, query.clearance)
        information.setMotionValidator(lines)
        information.setup()
        problem = base.ProblemDefinition(information)
        problem.setStartAndGoalStates(_state(information, start), _state(information, target), _SAME)  # it copies them
        problem.setOptimizationObjective(base.PathLengthOptimizationObjective(information))
        planner = self._planner(information)
        planner.setProblemDefinition(problem)
        planner.setup()
        left = iter(range(self._iterations))
        planner.solve(base.PlannerTerminationCondition(lambda: next(left, None) is None))
        if not problem.hasExactSolution():
            return None
        path = problem.getSolutionPath()
        return np.array([_place(path.getState(n)) for n in range(path.getStateCount())])


def _nearest_within(grid: VoxelGrid, distance: NDArray[np.float32], query: PathQuery) -> Array | None:
    """Return the place on the map nearest to a goal outside, (3,) m in map, with the clearance; None without one."""
    goal = query.goal
    edge = _FROM_EDGE * grid.resolution
    inside = np.clip(goal, grid.origin + edge, grid.upper - edge)
    inside[2] = np.clip(inside[2], *query.heights)
    layer = grid.index(inside)[2] if grid.is_inside(inside) else grid.evidence.shape[2] // 2
    free = np.argwhere(distance[:, :, layer] >= query.clearance)
    if not len(free):
        return None
    places = grid.middle(np.column_stack([free, np.full(len(free), layer)]))
    off = ((places - goal) ** 2).sum(axis=1)
    return np.asarray(places[int(np.argmin(off))], float)


def _dense(corners: Array, spacing: float) -> Array:
    """Return points on the lines between corners, at most ``spacing`` m apart."""
    parts = [corners[:1]]
    for a, b in itertools.pairwise(corners):
        count = max(1, int(np.ceil(np.linalg.norm(b - a) / spacing)))
        parts.append(a + (b - a) * (np.arange(1, count + 1) / count)[:, None])
    return np.vstack(parts)
