"""Sensors received over MAVLink: external vision, motion capture, optical flow, range finders, obstacles around.

Each message fills the vehicle's ``SENSORS`` record; the estimator decides whether to fuse it. Frames, covariances (NaN
in the first element means none), NaN for unknown values and reset_counter are handled as in PX4 v1.14;
VISION_SPEED_ESTIMATE is ignored, since velocities come with ODOMETRY. Unlike in PX4, where EKF2 ignores motion capture
(ATT_POS_MOCAP, ODOMETRY of that estimator type) and only the other estimator uses it, it counts as vision. The time of
a sample is its arrival; its timestamp is ignored.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, ClassVar

from xtdrone_autopilot.commander.commander import CRITICAL
from xtdrone_autopilot.events.events import ERROR
from xtdrone_autopilot.flight_tasks.obstacle_map import FORWARD_FRAME, NORTH_FRAMES, ObstacleMap
from xtdrone_autopilot.mavlink.client_link import Link
from xtdrone_autopilot.mavlink.service_base import Service, Vehicle
from xtdrone_autopilot.state import VISION_BODY, VISION_FRD, VISION_NED
from xtdrone_common import frames

_NAN = math.nan
_UNKNOWN = (_NAN, _NAN, _NAN)
_NO_ATTITUDE = (_NAN, _NAN, _NAN, _NAN)
_FARTHEST = 1e6  # m or m/s; larger values are invalid

# MAV_FRAME
_LOCAL_NED, _LOCAL_ENU, _BODY_FRD, _LOCAL_FRD, _LOCAL_FLU = 1, 4, 12, 20, 21
# MAV_ESTIMATOR_TYPE: unknown, naive, vision, VIO, motion capture
_ESTIMATORS = (0, 1, 2, 3, 6)
# indices of the variances of x, y, z and of yaw in the upper triangle of a 6 x 6 matrix, row by row
_POSITION_VARIANCES, _YAW_VARIANCE = (0, 6, 11), 20

_FACING_DOWN = 25  # MAV_SENSOR_ROTATION_PITCH_270
_FLOW_RANGE = (0.08, 100.0)  # m, PX4's SENS_FLOW_MINHGT and SENS_FLOW_MAXHGT
_QUALITY_UNKNOWN = -1
_TEXT_INTERVAL_US = 1_000_000

Vector = tuple[float, float, float]


def _measured(x: float, y: float, z: float) -> Vector:
    """Return the vector, with NaN for invalid components."""
    x, y, z = (value if abs(value) <= _FARTHEST else _NAN for value in (x, y, z))
    return x, y, z


def _unit(q: Sequence[float]) -> tuple[float, ...]:
    """Return the normalised quaternion, NaN if it is invalid."""
    length = math.sqrt(sum(value * value for value in q))
    if not math.isfinite(length) or length < 0.5:
        return _NO_ATTITUDE
    return tuple(value / length for value in q)


def _variance(covariance: Sequence[float], index: int) -> float:
    """Return a variance from an upper triangle, NaN if it is unknown."""
    value = covariance[index]
    return value if math.isfinite(covariance[0]) and 0.0 <= value < math.inf else _NAN


def _variances(covariance: Sequence[float]) -> Vector:
    x, y, z = (_variance(covariance, index) for index in _POSITION_VARIANCES)
    return x, y, z


class VisionService(Service):
    """Passes external measurements to the estimator."""

    MESSAGES: ClassVar[dict[str, str]] = {
        "VISION_POSITION_ESTIMATE": "_vision_position",
        "ATT_POS_MOCAP": "_mocap",
        "ODOMETRY": "_odometry",
        "OPTICAL_FLOW_RAD": "_flow",
        "DISTANCE_SENSOR": "_distance",
        "OBSTACLE_DISTANCE": "_obstacles",
    }

    def __init__(self, vehicle: Vehicle) -> None:
        """Register the service with ``vehicle``."""
        super().__init__(vehicle)
        self._sensors = vehicle.autopilot.sensors[vehicle.index]
        self._map = ObstacleMap(vehicle.commander.view, vehicle.commander.parameters.get)
        self._refused_us = -_TEXT_INTERVAL_US

    def _queue(self, apply: Callable[[Any], None], m: Any) -> None:
        self.vehicle.call_or_queue(lambda: apply(m))

    def _vision_position(self, _link: Link, m: Any) -> None:
        self._queue(self._apply_vision_position, m)

    def _mocap(self, _link: Link, m: Any) -> None:
        self._queue(self._apply_mocap, m)

    def _odometry(self, _link: Link, m: Any) -> None:
        self._queue(self._apply_odometry, m)

    def _flow(self, _link: Link, m: Any) -> None:
        self._queue(self._apply_flow, m)

    def _distance(self, _link: Link, m: Any) -> None:
        self._queue(self._apply_distance, m)

    def _obstacles(self, _link: Link, m: Any) -> None:
        if self._map.wanted:
            self._queue(self._apply_obstacles, m)

    def _apply_obstacles(self, m: Any) -> None:
        if m.frame != FORWARD_FRAME and m.frame not in NORTH_FRAMES:
            now_us = self.vehicle.autopilot.time_us
            if now_us - self._refused_us >= _TEXT_INTERVAL_US:
                self._refused_us = now_us
                text = f"Obstacle message received in unsupported frame {m.frame}"
                self.vehicle.commander.tell(CRITICAL, text, "col_prev_unsup_frame", m.frame, level=ERROR)
            return
        increment = m.increment_f if m.increment_f > 0.0 else float(m.increment)
        limits = (float(m.min_distance), float(m.max_distance))
        north = m.frame in NORTH_FRAMES
        self._map.add_directions(m.distances, increment, m.angle_offset, limits, north=north)

    def _apply_vision_position(self, m: Any) -> None:
        finite = all(map(math.isfinite, (m.roll, m.pitch, m.yaw)))
        q = frames.quaternion_from_rpy(m.roll, m.pitch, m.yaw) if finite else _NO_ATTITUDE
        self._vision(VISION_NED, _measured(m.x, m.y, m.z), q, m.covariance, m.reset_counter)

    def _apply_mocap(self, m: Any) -> None:
        self._vision(VISION_NED, _measured(m.x, m.y, m.z), _unit(m.q), m.covariance, 0)

    def _vision(
        self, frame: int, position: Vector, q: Sequence[float], covariance: Sequence[float], resets: int
    ) -> None:
        """Store a pose, without a velocity."""
        s = self._sensors
        s["vision_frame"] = frame
        s["vision_position"] = position
        s["vision_position_variance"] = _variances(covariance)
        s["vision_q"] = q
        s["vision_yaw_variance"] = _variance(covariance, _YAW_VARIANCE)
        s["vision_velocity"] = _UNKNOWN
        s["vision_quality"] = _QUALITY_UNKNOWN
        s["vision_reset_counter"] = resets
        s["vision_fresh"] = 1

    def _apply_odometry(self, m: Any) -> None:
        if m.estimator_type not in _ESTIMATORS:
            self.vehicle.commander.say(CRITICAL, f"ODOMETRY: estimator_type {m.estimator_type} unsupported")
            return
        pose = _pose(m)
        velocity = _velocity(m)
        if pose is None and velocity is None:
            return
        frame, position, variances = pose or (VISION_FRD, _UNKNOWN, _UNKNOWN)
        self._vision(frame, position, _unit(m.q), m.pose_covariance, m.reset_counter)
        s = self._sensors
        s["vision_position_variance"] = variances
        s["vision_quality"] = m.quality
        if velocity is not None:
            s["vision_velocity_frame"], s["vision_velocity"], s["vision_velocity_variance"] = velocity

    def _apply_flow(self, m: Any) -> None:
        if not m.integration_time_us:
            return
        period = m.integration_time_us * 1e-6
        rate = (m.integrated_x / period, m.integrated_y / period)
        if not all(map(math.isfinite, rate)):
            return
        s = self._sensors
        s["flow_rate"] = rate
        s["flow_gyro"] = (m.integrated_xgyro / period, m.integrated_ygyro / period)
        s["flow_quality"] = m.quality
        s["flow_fresh"] = 1
        if m.distance > 0.0:  # negative, and 0 in PX4: unknown
            self._range(m.distance, *_FLOW_RANGE, _QUALITY_UNKNOWN)

    def _apply_distance(self, m: Any) -> None:
        if m.orientation != _FACING_DOWN:
            if self._map.wanted:
                limits = (m.min_distance * 0.01, m.max_distance * 0.01)
                width, distance = m.horizontal_fov, m.current_distance * 0.01
                self._map.add_sensor(m.orientation, m.quaternion, width, distance, limits)
            return
        quality = _QUALITY_UNKNOWN if m.signal_quality == 0 else 100 * (m.signal_quality - 1) // 99
        self._range(m.current_distance * 0.01, m.min_distance * 0.01, m.max_distance * 0.01, quality)

    def _range(self, distance: float, least: float, largest: float, quality: int) -> None:
        s = self._sensors
        s["range_distance"], s["range_least"], s["range_largest"] = distance, least, largest
        s["range_quality"] = quality
        s["range_fresh"] = 1


def _to_ned_or_frd(frame: int, x: float, y: float, z: float) -> Vector:
    """Convert a vector from ENU to NED or from FLU to FRD; vectors of other frames are unchanged."""
    if frame == _LOCAL_ENU:
        return _measured(y, x, -z)
    if frame == _LOCAL_FLU:
        return _measured(x, -y, -z)
    return _measured(x, y, z)


def _variances_to_ned_or_frd(frame: int, covariance: Sequence[float]) -> Vector:
    x, y, z = _variances(covariance)
    return (y, x, z) if frame == _LOCAL_ENU else (x, y, z)


def _pose(m: Any) -> tuple[int, Vector, Vector] | None:
    """Return frame, position and position variances of an ODOMETRY, None if it has no usable one."""
    frame = m.frame_id
    if frame not in (_LOCAL_NED, _LOCAL_ENU, _LOCAL_FRD, _LOCAL_FLU):
        return None
    kind = VISION_NED if frame in (_LOCAL_NED, _LOCAL_ENU) else VISION_FRD
    return kind, _to_ned_or_frd(frame, m.x, m.y, m.z), _variances_to_ned_or_frd(frame, m.pose_covariance)


def _velocity(m: Any) -> tuple[int, Vector, Vector] | None:
    """Return frame, velocity and velocity variances of an ODOMETRY, None if it has no usable one."""
    frame = m.child_frame_id
    kinds = {
        _LOCAL_NED: VISION_NED,
        _LOCAL_ENU: VISION_NED,
        _LOCAL_FRD: VISION_FRD,
        _LOCAL_FLU: VISION_FRD,
        _BODY_FRD: VISION_BODY,
    }
    if frame not in kinds:
        return None
    velocity = _to_ned_or_frd(frame, m.vx, m.vy, m.vz)
    if any(map(math.isnan, velocity)):
        return None
    return kinds[frame], velocity, _variances_to_ned_or_frd(frame, m.velocity_covariance)
