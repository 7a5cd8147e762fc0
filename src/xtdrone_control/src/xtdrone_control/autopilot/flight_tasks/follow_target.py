"""The AUTO.FOLLOW_TARGET mode: a target that reports where it is (MAVLink FOLLOW_TARGET) is followed.

The estimate of the target's motion is PX4 v1.14's TargetEstimator, a filter with fixed gains (alpha, beta, gamma) over
reported positions and velocities. ``follow_task`` makes the setpoint of it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from xtdrone_control.autopilot.flight_tasks.auto_setpoint import Course
from xtdrone_control.autopilot.flight_tasks.follow_task import OVER_GROUND, OVER_TARGET
from xtdrone_control.autopilot.state import TASK_FOLLOW
from xtdrone_control.autopilot.vehicle_view import Vector
from xtdrone_control.geodesy import geo

_NEVER_US = -(1 << 60)
_LOST_US = 3_000_000  # of silence, after which the target is taken to stand still
_POSITION_INTERVAL_US, _VELOCITY_INTERVAL_US = 500_000, 100_000  # least time between two that count
_LONGEST_INTERVAL, _SHORTEST_INTERVAL = 20.0, 1e-3  # s, to which the time between two is cut
_LARGEST_ACCELERATION = 20.0  # m/s^2
_SAME = 2.0 * 1.1920929e-07  # m or m/s, up to which a report says the same as the one before
_LEAST_RESPONSIVENESS = 0.1
_FASTEST = 1000.0  # m/s
_LOWEST, _HIGHEST = -1e3, 1e5  # m AMSL; nothing that is followed is further down or up

Array = NDArray[np.float64]


class TargetEstimate:
    """Motion of a target, local NED.

    Attributes:
        position: (3,) m; NaN before the first report.
        velocity: (3,) m/s.
        acceleration: (3,) m/s^2.
    """

    def __init__(self) -> None:
        """Know nothing."""
        self.position: Array = np.full(3, np.nan)
        self.velocity: Array = np.zeros(3)
        self.acceleration: Array = np.zeros(3)
        self._now_us = _NEVER_US
        self._heard_us = _NEVER_US
        self._fused_us = {"position": _NEVER_US, "velocity": _NEVER_US}
        self._fused: dict[str, Array] = {"position": np.full(3, np.nan), "velocity": np.full(3, np.nan)}

    def advance(self, now_us: int) -> None:
        """Move on to simulated time ``now_us``, microseconds; a target that is lost stops where it is then."""
        lost_us = self._heard_us + _LOST_US
        dt = max(min(now_us, lost_us) - self._now_us, 0) * 1e-6
        self.position += (self.velocity + 0.5 * self.acceleration * dt) * dt
        self.velocity += self.acceleration * dt
        if now_us >= lost_us:
            self.velocity[:] = self.acceleration[:] = 0.0
        self._now_us = now_us

    def measure(self, now_us: int, position: Vector, velocity: Vector, responsiveness: float) -> None:
        """Take a report; of two at the same time the first one counts.

        Args:
            now_us: simulated time, microseconds.
            position: m, local NED, finite.
            velocity: m/s, local NED; not known when a part is not finite.
            responsiveness: FLW_TGT_RS, cut to 0.1..1: the lower, the more a report counts.
        """
        if now_us <= self._heard_us:
            return
        measured, moving = np.array(position, np.float64), np.array(velocity, np.float64)
        if self._heard_us == _NEVER_US:
            self.position = measured.copy()
            self.velocity = moving.copy() if np.isfinite(moving).all() else np.zeros(3)
            self._now_us = now_us
        else:
            self.advance(now_us)
        self._heard_us = now_us
        beta = min(max(responsiveness, _LEAST_RESPONSIVENESS), 1.0) ** (1.0 / 3.0)
        dt = self._interval("position", measured, _POSITION_INTERVAL_US)
        if dt > 0.0:
            error = measured - self.position
            self.position += (1.0 - beta**3) * error
            self.velocity += 1.5 * (1.0 - beta) ** 2 * (1.0 + beta) / dt * error
            self.acceleration += (1.0 - beta) ** 3 / dt**2 * error
        beta *= 0.9  # a velocity counts a little more
        dt = self._interval("velocity", moving, _VELOCITY_INTERVAL_US)
        if dt > 0.0:
            error = moving - self.velocity
            self.velocity += (1.0 - beta**2) * error
            self.acceleration += (1.0 - beta) ** 2 / dt * error
        size = float(np.linalg.norm(self.acceleration))
        if size > _LARGEST_ACCELERATION:
            self.acceleration *= _LARGEST_ACCELERATION / size

    def _interval(self, what: str, measured: Array, least_us: int) -> float:
        """Return the time, s, since the measurement before, or 0 for one that does not count.

        It must be finite and come ``least_us`` after the one before, or twice that when it says the same: ground
        stations repeat a position until there is a new one.
        """
        since_us = self._heard_us - self._fused_us[what]
        same = float(np.linalg.norm(measured - self._fused[what])) <= _SAME
        if not np.isfinite(measured).all() or since_us <= (2 * least_us if same else least_us):
            return 0.0
        self._fused_us[what], self._fused[what] = self._heard_us, measured
        return min(max(since_us * 1e-6, _SHORTEST_INTERVAL), _LONGEST_INTERVAL)


@dataclass(frozen=True)
class _Report:
    """What a target reported.

    Attributes:
        time_us: simulated time at which it came.
        place: latitude and longitude in degrees, m AMSL.
        velocity: m/s NED; not known when a part is not finite.
    """

    time_us: int
    place: Vector
    velocity: Vector


class FollowTarget:
    """What one vehicle follows."""

    def __init__(self, course: Course) -> None:
        """Prepare; nothing is asked of the cascade until ``start``."""
        self._course = course
        self._estimate = TargetEstimate()
        self._last: _Report | None = None

    def report(self, place: Vector, velocity: Vector) -> None:
        """Take a target's report of where it is, in every mode.

        Args:
            place: latitude and longitude in degrees, m AMSL (-1 km to 100 km).
            velocity: m/s NED, up to 1000 each; NaN where not known.

        Raises:
            ValueError: a place that is none, or a velocity out of range.
        """
        latitude, longitude, altitude = place
        if not geo.is_place(*place) or not _LOWEST <= altitude <= _HIGHEST:
            text = (
                f"latitude {latitude:.7f}, longitude {longitude:.7f}, altitude {altitude:g} m are no place of a target"
            )
            raise ValueError(text)
        if any(abs(part) > _FASTEST for part in velocity):
            raise ValueError(f"velocity {velocity} m/s of a target is not allowed: at most {_FASTEST:g} in each part")
        self._last = _Report(self._course.view.time_us, place, velocity)
        if self._following:
            self._measure(self._last)
            self._write()

    @property
    def _following(self) -> bool:
        return bool(self._course.view.setpoint["task"] == TASK_FOLLOW)

    def start(self) -> None:
        """Follow the target, beginning with its last report; without a home stay here, as PX4 does not follow then."""
        if self._following:
            return
        home = self._course.home
        if home is None:
            self._course.hold()
            return
        self._course.landing = self._course.taking_off = False
        self._course.view.setpoint["home_z"] = home.position[2]
        self._estimate = TargetEstimate()
        if self._last is not None:
            self._measure(self._last)
        self._update_estimate()
        self._course.view.start_task(TASK_FOLLOW)

    def update(self) -> None:
        """Move the target's estimate on; call at 10 Hz."""
        if self._following:
            self._update_estimate()
        elif self._course.home is not None:
            self.start()

    def camera_pitch(self) -> float:
        """Return the pitch, rad from the horizon and positive up, at which the target is seen; NaN while there is none.

        As PX4's: how far it is down depends on FLW_TGT_ALT_M, as the vehicle's height does.
        """
        view = self._course.view
        if not self._following:
            return math.nan
        x, y, z = view.position
        north, east, down = view.control["followed_position"].tolist()
        mode = self._course.parameters.get("FLW_TGT_ALT_M")
        if mode != OVER_TARGET:
            measured = mode == OVER_GROUND and view.estimator["terrain_valid"]
            down = float(view.estimator["terrain"] if measured else view.setpoint["home_z"])
        return -math.atan2(down - z, math.hypot(north - x, east - y))

    def _update_estimate(self) -> None:
        self._estimate.advance(self._course.view.time_us)
        self._write()

    def _measure(self, report: _Report) -> None:
        if self._course.view.has_origin:
            position = self._course.view.to_local(*report.place)
            responsiveness = self._course.parameters.get("FLW_TGT_RS")
            self._estimate.measure(report.time_us, position, report.velocity, responsiveness)

    def _write(self) -> None:
        view = self._course.view
        view.setpoint["target_position"] = self._estimate.position
        view.setpoint["target_velocity"] = self._estimate.velocity
        view.setpoint["target_acceleration"] = self._estimate.acceleration
        view.setpoint["target_time"] = view.control["armed_time"]
