"""Planner of one vehicle: computes setpoints from a goal and a map. Its states are in ``flight_states``."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext

import numpy as np
from numpy.typing import NDArray

from xtdrone_common.rotation import wrap_pi
from xtdrone_planning.mapping.voxel_grid import VoxelGrid
from xtdrone_planning.paths.grid_search import BLOCKED, REACHED
from xtdrone_planning.paths.local_path import LocalPath, PathQuery, PathSearch, Search, nearest_clear
from xtdrone_planning.planner_settings import PlannerSettings, TrajectorySettings
from xtdrone_planning.replanning.flight_states import FlightState, PlannerCommand, Planning, Situation, Waiting
from xtdrone_planning.trajectories.local_trajectory import State, conflict_time, plan_along
from xtdrone_planning.trajectories.speed_profile import brake_along, length_of
from xtdrone_planning.trajectories.splines.uniform_spline import UniformSpline, coasting, resting

Array = NDArray[np.float64]

_LOOK_AHEAD = 0.6  # s: the vehicle faces its position at this time ahead
_SLOW = 0.3  # m in that time: when slower, the yaw is kept
_EXACT = 1e-3  # m
_AT_MOVED_GOAL = 0.05  # m; a voxel would be too coarse for a formation
LEAST_WAY = 0.6
"""Minimum length of a seen path worth flying, unless it ends at the goal, m."""


class Planner:
    """Plans for one vehicle.

    Attributes:
        settings: Settings of its decisions.
        limits: Limits of its trajectories.
        state: the current state of flight.
        goal: (3,) m in map, None without one.
        trajectory: the trajectory being flown; at rest where the vehicle hovers; None before the first goal.
        number: counts the trajectories.
        path: the last path.
        searched: why the last search gave no trajectory, for the report; empty if it gave one.
    """

    def __init__(
        self,
        grid: VoxelGrid,
        settings: PlannerSettings,
        limits: TrajectorySettings,
        timed: Callable[[], AbstractContextManager[None]] = nullcontext,
    ) -> None:
        """Start waiting.

        Args:
            grid: the map, updated by the caller.
            settings, limits: see the attributes.
            timed: returns a context manager around each plan.
        """
        self._timed = timed
        self.grid = grid
        self.settings = settings
        self.limits = limits
        self.restart()

    def restart(self) -> None:
        """Forget goal and trajectory."""
        self.state: FlightState = Waiting()
        self.goal: Array | None = None
        self.goal_number = 0
        self._goal_moves = False
        self.trajectory: UniformSpline | None = None
        self.number = 0
        self.path: LocalPath | None = None
        self.searched = ""
        self._search = _search_of(self.settings)
        self._yaw: float | None = None
        self._yaw_time = 0.0
        self._was_offboard = False
        self._commanded: deque[tuple[float, Array]] = deque()

    def set_goal(self, goal: Array) -> None:
        """Accept a goal, (3,) m in map, for the next cycle.

        Raises:
            GoalError: see ``PlannerSettings.check_goal``; the current goal is kept.
        """
        self.settings.check_goal(goal)
        self.goal = np.array(goal, float)
        self.goal_number += 1
        self._goal_moves = False

    def move_goal(self, goal: Array) -> None:
        """Move the current goal to (3,) m in map; without a goal (e.g. after the pilot took over), do nothing.

        The vehicle does not stop. If the goal is too close to an obstacle, the nearest clear position replaces it.

        Raises:
            GoalError: see ``PlannerSettings.check_goal``; the current goal is kept.
        """
        if self.goal is None:
            return
        self.settings.check_goal(goal)
        self.goal = nearest_clear(self.grid, goal, self.limits.clearance(self.grid.resolution))
        self._goal_moves = True

    def cancel(self) -> None:
        """Drop the goal; in flight the vehicle brakes along its path and hovers."""
        self.goal = None

    def step(self, now: Situation) -> PlannerCommand | None:
        """Run one cycle; return the setpoint, or None while the planner is inactive."""
        if self._was_offboard and not now.is_offboard:
            self._release()
        self._was_offboard = now.is_offboard
        if not now.is_flying:
            self._release()
        self.state = self.state.step(self, now)
        if self.trajectory is None:
            self._yaw = None
            self._commanded.clear()
            return None
        position, velocity, _ = self.trajectory.at(now.time)
        self._commanded.append((now.time, position))
        acceleration = acceleration_setpoint(self.trajectory, now.time, self.settings)
        return PlannerCommand(position, velocity, acceleration, self._slewed_yaw(now))

    def _release(self) -> None:
        """Release the vehicle: the pilot or the autopilot has taken over, or it is on the ground."""
        if not isinstance(self.state, Waiting):
            self.goal, self.trajectory = None, None
            self.state = Waiting()

    # for the states

    @property
    def is_undecided(self) -> bool:
        """Whether a planned trajectory waits for the consent of other vehicles."""
        return False

    def hold(self, position: Array, time: float) -> None:
        """Hover at a position, (3,) m in map, from now on."""
        self._fly(resting(position, time))

    def plan(self, now: Situation, start: State) -> bool:
        """Plan from a state at the current time; return whether the new trajectory is flown.

        ``searched`` gives the reason if it is not.
        """
        with self._timed():
            return self._plan(now, start)

    def _plan(self, now: Situation, start: State) -> bool:
        assert self.goal is not None
        if not self.grid.is_inside(start.position):
            self.searched = "the vehicle is outside its map"
            return False
        clearance = self.limits.clearance(self.grid.resolution)
        if self.grid.is_inside(self.goal):
            away = float(self.grid.distance[self.grid.index(self.goal)])
            if away < clearance:
                self.searched = f"the goal is {away:.1f} m from an obstacle"
                return False
        self.path = self._find_path(start.position)
        if self.path.outcome == BLOCKED:
            self.searched = "there is no path to the goal on the map"
            return False
        if length_of(self.path.points) < LEAST_WAY and not self.path.is_whole:
            self.searched = "the path ahead has not been seen"
            return False
        found = self._trajectory_along(self.path.points, start, now.time)
        if found is None:
            self.searched = "no trajectory within the limits"
            return False
        self.searched = "" if self.path.outcome == REACHED else "the search was cut short"
        self._fly(found)
        return True

    def _find_path(self, start: Array, distance: NDArray[np.float32] | None = None) -> LocalPath:
        """Search a path to the goal; ``distance`` in place of the map's, see ``Search.find``."""
        assert self.goal is not None
        clearance, radius = self.limits.clearance(self.grid.resolution), self.limits.radius
        query = PathQuery(start, self.goal, clearance, radius, self.settings.heights, self.settings.horizon)
        return self._search.find(self.grid, query, distance)

    def _trajectory_along(self, corners: Array, start: State, time: float) -> UniformSpline | None:
        return plan_along(self.grid, corners, start, time, self.limits, heights=self.settings.heights)

    def can_brake(self, time: float) -> bool:
        """Return whether braking is as safe as flying on to the trajectory's end."""
        return True

    def brake(self, time: float) -> None:
        """Brake along the current path."""
        self._fly(self._braking(time))

    def _braking(self, time: float) -> UniformSpline:
        assert self.trajectory is not None
        return brake_along(self.trajectory, time, 0.8 * self.limits.acceleration)

    def stop_from(self, state: State, time: float) -> None:
        """Stop from a state that is not on the trajectory, in its direction."""
        ahead = coasting(state.position, state.velocity, time)
        self._fly(brake_along(ahead, time, 0.8 * self.limits.acceleration))

    def conflict(self, now: Situation) -> float:
        """Return when the trajectory hits an obstacle of the current map, s of ROS time; infinite if never."""
        if self.trajectory is None:
            return math.inf
        return conflict_time(self.grid, self.trajectory, now.time, self.limits, unknown=False)

    @property
    def is_complete(self) -> bool:
        """Whether the trajectory ends at the goal itself, not a voxel beside it; a moving goal is met roughly."""
        if self.goal is None or self.trajectory is None:
            return False
        away = float(np.linalg.norm(self.trajectory.points[-1] - self.goal))
        return away < (_AT_MOVED_GOAL if self._goal_moves else _EXACT)

    def is_at_goal(self, position: Array) -> bool:
        """Return whether a position is at the goal."""
        near = _AT_MOVED_GOAL if self._goal_moves else self.grid.resolution
        return self.goal is not None and float(np.sqrt(((position - self.goal) ** 2).sum())) < near

    def is_astray(self, now: Situation) -> bool:
        """Return whether the vehicle deviates too far from its trajectory."""
        present = now.time - self.settings.lead
        while len(self._commanded) > 1 and self._commanded[1][0] <= present:
            self._commanded.popleft()
        if not self._commanded or self._commanded[0][0] > present:
            return False
        away = self._commanded[0][1] - now.position
        return float(np.sqrt((away * away).sum())) > self.settings.astray

    def estimate(self, now: Situation) -> State:
        """Predict the vehicle's state at the time of the next setpoint from its estimate."""
        self._commanded.clear()
        return State(now.position + self.settings.lead * now.velocity, now.velocity, np.zeros(3))

    def begin(self, now: Situation) -> FlightState:
        """Hover here, and plan for the goal."""
        self.hold(now.position, now.time)
        return Planning(now.time, self.goal_number)

    def _fly(self, trajectory: UniformSpline) -> None:
        self.trajectory = trajectory
        self.number += 1

    def _slewed_yaw(self, now: Situation) -> float:
        """Return the yaw towards the path ahead, limited by the yaw rate."""
        passed = now.time - self._yaw_time
        if self._yaw is None or passed < 0.0:
            self._yaw, passed = now.yaw, 0.0
        self._yaw_time = now.time
        wanted = self._wanted_yaw(now)
        if wanted is not None:
            most = self.settings.yaw_rate * passed
            self._yaw = wrap_pi(self._yaw + min(most, max(-most, wrap_pi(wanted - self._yaw))))
        return self._yaw

    def _wanted_yaw(self, now: Situation) -> float | None:
        assert self.trajectory is not None
        here = self.trajectory.at(now.time)[0]
        there = self.trajectory.at(now.time + _LOOK_AHEAD)[0]
        if self.state.looks and self.path is not None and self.goal is not None:
            there = self.path.ahead
        x, y = float(there[0] - here[0]), float(there[1] - here[1])
        return math.atan2(y, x) if math.hypot(x, y) > _SLOW else None


def _search_of(settings: PlannerSettings) -> Search:
    """Return the path search selected by the settings."""
    if settings.global_planner == "astar":
        return PathSearch(settings.voxels)
    from xtdrone_planning.paths.sampled_path import SampledSearch  # OMPL is loaded only where it is used

    return SampledSearch(settings.global_planner, settings.iterations, settings.sampling_seed)


def acceleration_setpoint(trajectory: UniformSpline, time: float, settings: PlannerSettings) -> Array:
    """Return the acceleration setpoint, (3,) m/s^2 in map, with which an autopilot stays on a trajectory.

    PX4's velocity controller (PositionControl.cpp) adds the acceleration setpoint to a proportional, an integral and a
    derivative term. The derivative term, on the measured acceleration, works against the trajectory's acceleration. The
    integral term takes over what holds against the air drag, and carries the vehicle beyond its stops, where there is
    no drag: an iris from 4 m/s by 0.4 m. Setpoints that contain both leave neither to the controller.

    Rotor drag is linear in the speed: M. Faessler, A. Franchi, D. Scaramuzza, Differential flatness of quadrotor
    dynamics subject to rotor drag for accurate tracking of high-speed trajectories, IEEE RA-L 3, 2018.

    Args:
        trajectory: the trajectory.
        time: Time of the position and velocity setpoints that go with it, s of ROS time.
        settings: lag of the attitude, drag and damping.
    """
    _, velocity, acceleration = trajectory.at(time + settings.attitude_lag)
    level = (1.0 + settings.damping) * acceleration[:2] + settings.drag * velocity[:2]
    return np.array([*level, acceleration[2]])
