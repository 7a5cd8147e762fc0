"""Global position from the estimator and from the GPS receiver."""

from __future__ import annotations

from math import cos, radians, sin
from typing import Any

from geographic_msgs.msg import GeoPointStamped
from geometry_msgs.msg import PoseStamped, TransformStamped, TwistStamped
from nav_msgs.msg import Odometry
from pymavlink.dialects.v20 import common as mavlink
from sensor_msgs.msg import NavSatFix, NavSatStatus
from std_msgs.msg import Float64, UInt32
from tf2_msgs.msg import TFMessage

from xtdrone_common import frames
from xtdrone_mavros.feeds import Feed, Topic
from xtdrone_mavros.link.ros_values_to_mavlink import whole
from xtdrone_mavros.uas import Plugin, Uas

_UNKNOWN = 65535  # of the 16-bit fields
_UNKNOWN_COVARIANCE = [-1.0, *[0.0] * 8]
_NAN = float("nan")


class GlobalPositionPlugin(Plugin):
    """MAVROS's global_position.

    Altitudes of NavSatFix and GeoPoint are above the ellipsoid: the autopilot's AMSL plus the EGM96 geoid height, as in
    MAVROS; with ``global_position/geoid: none`` they stay AMSL.

    ``global_position/local`` is relative to home, or to the first fix until a home position arrives. Its velocity is
    ENU (in MAVROS, z points down).
    """

    name = "global_position"

    def __init__(self, uas: Uas) -> None:
        """Advertise and subscribe."""
        super().__init__(uas)
        get = uas.params.get
        frame = get("global_position/frame_id", "map")
        body = get("global_position/child_frame_id", "base_link")
        self._uere = get("global_position/gps_uere", 1.0)
        self._rotation_variance = get("global_position/rot_covariance", 99999.0)
        self._relative_altitude = get("global_position/use_relative_alt", True)
        self._first_fix: frames.Vector | None = None
        self._raw_of: Any = None
        self._raw_fix = NavSatFix(position_covariance=_UNKNOWN_COVARIANCE)
        self._raw_fix.status.service, self._raw_fix.status.status = NavSatStatus.SERVICE_GPS, NavSatStatus.STATUS_NO_FIX

        self._raw = uas.topic("global_position/raw/fix", NavSatFix())
        self._raw_velocity = uas.topic("global_position/raw/gps_vel", TwistStamped())
        self._satellites = uas.topic("global_position/raw/satellites", UInt32())
        self._global = uas.topic("global_position/global", NavSatFix())
        self._local = uas.topic("global_position/local", Odometry(child_frame_id=body))
        self._relative = uas.topic("global_position/rel_alt", Float64())
        self._heading = uas.topic("global_position/compass_hdg", Float64())
        self._gp_origin = uas.topic("global_position/gp_origin", GeoPointStamped(), latch=True)
        self._offset = uas.topic("global_position/gp_lp_offset", PoseStamped())
        self._tf = self._transforms()
        earth = get("global_position/tf/global_frame_id", "earth")
        self._gp_origin.message.header.frame_id = self._offset.message.header.frame_id = earth
        self._raw.message.header.frame_id = self._global.message.header.frame_id = body
        self._raw_velocity.message.header.frame_id = self._local.message.header.frame_id = frame
        self._local.message.twist.covariance = [-1.0, *[0.0] * 35]  # unknown
        local = [self._local] if self._tf is None else [self._local, self._tf]
        self.messages = {
            "GPS_RAW_INT": [
                Feed(self._on_gps, self._raw, self._raw_velocity, self._satellites),
                Feed(None, self._global, *local),
            ],
            "GLOBAL_POSITION_INT": Feed(self._on_global, self._global, *local, self._relative, self._heading),
            "ATTITUDE_QUATERNION": Feed(None, *local),
            "HOME_POSITION": Feed(None, *local),
            "GPS_GLOBAL_ORIGIN": Feed(self._on_origin, self._gp_origin),
            "LOCAL_POSITION_NED_SYSTEM_GLOBAL_OFFSET": Feed(self._on_offset, self._offset),
        }
        uas.subscribe("global_position/set_gp_origin", GeoPointStamped, self._set_origin)

    def _transforms(self) -> Topic | None:
        """Advertise the transform of ``global_position/local`` if ``global_position/tf/send`` is set."""
        get = self.uas.params.get
        if not get("global_position/tf/send", False):
            return None
        transform = TransformStamped(child_frame_id=get("global_position/tf/child_frame_id", "base_link"))
        transform.header.frame_id = get("global_position/tf/frame_id", "map")
        return self.uas.topic("/tf", TFMessage([transform]))

    def _on_origin(self, origin: Any) -> None:
        message = self._gp_origin.message
        self.uas.stamp_now(message.header)
        place = self._place(origin.latitude, origin.longitude, origin.altitude)
        message.position.latitude, message.position.longitude, message.position.altitude = place
        self._gp_origin.publish(message)

    def _set_origin(self, origin: Any) -> None:
        place = origin.position
        self.uas.link.send(
            mavlink.MAVLink_set_gps_global_origin_message(
                self.uas.target[0],
                whole(place.latitude * 1e7),
                whole(place.longitude * 1e7),
                whole((place.altitude - self.uas.geoid_height(place.latitude, place.longitude)) * 1e3),
            )
        )

    def _on_offset(self, offset: Any) -> None:
        message = self._offset.message
        self.uas.stamp(message.header, offset.time_boot_ms)
        point, q = message.pose.position, message.pose.orientation
        point.x, point.y, point.z = frames.ned_to_enu(offset.x, offset.y, offset.z)
        attitude = frames.quaternion_from_rpy(offset.roll, offset.pitch, offset.yaw)
        q.w, q.x, q.y, q.z = frames.attitude_ned_to_enu(*attitude)
        self._offset.publish(message)

    def _place(self, latitude: int, longitude: int, altitude: int) -> frames.Vector:
        """Convert MAVLink's 1e-7 deg and mm AMSL to deg, deg and m above the ellipsoid."""
        north, east = latitude / 1e7, longitude / 1e7
        return north, east, altitude / 1e3 + self.uas.geoid_height(north, east)

    def _on_gps(self, gps: Any) -> None:
        if self._raw.needed:
            message = self._raw.message
            self._fill_raw(message, gps)
            self.uas.stamp_us(message.header, gps.time_usec)
            self._raw.publish(message)
        if self._raw_velocity.needed and gps.vel != _UNKNOWN and gps.cog != _UNKNOWN:
            message = self._raw_velocity.message
            self.uas.stamp_us(message.header, gps.time_usec)
            speed, course = gps.vel / 100.0, radians(gps.cog / 100.0)
            message.twist.linear.x, message.twist.linear.y = speed * sin(course), speed * cos(course)
            self._raw_velocity.publish(message)
        if self._satellites.needed:
            self._satellites.message.data = gps.satellites_visible
            self._satellites.publish(self._satellites.message)

    def _on_global(self, position: Any) -> None:
        if self._relative.needed:
            self._relative.message.data = position.relative_alt / 1e3
            self._relative.publish(self._relative.message)
        if self._heading.needed:
            self._heading.message.data = position.hdg / 100.0 if position.hdg != _UNKNOWN else _NAN
            self._heading.publish(self._heading.message)
        with_tf = self._tf is not None and self._tf.needed
        if not (self._global.needed or self._local.needed or with_tf):
            return
        place = self._place(position.lat, position.lon, position.alt)
        raw = self._latest_fix()
        if self._global.needed:
            fix = self._global.message
            self.uas.stamp(fix.header, position.time_boot_ms)
            fix.latitude, fix.longitude, fix.altitude = place
            fix.status.service, fix.status.status = raw.status.service, raw.status.status
            fix.position_covariance = raw.position_covariance
            fix.position_covariance_type = raw.position_covariance_type
            self._global.publish(fix)
        if self._local.needed or with_tf:
            self._publish_local(position, place, raw)

    def _publish_local(self, position: Any, place: frames.Vector, raw: NavSatFix) -> None:
        attitude = self.uas.attitude()
        origin = self._origin(place, raw)
        if attitude is None or origin is None:
            return
        odom = self._local.message
        self.uas.stamp(odom.header, position.time_boot_ms)
        point, q, linear = odom.pose.pose.position, odom.pose.pose.orientation, odom.twist.twist.linear
        point.x, point.y, point.z = frames.geodetic_to_enu(place, origin)
        if self._relative_altitude:
            point.z = position.relative_alt / 1e3
        q.w, q.x, q.y, q.z = attitude[0]
        linear.x, linear.y, linear.z = frames.ned_to_enu(position.vx / 100.0, position.vy / 100.0, position.vz / 100.0)
        odom.pose.covariance = _pose_covariance(raw.position_covariance, self._rotation_variance)
        if self._local.needed:
            self._local.publish(odom)
        if self._tf is not None and self._tf.needed:
            [transform] = self._tf.message.transforms
            self.uas.stamp(transform.header, position.time_boot_ms)
            to = transform.transform.translation
            to.x, to.y, to.z = point.x, point.y, point.z
            transform.transform.rotation = q
            self._tf.publish(self._tf.message)

    def _origin(self, place: frames.Vector, raw: NavSatFix) -> frames.Vector | None:
        home = self.uas.latest("HOME_POSITION")
        if home is not None:
            return self._place(home.latitude, home.longitude, home.altitude)
        if self._first_fix is None and raw.status.status >= NavSatStatus.STATUS_FIX:
            self._first_fix = place
        return self._first_fix

    def _latest_fix(self) -> NavSatFix:
        gps = self.uas.latest("GPS_RAW_INT")
        if gps is not None and gps is not self._raw_of:
            self._fill_raw(self._raw_fix, gps)
            self._raw_of = gps
        return self._raw_fix

    def _fill_raw(self, fix: NavSatFix, gps: Any) -> None:
        fix.status.service = NavSatStatus.SERVICE_GPS
        has_fix = gps.fix_type >= mavlink.GPS_FIX_TYPE_3D_FIX
        fix.status.status = NavSatStatus.STATUS_FIX if has_fix else NavSatStatus.STATUS_NO_FIX
        fix.latitude, fix.longitude, fix.altitude = self._place(gps.lat, gps.lon, gps.alt)
        if gps.h_acc > 0 and gps.v_acc > 0:
            horizontal, vertical = gps.h_acc / 1e3, gps.v_acc / 1e3
            fix.position_covariance_type = NavSatFix.COVARIANCE_TYPE_DIAGONAL_KNOWN
        elif _UNKNOWN not in (gps.eph, gps.epv):
            horizontal, vertical = gps.eph / 100.0 * self._uere, gps.epv / 100.0 * self._uere
            fix.position_covariance_type = NavSatFix.COVARIANCE_TYPE_APPROXIMATED
        else:
            fix.position_covariance_type = NavSatFix.COVARIANCE_TYPE_UNKNOWN
            fix.position_covariance = _UNKNOWN_COVARIANCE
            return
        h, v = horizontal * horizontal, vertical * vertical
        fix.position_covariance = [h, 0.0, 0.0, 0.0, h, 0.0, 0.0, 0.0, v]


def _pose_covariance(position: list[float], rotation_variance: float) -> list[float]:
    """Return a 6x6 covariance, row by row, from a 3x3 position covariance and one variance for all angles."""
    matrix = [0.0] * 36
    for row in range(3):
        matrix[6 * row : 6 * row + 3] = position[3 * row : 3 * row + 3]
    matrix[21] = matrix[28] = matrix[35] = rotation_variance
    return matrix
