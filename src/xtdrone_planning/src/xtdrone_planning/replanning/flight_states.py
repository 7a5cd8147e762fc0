"""State machine of a flight to a goal.

::

    Waiting -> Planning -> Following -> HoveringAtGoal
                 |  ^        |   |
                 v  |        v   +----> Braking (obstacle or sensor) -> Planning
           Unreachable     Planning (end of what has been seen)

A new goal leads to Planning, from Following without a stop. When the pilot takes over, or the vehicle is on the ground,
the planner returns to Waiting.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from xtdrone_planning.planner_settings import PlannerSettings
from xtdrone_planning.trajectories.local_trajectory import State
from xtdrone_planning.trajectories.splines.uniform_spline import UniformSpline

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Situation:
    """Inputs of one cycle.

    Attributes:
        time: s of ROS time of the setpoints: the current time plus the lead.
        position, velocity: (3,) m and m/s in map, the autopilot's estimate.
        yaw: rad, counter-clockwise from east.
        is_flying: armed and off the ground.
        is_offboard: whether the autopilot follows setpoints.
        map_count: number of measurements in the map.
        fault: the sensor's fault; empty: none.
    """

    time: float
    position: Array
    velocity: Array
    yaw: float
    is_flying: bool
    is_offboard: bool
    map_count: int
    fault: str = ""


class PlannerCommand(NamedTuple):
    """A setpoint: position, velocity, acceleration, (3,) each in map, and yaw, rad."""

    position: Array
    velocity: Array
    acceleration: Array
    yaw: float


OK, WARNING, ERROR = 0, 1, 2
"""Levels of diagnostic_msgs/DiagnosticStatus."""


class _Planner(Protocol):
    """Interface of the planner to its states; see ``planner.Planner``."""

    goal: np.ndarray | None
    goal_number: int
    trajectory: UniformSpline | None
    searched: str
    settings: PlannerSettings

    @property
    def is_undecided(self) -> bool: ...
    @property
    def is_complete(self) -> bool: ...
    def hold(self, position: np.ndarray, time: float) -> None: ...
    def plan(self, now: Situation, start: State) -> bool: ...
    def can_brake(self, time: float) -> bool: ...
    def brake(self, time: float) -> None: ...
    def stop_from(self, state: State, time: float) -> None: ...
    def conflict(self, now: Situation) -> float: ...
    def is_at_goal(self, position: np.ndarray) -> bool: ...
    def is_astray(self, now: Situation) -> bool: ...
    def estimate(self, now: Situation) -> State: ...
    def begin(self, now: Situation) -> FlightState: ...


class FlightState:
    """A state.

    Attributes:
        name: Name for reports.
        looks: whether the vehicle yaws towards the path ahead.
        uses_map: whether each measurement is used.
    """

    name = ""
    looks = False
    uses_map = True

    def step(self, planner: _Planner, now: Situation) -> FlightState:
        """Return the state for the next cycle."""
        raise NotImplementedError

    def report(self, planner: _Planner, now: Situation) -> tuple[int, str]:
        """Return level and text for the diagnostics."""
        return (ERROR, now.fault) if now.fault else (OK, self.name)


class Waiting(FlightState):
    """No goal; no setpoints."""

    name = "waiting"
    uses_map = False

    def step(self, planner: _Planner, now: Situation) -> FlightState:
        """Start planning to a goal in flight; on the ground the goal is dropped."""
        if planner.goal is None:
            return self
        if not now.is_flying:
            planner.goal = None
            planner.searched = "a goal was dropped: the vehicle is not flying"
            return self
        return planner.begin(now)

    def report(self, planner: _Planner, now: Situation) -> tuple[int, str]:
        """Return level and text; a dropped goal is a warning."""
        if planner.searched:
            return WARNING, f"{self.name}; {planner.searched}"
        return (WARNING, now.fault) if now.fault else (OK, self.name)


class Planning(FlightState):
    """Hovers, yaws towards the path, and searches for a trajectory in every new map."""

    name = "planning"
    looks = True

    def __init__(self, since: float, goal_number: int) -> None:
        """Begin.

        Args:
            since: s of ROS time.
            goal_number: number of the goal.
        """
        self._since = since
        self._goal_number = goal_number
        self._map_count = -1

    def step(self, planner: _Planner, now: Situation) -> FlightState:
        """Switch to following once there is a trajectory."""
        if planner.goal is None:
            return Hovering()
        if not now.is_offboard:
            planner.hold(now.position, now.time)  # publish setpoints, so that OFFBOARD can be entered
            self._since = now.time
            return self
        if self._goal_number != planner.goal_number:
            self._since, self._goal_number = now.time, planner.goal_number
        if now.fault or now.map_count == self._map_count:
            if now.fault:
                self._since = now.time
            return self
        self._map_count = now.map_count
        if planner.plan(now, _rest(planner)):
            return Following(now, planner.goal_number)
        if now.time - self._since > planner.settings.patience:
            return Unreachable(now.time, planner.goal_number)
        return self

    def report(self, planner: _Planner, now: Situation) -> tuple[int, str]:
        """Return level and text."""
        if now.fault:
            return ERROR, f"hovering; {now.fault}"
        return (WARNING, f"{self.name}; {planner.searched}") if planner.searched else (OK, self.name)


class Following(FlightState):
    """Follows a trajectory, and replans it in the newest map."""

    name = "following"

    def __init__(self, now: Situation, goal_number: int) -> None:
        """Start with the planner's trajectory."""
        self._planned = now.time
        self._map_count = now.map_count
        self._goal_number = goal_number

    def step(self, planner: _Planner, now: Situation) -> FlightState:
        """Brake, replan or arrive."""
        trajectory = planner.trajectory
        assert trajectory is not None
        if planner.goal is None:
            planner.brake(now.time)
            return Braking("the goal was dropped")
        if planner.is_astray(now) and not now.fault:
            return self._from_estimate(planner, now)
        if now.fault:
            planner.brake(now.time)
            return Braking(now.fault)
        if now.time >= trajectory.end and not planner.is_undecided:
            if planner.is_at_goal(trajectory.points[-1]):
                return HoveringAtGoal(planner.goal_number)
            return Planning(now.time, planner.goal_number)
        if now.map_count != self._map_count:
            self._map_count = now.map_count
            return self._with_new_map(planner, now, State(*trajectory.at(now.time)))
        return self

    def _from_estimate(self, planner: _Planner, now: Situation) -> FlightState:
        """Replan from the vehicle's actual state instead of the commanded one; without a path, begin to stop there."""
        state = planner.estimate(now)
        if planner.plan(now, state):
            self._planned, self._goal_number = now.time, planner.goal_number
        else:
            planner.stop_from(state, now.time)
        return self

    def _with_new_map(self, planner: _Planner, now: Situation, state: State) -> FlightState:
        blocked = math.isfinite(planner.conflict(now))
        is_new = self._goal_number != planner.goal_number
        due = now.time - self._planned >= planner.settings.period and not planner.is_complete
        if (blocked or is_new or due) and planner.plan(now, state):
            self._planned, self._goal_number = now.time, planner.goal_number
        elif blocked:
            planner.brake(now.time)
            return Braking("an obstacle on the trajectory, and no alternative found")
        elif is_new and planner.can_brake(now.time):
            planner.brake(now.time)
            return Braking("no trajectory to the new goal")
        return self

    def report(self, planner: _Planner, now: Situation) -> tuple[int, str]:
        """Return level and text."""
        return OK, self.name


class Braking(FlightState):
    """Brakes along the checked path."""

    name = "braking"

    def __init__(self, reason: str) -> None:
        """Start; the planner's trajectory is the braking one."""
        self.reason = reason

    def step(self, planner: _Planner, now: Situation) -> FlightState:
        """Plan from where the vehicle stopped."""
        assert planner.trajectory is not None
        if now.time < planner.trajectory.end:
            return self
        return Hovering() if planner.goal is None else Planning(now.time, planner.goal_number)

    def report(self, planner: _Planner, now: Situation) -> tuple[int, str]:
        """Return level and text."""
        return (ERROR, f"{self.name}; {now.fault}") if now.fault else (WARNING, f"{self.name}; {self.reason}")


class Hovering(FlightState):
    """Hovers without a goal."""

    name = "hovering"
    uses_map = False

    def step(self, planner: _Planner, now: Situation) -> FlightState:
        """Begin with a goal."""
        return self if planner.goal is None else Planning(now.time, planner.goal_number)


class HoveringAtGoal(FlightState):
    """Hovers at the goal."""

    name = "hovering at the goal"
    uses_map = False

    def __init__(self, goal_number: int) -> None:
        """Begin at a goal of this number."""
        self._goal_number = goal_number

    def step(self, planner: _Planner, now: Situation) -> FlightState:
        """Start planning to another goal, or follow a moved one."""
        if planner.goal is None:
            return Hovering()
        assert planner.trajectory is not None
        stays = planner.goal_number == self._goal_number and planner.is_at_goal(planner.trajectory.points[-1])
        return self if stays else Planning(now.time, planner.goal_number)

    def report(self, planner: _Planner, now: Situation) -> tuple[int, str]:
        """Return level and text; the vehicle hovers, so a failed sensor is only a warning."""
        return (WARNING, f"{self.name}; {now.fault}") if now.fault else (OK, self.name)


class Unreachable(FlightState):
    """Hovers because no trajectory to the goal was found, and retries periodically."""

    name = "goal unreachable"

    def __init__(self, since: float, goal_number: int) -> None:
        """Begin; see ``Planning``."""
        self._tried = since
        self._goal_number = goal_number

    def step(self, planner: _Planner, now: Situation) -> FlightState:
        """Retry; a new goal is planned at once."""
        if planner.goal is None:
            return Hovering()
        if planner.goal_number != self._goal_number:
            return Planning(now.time, planner.goal_number)
        if now.time - self._tried >= planner.settings.retry and not now.fault:
            self._tried = now.time
            if planner.plan(now, _rest(planner)):
                return Following(now, planner.goal_number)
        return self

    def report(self, planner: _Planner, now: Situation) -> tuple[int, str]:
        """Return level and text."""
        return ERROR, f"{self.name}; {now.fault or planner.searched}"


def _rest(planner: _Planner) -> State:
    """Return the state of a vehicle hovering at the end of its trajectory."""
    assert planner.trajectory is not None
    return State(planner.trajectory.points[-1], np.zeros(3), np.zeros(3))
