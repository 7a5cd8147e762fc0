"""Home position."""

from __future__ import annotations

from typing import Any

from mavros_msgs.msg import HomePosition
from pymavlink.dialects.v20 import common as mavlink
from std_srvs.srv import Trigger, TriggerResponse

from xtdrone_common import frames
from xtdrone_mavros.feeds import Feed
from xtdrone_mavros.link.ros_values_to_mavlink import whole
from xtdrone_mavros.uas import Plugin, Uas

_POLL_PERIOD_NS = 10_000_000_000  # MAVROS's REQUEST_POLL_TIME
_CHECK_PERIOD = 1.0  # s of ROS time


class HomePositionPlugin(Plugin):
    """MAVROS's home_position. Altitudes are above the ellipsoid, see ``global_position/geoid``.

    While an autopilot that is connected sends no home position, it is asked for one every 10 s.

    The orientation is that of ``base_link`` in ENU, as in local_position/pose (MAVROS leaves the body axes FRD here, so
    a level home position comes out upside down).
    """

    name = "home_position"

    def __init__(self, uas: Uas) -> None:
        """Advertise topic and service."""
        super().__init__(uas)
        self._asks_at_ns: int | None = None  # ROS time of the next request; None: no home position is missing
        self._home = uas.topic("home_position/home", HomePosition(), latch=True)
        self.messages = {"HOME_POSITION": Feed(self._on_home, always=True)}
        uas.subscribe("home_position/set", HomePosition, self._set)
        uas.service("home_position/req_update", Trigger, self._request)
        uas.timer(_CHECK_PERIOD, self._poll)

    def connected(self, connected: bool) -> None:
        """Begin to wait for the home position, or stop."""
        self._asks_at_ns = self.uas.now_ns + _POLL_PERIOD_NS if connected else None

    def _poll(self) -> None:
        if self._asks_at_ns is not None and self.uas.now_ns >= self._asks_at_ns:
            self._asks_at_ns = self.uas.now_ns + _POLL_PERIOD_NS
            self.uas.commands.send(mavlink.MAV_CMD_GET_HOME_POSITION, self._query(0))

    def _query(self, attempt: int) -> Any:
        return mavlink.MAVLink_command_long_message(
            *self.uas.target, mavlink.MAV_CMD_GET_HOME_POSITION, attempt, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        )

    def _on_home(self, home: Any) -> None:
        self._asks_at_ns = None
        message = self._home.message
        self.uas.stamp_us(message.header, home.time_usec)
        message.geo.latitude = home.latitude / 1e7
        message.geo.longitude = home.longitude / 1e7
        message.geo.altitude = home.altitude / 1e3 + self.uas.geoid_height(message.geo.latitude, message.geo.longitude)
        place, q, approach = message.position, message.orientation, message.approach
        place.x, place.y, place.z = frames.ned_to_enu(home.x, home.y, home.z)
        q.w, q.x, q.y, q.z = frames.attitude_ned_to_enu(*home.q)
        approach.x, approach.y, approach.z = frames.ned_to_enu(home.approach_x, home.approach_y, home.approach_z)
        self._home.publish(message)

    def _set(self, home: HomePosition) -> None:
        place, q, approach = home.position, home.orientation, home.approach
        fields = [("geo.latitude", home.geo.latitude), ("geo.longitude", home.geo.longitude)]
        fields += [("geo.altitude", home.geo.altitude), ("position.x", place.x), ("position.y", place.y)]
        fields += [("position.z", place.z)]
        if not self.uas.finite("home_position/set", fields):
            return
        geoid = self.uas.geoid_height(home.geo.latitude, home.geo.longitude)
        self.uas.link.send(
            mavlink.MAVLink_set_home_position_message(
                self.uas.target[0],
                whole(home.geo.latitude * 1e7),
                whole(home.geo.longitude * 1e7),
                whole((home.geo.altitude - geoid) * 1e3),
                *frames.enu_to_ned(place.x, place.y, place.z),
                list(frames.attitude_enu_to_ned(q.w, q.x, q.y, q.z)),
                *frames.enu_to_ned(approach.x, approach.y, approach.z),
                home.header.stamp.to_nsec() // 1000,
            )
        )

    def _request(self, _: Any) -> TriggerResponse:
        result = self.uas.commands.call(mavlink.MAV_CMD_GET_HOME_POSITION, self._query)
        return TriggerResponse(success=result == mavlink.MAV_RESULT_ACCEPTED, message="")
