"""GPS receiver emulated from a motion-capture or vision system's poses."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped, TransformStamped
from pymavlink.dialects.v20 import common as mavlink

from xtdrone_common import frames
from xtdrone_mavros.link.ros_values_to_mavlink import whole
from xtdrone_mavros.relayed_messages import In, limit_rate
from xtdrone_mavros.uas import Plugin, Uas

_GPS_EPOCH = 315_964_800 - 18  # s of Unix time at the start of GPS time, with the leap seconds since then
_WEEK_MS = 7 * 86_400_000
_STILL = 0.01  # m/s; lower velocities are sent as 0

_IGNORE_HDOP = mavlink.GPS_INPUT_IGNORE_FLAG_HDOP
_IGNORE_VDOP = mavlink.GPS_INPUT_IGNORE_FLAG_VDOP
_IGNORE_HORIZONTAL = mavlink.GPS_INPUT_IGNORE_FLAG_VEL_HORIZ
_IGNORE_VERTICAL = mavlink.GPS_INPUT_IGNORE_FLAG_VEL_VERT
_IGNORE_SPEED_ACCURACY = mavlink.GPS_INPUT_IGNORE_FLAG_SPEED_ACCURACY


class FakeGpsPlugin(Plugin):
    """MAVROS's fake_gps without its tf listener: ENU positions around ``fake_gps/geo_origin``, as HIL_GPS or GPS_INPUT.

    The velocity is the change of the position, in NED (in MAVROS, of the earth-centred position, negated); the course
    is its direction in hundredths of a degree (in MAVROS, of a radian). The origin's altitude is above the ellipsoid.
    """

    name = "fake_gps"

    def __init__(self, uas: Uas) -> None:
        """Subscribe.

        Raises:
            ValueError: the rate is not positive.
        """
        super().__init__(uas)
        get = uas.params.get
        self._origin = (
            get("fake_gps/geo_origin/lat", 47.3667),
            get("fake_gps/geo_origin/lon", 8.5500),
            get("fake_gps/geo_origin/alt", 408.0),
        )
        self._last: tuple[int, frames.Vector] | None = None  # stamp (ns) and position (m, ENU)
        self._eph, self._epv = get("fake_gps/eph", 2.0), get("fake_gps/epv", 2.0)
        self._accuracies = [get(f"fake_gps/{name}_accuracy", 0.0) for name in ("horiz", "vert", "speed")]
        self._same = {
            "fix_type": get("fake_gps/fix_type", 0),
            "satellites_visible": get("fake_gps/satellites_visible", 5),
        }
        self._gps_id = get("fake_gps/gps_id", 0)
        source = self._source()
        if source is None:
            uas.warn("fake_gps", "fake_gps: neither use_mocap nor use_vision is set; there is no source of poses")
            return
        topic, kind, position = source
        name, convert = ("HIL_GPS", self._hil_gps) if get("fake_gps/use_hil_gps", True) else ("GPS_INPUT", self._input)
        row = In(f"fake_gps/{topic}", kind, name, lambda m: convert(m, *self._fix(m, position(m))))
        uas.subscribe(row.topic, row.kind, limit_rate(uas, lambda m: row.forward(uas, m), "fake_gps/gps_rate", 5.0))

    def _source(self) -> tuple[str, type, Callable[[Any], Any]] | None:
        """Return topic and type of the poses, and a function that extracts the position."""
        get = self.uas.params.get
        if get("fake_gps/use_mocap", True):
            if get("fake_gps/mocap_transform", True):
                return "mocap/tf", TransformStamped, lambda m: m.transform.translation
            if get("fake_gps/mocap_withcovariance", False):
                return "mocap/pose_cov", PoseWithCovarianceStamped, self._position_with_covariance
            return "mocap/pose", PoseStamped, lambda m: m.pose.position
        if get("fake_gps/use_vision", False):
            return "vision", PoseStamped, lambda m: m.pose.position
        return None

    def _position_with_covariance(self, m: Any) -> Any:
        """Return the position, and store the accuracies, as in MAVROS."""
        variance = m.pose.covariance
        self._accuracies[:2] = (variance[0] + variance[7]) / 2.0, variance[14]
        return m.pose.pose.position

    def _fix(self, m: Any, place: Any) -> tuple[frames.Vector, frames.Vector]:
        """Return (latitude deg, longitude deg, altitude m AMSL) and the velocity (m/s, NED) since the last position."""
        now_ns, position = m.header.stamp.to_nsec(), (place.x, place.y, place.z)
        velocity = (0.0, 0.0, 0.0)
        if self._last is not None and now_ns > self._last[0]:
            last_ns, last = self._last
            seconds = (now_ns - last_ns) * 1e-9
            east, north, up = ((new - old) / seconds for new, old in zip(position, last, strict=True))
            velocity = frames.enu_to_ned(east, north, up)
        if all(map(math.isfinite, position)):
            self._last = now_ns, position
        latitude, longitude, height = frames.enu_to_geodetic(position, self._origin)
        return (latitude, longitude, height - self.uas.geoid_height(latitude, longitude)), velocity

    def _hil_gps(self, _: Any, place: frames.Vector, velocity: frames.Vector) -> dict[str, Any]:
        vn, ve, vd = velocity
        return {
            **self._same,
            "lat": whole(place[0] * 1e7),
            "lon": whole(place[1] * 1e7),
            "alt": whole(place[2] * 1e3),
            "eph": whole(self._eph * 100.0),
            "epv": whole(self._epv * 100.0),
            "vel": whole(math.hypot(vn, ve) * 100.0),
            "vn": whole(vn * 100.0),
            "ve": whole(ve * 100.0),
            "vd": whole(vd * 100.0),
            "cog": whole(math.degrees(math.atan2(ve, vn)) * 100.0) % 36_000,
        }

    def _input(self, m: Any, place: frames.Vector, velocity: frames.Vector) -> dict[str, Any]:
        vn, ve, vd = velocity
        horizontal, vertical, speed = self._accuracies
        ignored = (
            (_IGNORE_SPEED_ACCURACY, speed == 0.0),
            (_IGNORE_HDOP, self._eph == 0.0),
            (_IGNORE_VDOP, self._epv == 0.0),
            (_IGNORE_HORIZONTAL, abs(vn) <= _STILL and abs(ve) <= _STILL),
            (_IGNORE_VERTICAL, abs(vd) <= _STILL),
        )
        week, week_ms = divmod(max(m.header.stamp.to_nsec() // 1_000_000 - _GPS_EPOCH * 1000, 0), _WEEK_MS)
        return {
            **self._same,
            "gps_id": self._gps_id,
            "ignore_flags": sum(flag for flag, is_ignored in ignored if is_ignored),
            "time_week": week,
            "time_week_ms": week_ms,
            "lat": whole(place[0] * 1e7),
            "lon": whole(place[1] * 1e7),
            "alt": place[2],
            "hdop": self._eph,
            "vdop": self._epv,
            "vn": vn,
            "ve": ve,
            "vd": vd,
            "horiz_accuracy": horizontal,
            "vert_accuracy": vertical,
            "speed_accuracy": speed,
        }
