"""Position setpoints as poses, local and global."""

from __future__ import annotations

from typing import Any

from geographic_msgs.msg import GeoPoseStamped
from geometry_msgs.msg import PoseStamped, TransformStamped
from pymavlink.dialects.v20 import common as mavlink

from xtdrone_common import frames
from xtdrone_mavros.feeds import Feed
from xtdrone_mavros.lib.mav_frames import MavFrame
from xtdrone_mavros.lib.setpoint_messages import (
    ONLY_GLOBAL_POSITION_YAW,
    ONLY_POSITION_YAW,
    global_target,
    position_target,
    vector_fields,
    xyz,
)
from xtdrone_mavros.lib.tf_listener import TfListener
from xtdrone_mavros.uas import Plugin, Uas

_GOAL = "setpoint_position/global_to_local"
_APART_MS = 500  # maximum time between the local and the global position
_CHECK_PERIOD = 1.0  # s between checks for a waiting goal and for idleness
_QUIET_CHECKS = 10  # checks without a goal after which the vehicle's position is no longer requested


class SetpointPositionPlugin(Plugin):
    """MAVROS's setpoint_position: a position, and the yaw of the orientation.

    ``local`` is metres ENU. ``global`` is sent unchanged, with its altitude above mean sea level as PX4 expects.
    ``global_to_local`` is converted here to a local position: the vehicle's local position plus the offset from its
    global position to the goal. Both altitudes are those of ``global_position/global``. A goal makes the plugin request
    the vehicle's position and is sent when that has arrived; of several goals, only the latest is sent. (MAVROS sends
    at once, at first from a default position, and ignores a goal without a newer stamp.)

    With ``setpoint_position/tf/listen`` the position is that of a frame on /tf, and there are no topics.
    """

    name = "setpoint_position"

    def __init__(self, uas: Uas) -> None:
        """Subscribe."""
        super().__init__(uas)
        self._frame = MavFrame(uas, self.name)
        self._goal: GeoPoseStamped | None = None  # waiting for the vehicle's position
        self._waits_long = False  # whether the goal was already waiting at the last check
        self._quiet = 0  # checks since the last goal
        self._place, self._local_position = Feed(self._on_place), Feed(None)
        self.messages = {"GLOBAL_POSITION_INT": self._place, "LOCAL_POSITION_NED": self._local_position}
        self._listener = None
        if uas.params.get("setpoint_position/tf/listen", False):
            self._listener = TfListener(uas, self.name, "target_position", self._transform)
            return
        uas.subscribe_setpoint("setpoint_position/local", PoseStamped, self._local)
        uas.subscribe("setpoint_position/global", GeoPoseStamped, self._global)
        uas.subscribe(_GOAL, GeoPoseStamped, self._store_goal)
        uas.timer(_CHECK_PERIOD, self._check_goal)

    def connected(self, connected: bool) -> None:
        """Drop the goal after the vehicle was lost or reset."""
        self._goal, self._waits_long = None, False
        if self._listener is not None:
            self._listener.clear()

    def _transform(self, transform: TransformStamped) -> None:
        pose = PoseStamped(header=transform.header)
        pose.pose.orientation = transform.transform.rotation
        translation = transform.transform.translation
        if self.uas.finite("/tf", vector_fields("translation", translation)):
            self._send(xyz(translation), pose)

    def _local(self, pose: PoseStamped) -> None:
        p = pose.pose.position
        if self._finite("setpoint_position/local", vector_fields("pose.position", p), pose):
            self._send(xyz(p), pose)

    def _global(self, pose: GeoPoseStamped) -> None:
        if not self._finite("setpoint_position/global", _place_fields(pose), pose):
            return
        place = pose.pose.position
        self.uas.link.send(
            global_target(
                self.uas,
                self.uas.boot_ms(pose.header),
                mavlink.MAV_FRAME_GLOBAL_INT,
                ONLY_GLOBAL_POSITION_YAW,
                (place.latitude, place.longitude, place.altitude),
                yaw=_yaw(pose),
            )
        )

    def _store_goal(self, pose: GeoPoseStamped) -> None:
        if not self._finite(_GOAL, _place_fields(pose), pose):
            return
        place = pose.pose.position
        if abs(place.latitude) > 90.0 or abs(place.longitude) > 180.0:
            text = "%s: latitude %s, longitude %s is not a valid position; the message is not forwarded"
            self.uas.warn(_GOAL, text, _GOAL, place.latitude, place.longitude)
            return
        self._goal, self._quiet = pose, 0
        self._request_position(True)

    def _request_position(self, wanted: bool) -> None:
        """Request the vehicle's position, or stop requesting it."""
        if wanted != self._place.always:
            self._place.always = self._local_position.always = wanted
            self.uas.refresh()

    def _check_goal(self) -> None:
        if self._waits_long:
            self.uas.warn(_GOAL, "%s: a goal is waiting: no global position arrives from the vehicle", _GOAL)
        self._waits_long = self._goal is not None
        self._quiet += 1
        if self._quiet > _QUIET_CHECKS and self._goal is None:
            self._request_position(False)

    def _on_place(self, place: Any) -> None:
        """Send the waiting goal, relative to the vehicle's position (GLOBAL_POSITION_INT)."""
        pose = self._goal
        if pose is None:
            return
        local = self.uas.latest("LOCAL_POSITION_NED")
        if local is None or abs(local.time_boot_ms - place.time_boot_ms) > _APART_MS:
            return
        self._goal, self._waits_long = None, False
        goal = pose.pose.position
        latitude, longitude = place.lat / 1e7, place.lon / 1e7
        here = latitude, longitude, place.alt / 1e3 + self.uas.geoid_height(latitude, longitude)
        way = frames.geodetic_to_enu((goal.latitude, goal.longitude, goal.altitude), here)
        x, y, z = frames.ned_to_enu(local.x, local.y, local.z)
        position = x + way[0], y + way[1], z + way[2]
        if self.uas.finite(_GOAL, zip(("east", "north", "up"), position, strict=True)):
            self._send(position, pose)

    def _send(self, position: frames.Vector, pose: PoseStamped | GeoPoseStamped) -> None:
        """Send a local position (m, ENU or FLU depending on the frame) with the stamp and yaw of a pose."""
        time_boot_ms = self.uas.boot_ms(pose.header)
        self.uas.link.send(
            position_target(
                self.uas, time_boot_ms, self._frame.value, ONLY_POSITION_YAW, position=position, yaw=_yaw(pose)
            )
        )

    def _finite(self, topic: str, position: list[tuple[str, float]], pose: PoseStamped | GeoPoseStamped) -> bool:
        return self.uas.finite(topic, position + vector_fields("pose.orientation", pose.pose.orientation, "xyzw"))


def _yaw(pose: PoseStamped | GeoPoseStamped) -> float:
    q = pose.pose.orientation
    return frames.yaw_from_quaternion((q.w, q.x, q.y, q.z))


def _place_fields(pose: GeoPoseStamped) -> list[tuple[str, float]]:
    place = pose.pose.position
    return [(f"pose.position.{name}", getattr(place, name)) for name in ("latitude", "longitude", "altitude")]
