"""State machine of navigation to a goal, as in ROS's move_base.

::

    Waiting -> Planning -> Following -> turning to the goal's yaw -> Waiting (reached)
                 ^  |          | no path, or no progress
                 |  v          v
               Recovering: first clear the local map, then rotate in place; after both: Waiting (aborted)

A new goal leads to Planning without a stop. At the goal a turn without progress aborts at once, as no recovery would
help. In every state other than Following and turning the vehicle brakes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from xtdrone_common.rotation import wrap_pi
from xtdrone_planning.navigation.dynamic_window import AT_REST, Motion, arc, brake, choose, move_along_arc
from xtdrone_planning.navigation.global_path import GlobalSearch, PathError
from xtdrone_planning.navigation.level_map import LevelMap
from xtdrone_planning.navigation.settings import NavigationGoalError, NavigatorSettings, WindowSettings

Array = NDArray[np.float64]

WAITING, PLANNING, FOLLOWING, TURNING = "waiting", "planning", "following", "recovering: turning"
SUCCEEDED, ABORTED = "reached", "aborted"

_PLAN_SPACING = 0.5  # s between two searches while there is no path
_PROGRESS = 0.3  # m or rad that count as progress
_TURNED = 0.05  # rad closer to the goal's yaw that count as progress
_RECOVERED = 1.0  # m travelled after which recoveries start over with the first
_APPROACH = 0.5  # fraction of the acceleration used to stop at the goal
_GAIN = 1.5  # 1/s, of the yaw at the goal
_LARGEST = 1e5  # m
_ARC_POINTS = 10


@dataclass(frozen=True)
class Turn:
    """Inputs of one cycle.

    Attributes:
        time: s of ROS time.
        duration: Duration of a cycle, s.
        pose: (3,) x, y, m in map, and yaw, rad.
        fault: why the map is unreliable; empty if it is reliable.
    """

    time: float
    duration: float
    pose: Array
    fault: str = ""


class Navigator:
    """Navigates one vehicle.

    Attributes:
        state: one of the names above.
        goal: (3,) x, y, m in map, yaw, rad; None without one.
        outcome: SUCCEEDED or ABORTED of the last goal; empty before the first goal and while one is active.
        reason: why there is no path or no progress.
        path: (n, 2) global path, m in map; empty without.
        command: what was commanded last.
    """

    def __init__(self, level: LevelMap, settings: NavigatorSettings, limits: WindowSettings) -> None:
        """Start waiting.

        Args:
            level: the map, updated by the caller.
            settings, limits: of decisions and of motion.
        """
        self.level, self.settings, self.limits = level, settings, limits
        self.restart()

    def restart(self) -> None:
        """Forget the goal, because simulated time was reset."""
        self.state, self.outcome, self.reason = WAITING, "", ""
        self.goal: Array | None = None
        self.path: Array = np.empty((0, 2))
        self.command = AT_REST
        self._search = GlobalSearch()
        self._since = self._planned = -math.inf
        self._arrived = False
        self._off = math.inf  # rad, least distance from the yaw of the goal so far
        self._recoveries = 0
        self._turned = 0.0
        self._place: Array = np.zeros(3)
        self._recovered_at: Array | None = None

    @property
    def clearance(self) -> float:
        """Minimum distance between global paths and occupied cells, m."""
        return self.limits.radius + self.limits.margin + 0.5 * self.level.cell

    @property
    def is_moving(self) -> bool:
        """Whether the last command moves the vehicle."""
        return self.command != AT_REST

    def set_goal(self, goal: Array) -> None:
        """Accept a goal, (3,) x, y, m in map, yaw, rad, for the next cycle.

        Raises:
            NavigationGoalError: not finite, or too far; the active goal is unchanged.
        """
        goal = np.asarray(goal, float)
        if not np.isfinite(goal).all() or np.abs(goal[:2]).max() > _LARGEST:
            text = ", ".join(f"{value:g}" for value in goal.tolist())
            raise NavigationGoalError(f"goal: ({text}) is not allowed, finite numbers within +-{_LARGEST:g} m")
        self.goal, self.outcome, self.reason = goal.copy(), "", ""
        self._arrived = False
        self._recoveries, self._recovered_at = 0, None
        self._enter(PLANNING, math.nan)

    def cancel(self) -> None:
        """Drop the goal: the vehicle brakes."""
        self.goal, self.path = None, np.empty((0, 2))
        self.state = WAITING

    def pause(self) -> None:
        """Stop while the pose of the vehicle is unknown; the goal is kept, and its timeout restarts."""
        self.command = AT_REST
        self._since = math.nan

    def local_plan(self, now: Turn) -> Array:
        """Return the poses (n, 3) of the commanded motion, x, y, m in map, yaw, rad."""
        return arc(self._expected(now), self.command, self.limits.horizon, _ARC_POINTS)

    def step(self, now: Turn) -> Motion:
        """Advance by a turn, and return the command."""
        if math.isnan(self._since):
            self._since, self._place = now.time, now.pose
        self.command = self._commanded(now)
        return self.command

    # states

    def _commanded(self, now: Turn) -> Motion:
        if self.goal is None or now.fault:
            self._since = now.time  # the goal's timeout is suspended during the fault
            return self._braked(now)
        if self.state == PLANNING:
            return self._plan_first(now)
        if self.state == TURNING:
            return self._turn(now)
        return self._follow(now)

    def _plan_first(self, now: Turn) -> Motion:
        if now.time - self._planned >= _PLAN_SPACING and self._plan(now):
            self._enter(FOLLOWING, now.time)
            self._place = now.pose
            return self._follow(now)
        if now.time - self._since > self.settings.patience:
            self._recover(now)
        return self._braked(now)

    def _follow(self, now: Turn) -> Motion:
        assert self.goal is not None
        away = math.hypot(*(self.goal[:2] - now.pose[:2]).tolist())
        if self._arrived or away < self.settings.tolerance:
            if not self._arrived:
                self._arrived, self._since, self._off = True, now.time, math.inf
            return self._finish(now)
        if now.time - self._planned >= self.settings.replan_period and not self._plan(now):
            self._enter(PLANNING, now.time)
            return self._braked(now)
        self._note_progress(now)
        if now.time - self._since > self.settings.patience:
            self.reason = "no progress along the path"
            self._recover(now)
            return self._braked(now)
        most = math.sqrt(2.0 * _APPROACH * self.limits.acceleration * away)
        found = choose(self.level, self.limits, self._expected(now), self.command, self.path, most, now.duration)
        return self._braked(now) if found is None else found

    def _finish(self, now: Turn) -> Motion:
        """Stop, turn to the goal's yaw, and report success; abort if the vehicle does not turn."""
        assert self.goal is not None
        off = wrap_pi(float(self.goal[2]) - float(now.pose[2]))
        slowed = self._braked(now)
        if abs(off) <= self.settings.yaw_tolerance:
            if slowed == AT_REST:
                self._end(SUCCEEDED)
            return slowed
        if abs(off) < self._off - _TURNED:
            self._off, self._since = abs(off), now.time
        if now.time - self._since > self.settings.patience:
            self.reason = f"the vehicle does not turn to the goal's yaw, {abs(off):.2f} rad are left"
            self._end(ABORTED)
            return slowed
        return Motion(slowed.speed, self._towards(_GAIN * off, now))

    def _recover(self, now: Turn) -> None:
        """Start the next recovery, or give up after the last."""
        self._recoveries += 1
        self._recovered_at = now.pose
        if self._recoveries == 1:
            self.level.forget_around(now.pose)
            self._enter(PLANNING, now.time)
        elif self._recoveries == 2:
            self._turned = 0.0
            self._enter(TURNING, now.time)
        else:
            self._end(ABORTED)

    def _turn(self, now: Turn) -> Motion:
        """Rotate once in place to see all around, and plan again."""
        rate = self._towards(self.limits.turn_rate, now)
        self._turned += rate * now.duration
        if self._turned >= 2.0 * math.pi:
            self._enter(PLANNING, now.time)
            return self._braked(now)
        return Motion(self._braked(now).speed, rate)

    # parts

    def _enter(self, state: str, time: float) -> None:
        self.state, self._since, self._planned = state, time, -math.inf

    def _end(self, outcome: str) -> None:
        self.outcome = outcome
        self.cancel()

    def _plan(self, now: Turn) -> bool:
        """Search for a global path; return whether there is one."""
        assert self.goal is not None
        self._planned = now.time
        self.level.update_distance()
        try:
            self.path = self._search.find(self.level, now.pose[:2], self.goal[:2], self.clearance)
        except PathError as error:
            self.reason, self.path = str(error), np.empty((0, 2))
            return False
        self.reason = ""
        return True

    def _note_progress(self, now: Turn) -> None:
        """Restart the timeout when the vehicle has moved or turned, and the recoveries when it has travelled far
        enough."""
        moved_by = math.hypot(*(now.pose[:2] - self._place[:2]).tolist())
        turned_by = abs(wrap_pi(float(now.pose[2] - self._place[2])))
        if moved_by > _PROGRESS or (turned_by > _PROGRESS and self._recoveries == 0):
            self._place, self._since = now.pose, now.time
        since = self._recovered_at
        if since is not None and math.hypot(*(now.pose[:2] - since[:2]).tolist()) > _RECOVERED:
            self._recoveries, self._recovered_at = 0, None

    def _expected(self, now: Turn) -> Array:
        """Return the pose at which the next command takes effect."""
        x, y, yaw = now.pose.tolist()
        return np.array(move_along_arc(x, y, yaw, self.command.speed, self.command.rate, self.limits.lag))

    def _braked(self, now: Turn) -> Motion:
        return brake(self.limits, self.command, now.duration)

    def _towards(self, rate: float, now: Turn) -> float:
        """Return the yaw rate within the limits that is closest to a desired one, rad/s."""
        most, change = self.limits.turn_rate, self.limits.turn_acceleration * now.duration
        return min(max(min(max(rate, -most), most), self.command.rate - change), self.command.rate + change)
