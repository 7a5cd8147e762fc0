"""Precision landing on a detected target, modelled on PX4 v1.14's precland: approach, descent, search and fallback.

The target position arrives in LANDING_TARGET messages; the PLD_* parameters set tolerances and timeouts. With
LTEST_MODE 0 the target's velocity is estimated, and the vehicle approaches and descends in the target's frame; PX4
v1.14 uses that estimate only for targets given by angles and flies to the position alone.
"""

from __future__ import annotations

import enum
import math
from dataclasses import dataclass

from xtdrone_autopilot.estimator.landing_target_estimator import MOVING, LandingTargetEstimator, TargetMotion
from xtdrone_autopilot.flight_tasks.auto_setpoint import CRITICAL, INFO, NAN, STILL, Course
from xtdrone_autopilot.vehicle_view import Vector

OPPORTUNISTIC, REQUIRED = 1, 2  # mode of a landing item's param2 and of RTL_PLD_MD
_CONFIRMATION_US = 1_000_000  # time above the target before the descent
_OLDEST_US = 1_000_000  # of an observation with a time of its own


class _State(enum.Enum):
    START = enum.auto()
    APPROACH = enum.auto()
    DESCEND = enum.auto()
    FINAL = enum.auto()
    SEARCH = enum.auto()
    FALLBACK = enum.auto()


@dataclass(frozen=True)
class LandingTarget:
    """Observation of the landing target.

    Attributes:
        position: m, local NED.
        time_us: simulated time of its reception, microseconds.
    """

    position: Vector
    time_us: int


class PrecisionLanding:
    """Precision landing of one vehicle.

    Attributes:
        target: last observation of the target, None before the first.
        active: whether a precision landing is in progress.
    """

    def __init__(self, course: Course) -> None:
        """Prepare an inactive precision landing on ``course``."""
        self._course = course
        self._get = course.parameters.get
        self._estimator = LandingTargetEstimator(self._get)
        self.target: LandingTarget | None = None
        self.active = False
        self._mode = REQUIRED
        self._state = _State.START
        self._landing_position: Vector = (0.0, 0.0, 0.0)
        self._height = 0.0
        self._searches = 0
        self._since_us = 0
        self._over_us: int | None = None

    def see(self, position: Vector, time_us: int = 0) -> None:
        """Store an observation of the target.

        Args:
            position: m, local NED.
            time_us: simulated time of the observation, microseconds; one not within the last second counts as now.
        """
        now = self._course.view.time_us
        self.target = LandingTarget(position, now)
        made = time_us if 0 <= now - time_us <= _OLDEST_US else now
        self._estimator.see(position, position[2] - self._course.view.position[2], made)

    def start(self, position: Vector, mode: int = REQUIRED) -> None:
        """Start a precision landing.

        Args:
            position: position of the search and of a landing without a target, m, local NED.
            mode: without a target, ``OPPORTUNISTIC`` lands immediately and ``REQUIRED`` searches for it.
        """
        self.active = True
        self._mode = mode
        self._landing_position = position
        self._height = self._course.view.position[2]
        self._searches = 0
        self._state = _State.START
        self._course.fly_to((position[0], position[1], self._height))
        if self._seen:
            self._approach()
        elif mode == OPPORTUNISTIC:
            self._fall_back("No landing target visible, landing normally")

    def stop(self) -> None:
        """Stop the precision landing."""
        self.active = False

    def update(self) -> None:
        """Advance the state machine; call at 10 Hz while active."""
        step = {
            _State.START: self._wait_at_start,
            _State.APPROACH: self._update_approach,
            _State.DESCEND: self._update_descent,
            _State.SEARCH: self._update_search,
        }.get(self._state)
        if step is not None:
            step()

    @property
    def _seen(self) -> TargetMotion | None:
        """The target now if its last observation is no older than PLD_BTOUT."""
        now, target = self._course.view.time_us, self.target
        if target is None:
            return None
        motion: TargetMotion | None = TargetMotion(target.position, STILL, target.time_us)
        if self._get("LTEST_MODE") == MOVING:
            motion = self._estimator.at(now)
        fresh = motion is not None and now - motion.time_us <= self._get("PLD_BTOUT") * 1e6
        return motion if fresh else None

    def _follow(self, target: TargetMotion) -> None:
        self._course.shift(*target.position[:2], target.velocity)

    def _enter(self, state: _State) -> None:
        self._state = state
        self._since_us = self._course.view.time_us
        self._over_us = None

    def _wait_at_start(self) -> None:
        if self._seen:
            self._approach()
        elif self._course.distance_to(self._landing_position) < self._get("NAV_ACC_RAD"):
            self._search_or_land()

    def _approach(self) -> None:
        target = self._seen
        assert target is not None
        self._enter(_State.APPROACH)
        self._course.fly_to((target.position[0], target.position[1], self._course.view.position[2]))
        self._follow(target)

    def _update_approach(self) -> None:
        target = self._seen
        if target is None:
            self._lose()
            return
        self._follow(target)
        if not self._over(target):
            self._over_us = None
            return
        now = self._course.view.time_us
        self._over_us = now if self._over_us is None else self._over_us
        if now - self._over_us >= _CONFIRMATION_US:
            self._enter(_State.DESCEND)
            self._course.land(target.position)
            self._follow(target)

    def _over(self, target: TargetMotion) -> bool:
        return self._course.distance_to(target.position) < self._get("PLD_HACC_RAD")

    def _update_descent(self) -> None:
        target = self._seen
        height = self._course.ground - self._course.view.position[2]
        if target is not None and target.position[2] - self._course.view.position[2] < self._get("PLD_FAPPR_ALT"):
            self._enter(_State.FINAL)
        elif target is not None:
            self._follow(target)
        elif height < self._get("PLD_FAPPR_ALT"):
            self._enter(_State.FINAL)
        else:
            self._lose()

    def _lose(self) -> None:
        self._course.announcements.say(CRITICAL, "Lost landing target while landing")
        self._search_or_land()

    def _search_or_land(self) -> None:
        if self._mode == OPPORTUNISTIC or self._searches >= self._get("PLD_MAX_SRCH"):
            self._fall_back("Search failed, landing normally")
            return
        self._searches += 1
        self._enter(_State.SEARCH)
        self._course.announcements.say(INFO, "Precision land: searching for the target")
        height = self._course.ground - self._get("PLD_SRCH_ALT")
        self._course.fly_to(
            (self._landing_position[0], self._landing_position[1], min(height, self._course.view.position[2]))
        )

    def _update_search(self) -> None:
        if self._seen:
            self._approach()
        elif self._course.view.time_us - self._since_us > self._get("PLD_SRCH_TOUT") * 1e6:
            self._fall_back("Search timed out, landing normally")

    def _fall_back(self, text: str) -> None:
        self._enter(_State.FALLBACK)
        self._course.announcements.say(CRITICAL, text)
        self._course.land((*self._course.stopping_place()[:2], self._landing_position[2]))


def from_angles(x: float, y: float, height: float, position: Vector, yaw: float) -> Vector:
    """Return the position of a target observed by a downward camera.

    Args:
        x: angle forward from straight down, rad.
        y: angle to the right from straight down, rad.
        height: height of the vehicle above the target, m.
        position: position of the vehicle, m, local NED.
        yaw: heading of the vehicle, rad.

    Returns:
        Position of the target, m, local NED; NaN for angles at or above the horizon.
    """
    if not (abs(x) < 0.5 * math.pi and abs(y) < 0.5 * math.pi):
        return NAN, NAN, NAN
    ahead, right = height * math.tan(x), height * math.tan(y)
    cos, sin = math.cos(yaw), math.sin(yaw)
    return position[0] + cos * ahead - sin * right, position[1] + sin * ahead + cos * right, position[2] + height
