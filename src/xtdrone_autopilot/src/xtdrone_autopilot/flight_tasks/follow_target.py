"""AUTO.FOLLOW_TARGET mode: estimate the motion of a target from its position reports (MAVLink FOLLOW_TARGET).

The estimator is PX4 v1.14's TargetEstimator, a fixed-gain (alpha-beta-gamma) filter over reported positions and
velocities. ``follow_task`` computes the setpoint from the estimate.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from xtdrone_autopilot.flight_tasks.auto_setpoint import Course
from xtdrone_autopilot.flight_tasks.tasks.follow_task import OVER_GROUND, OVER_TARGET
from xtdrone_autopilot.state import TASK_FOLLOW
from xtdrone_autopilot.vehicle_view import Vector
from xtdrone_common.geodesy import projection

_NEVER_US = -(1 << 60)
_LOST_US = 3_000_000  # without reports, after which the target is assumed to stand still
_POSITION_INTERVAL_US, _VELOCITY_INTERVAL_US = 500_000, 100_000  # minimum time between two fused samples
_LONGEST_INTERVAL, _SHORTEST_INTERVAL = 20.0, 1e-3  # s, limits of that time in the filter
_LARGEST_ACCELERATION = 20.0  # m/s^2
_SAME = 2.0 * 1.1920929e-07  # m or m/s, largest difference of repeated samples
_LEAST_RESPONSIVENESS = 0.1
_FASTEST = 1000.0  # m/s
_LOWEST, _HIGHEST = -1e3, 1e5  # m AMSL, of a target

Array = NDArray[np.float64]


class TargetEstimate:
    """Estimated motion of a target, local NED.

    Attributes:
        position: (3,) m; NaN before the first report.
        velocity: (3,) m/s.
        acceleration: (3,) m/s^2.
    """

    def __init__(self) -> None:
        """Initialise without a report."""
        self.position: Array = np.full(3, np.nan)
        self.velocity: Array = np.zeros(3)
        self.acceleration: Array = np.zeros(3)
        self._now_us = _NEVER_US
        self._reported_us = _NEVER_US
        self._fused_us = {"position": _NEVER_US, "velocity": _NEVER_US}
        self._fused: dict[str, Array] = {"position": np.full(3, np.nan), "velocity": np.full(3, np.nan)}

    def advance(self, now_us: int) -> None:
        """Predict to simulated time ``now_us``, microseconds; the target stops ``_LOST_US`` after its last report."""
        lost_us = self._reported_us + _LOST_US
        dt = max(min(now_us, lost_us) - self._now_us, 0) * 1e-6
        self.position += (self.velocity + 0.5 * self.acceleration * dt) * dt
        self.velocity += self.acceleration * dt
        if now_us >= lost_us:
            self.velocity[:] = self.acceleration[:] = 0.0
        self._now_us = now_us

    def measure(self, now_us: int, position: Vector, velocity: Vector, responsiveness: float) -> None:
        """Fuse a report; a second one of the same time is ignored.

        Args:
            now_us: simulated time, microseconds.
            position: m, local NED, finite.
            velocity: m/s, local NED; unknown if a component is not finite.
            responsiveness: FLW_TGT_RS, limited to 0.1..1; reports have more weight with lower values.
        """
        if now_us <= self._reported_us:
            return
        measured, moving = np.array(position, np.float64), np.array(velocity, np.float64)
        if self._reported_us == _NEVER_US:
            self.position = measured.copy()
            self.velocity = moving.copy() if np.isfinite(moving).all() else np.zeros(3)
            self._now_us = now_us
        else:
            self.advance(now_us)
        self._reported_us = now_us
        beta = min(max(responsiveness, _LEAST_RESPONSIVENESS), 1.0) ** (1.0 / 3.0)
        dt = self._fusion_interval("position", measured, _POSITION_INTERVAL_US)
        if dt > 0.0:
            error = measured - self.position
            self.position += (1.0 - beta**3) * error
            self.velocity += 1.5 * (1.0 - beta) ** 2 * (1.0 + beta) / dt * error
            self.acceleration += (1.0 - beta) ** 3 / dt**2 * error
        beta *= 0.9  # slightly more weight for velocities
        dt = self._fusion_interval("velocity", moving, _VELOCITY_INTERVAL_US)
        if dt > 0.0:
            error = moving - self.velocity
            self.velocity += (1.0 - beta**2) * error
            self.acceleration += (1.0 - beta) ** 2 / dt * error
        size = float(np.linalg.norm(self.acceleration))
        if size > _LARGEST_ACCELERATION:
            self.acceleration *= _LARGEST_ACCELERATION / size

    def _fusion_interval(self, kind: str, measured: Array, least_us: int) -> float:
        """Return the time, s, since the last fused sample of ``kind``, or 0 for a sample to ignore.

        A sample must be finite and arrive more than ``least_us`` after the last fused one, or twice that if its value
        is unchanged, as ground stations repeat a position until a new one is available.
        """
        since_us = self._reported_us - self._fused_us[kind]
        unchanged = float(np.linalg.norm(measured - self._fused[kind])) <= _SAME
        if not np.isfinite(measured).all() or since_us <= (2 * least_us if unchanged else least_us):
            return 0.0
        self._fused_us[kind], self._fused[kind] = self._reported_us, measured
        return min(max(since_us * 1e-6, _SHORTEST_INTERVAL), _LONGEST_INTERVAL)


@dataclass(frozen=True)
class _Report:
    """A report of a target's position.

    Attributes:
        time_us: simulated time of arrival, microseconds.
        place: latitude and longitude in degrees, altitude in m AMSL.
        velocity: m/s NED; unknown if a component is not finite.
    """

    time_us: int
    place: Vector
    velocity: Vector


class FollowTarget:
    """AUTO.FOLLOW_TARGET mode of one vehicle."""

    def __init__(self, course: Course) -> None:
        """Initialise; the setpoint is not changed until ``start``."""
        self._course = course
        self._estimate = TargetEstimate()
        self._last_report: _Report | None = None

    def report(self, place: Vector, velocity: Vector) -> None:
        """Store a report of the target in every mode, and fuse it while following.

        Args:
            place: latitude and longitude in degrees, altitude in m AMSL (-1 km to 100 km).
            velocity: m/s NED, up to 1000 per component; NaN for unknown.

        Raises:
            ValueError: position or velocity out of range.
        """
        latitude, longitude, altitude = place
        if not projection.is_place(*place) or not _LOWEST <= altitude <= _HIGHEST:
            position = f"latitude {latitude:.7f}, longitude {longitude:.7f}, altitude {altitude:g} m"
            raise ValueError(f"target: {position} is not a valid position")
        if any(abs(part) > _FASTEST for part in velocity):
            raise ValueError(f"target: velocity {velocity} m/s is not allowed, at most {_FASTEST:g} per component")
        self._last_report = _Report(self._course.view.time_us, place, velocity)
        if self._is_following:
            self._measure(self._last_report)
            self._write_setpoint()

    @property
    def _is_following(self) -> bool:
        return bool(self._course.view.setpoint["task"] == TASK_FOLLOW)

    def start(self) -> None:
        """Follow the target from its last report on; hold position without a home, which PX4 requires to follow."""
        if self._is_following:
            return
        home = self._course.home
        if home is None:
            self._course.hold()
            return
        self._course.landing = self._course.taking_off = False
        self._course.view.setpoint["home_z"] = home.position[2]
        self._estimate = TargetEstimate()
        if self._last_report is not None:
            self._measure(self._last_report)
        self._update_estimate()
        self._course.view.start_task(TASK_FOLLOW)

    def update(self) -> None:
        """Update the target's estimate, or start following once a home is set; call at 10 Hz."""
        if self._is_following:
            self._update_estimate()
        elif self._course.home is not None:
            self.start()

    def camera_pitch(self) -> float:
        """Return the pitch of the line of sight to the target, rad, positive upwards; NaN while not following.

        As in PX4, FLW_TGT_ALT_M selects the target's assumed height, as it selects the vehicle's.
        """
        view = self._course.view
        if not self._is_following:
            return math.nan
        x, y, z = view.position
        north, east, down = view.control["followed"]["position"].tolist()
        mode = self._course.parameters.get("FLW_TGT_ALT_M")
        if mode != OVER_TARGET:
            measured = mode == OVER_GROUND and view.estimator["terrain_valid"]
            down = float(view.estimator["terrain"] if measured else view.setpoint["home_z"])
        return -math.atan2(down - z, math.hypot(north - x, east - y))

    def _update_estimate(self) -> None:
        self._estimate.advance(self._course.view.time_us)
        self._write_setpoint()

    def _measure(self, report: _Report) -> None:
        if self._course.view.has_origin:
            position = self._course.view.to_local(*report.place)
            responsiveness = self._course.parameters.get("FLW_TGT_RS")
            self._estimate.measure(report.time_us, position, report.velocity, responsiveness)

    def _write_setpoint(self) -> None:
        view = self._course.view
        view.setpoint["target_position"] = self._estimate.position
        view.setpoint["target_velocity"] = self._estimate.velocity
        view.setpoint["target_acceleration"] = self._estimate.acceleration
        view.setpoint["target_time"] = view.control["armed_time"]
