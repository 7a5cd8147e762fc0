"""Target of a precision landing."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from geometry_msgs.msg import PoseStamped, TransformStamped, Vector3Stamped
from mavros_msgs.msg import LandingTarget
from pymavlink.dialects.v20 import common as mavlink
from tf2_msgs.msg import TFMessage

from xtdrone_common import frames
from xtdrone_mavros.feeds import Feed
from xtdrone_mavros.lib.mav_frames import mav_frame
from xtdrone_mavros.relayed_messages import In
from xtdrone_mavros.uas import Plugin, Uas

_PREFIX = "LANDING_TARGET_TYPE_"
_TYPES = {
    entry.name.removeprefix(_PREFIX): number
    for number, entry in mavlink.enums["LANDING_TARGET_TYPE"].items()
    if not entry.name.endswith("ENUM_END")
}
_VALID = 1  # of position_valid


class LandingTargetPlugin(Plugin):
    """MAVROS's landing_target without its tf listener.

    ``landing_target/pose`` (or ``raw``, with ``landing_target/listen_lt``) is forwarded to the autopilot: an ENU pose
    becomes the NED position and attitude of LANDING_TARGET, which PX4 interprets in its local frame. The angular
    offsets and sizes that MAVROS adds to a pose are not in MAVLink's units; here they are those of a downward-looking
    camera above the target, in radians. The target number is the last digit of ``landing_target/frame_id``, 0 without
    one.
    """

    name = "landing_target"

    def __init__(self, uas: Uas) -> None:
        """Advertise and subscribe.

        Raises:
            ValueError: an unknown frame or target type.
        """
        super().__init__(uas)
        get = uas.params.get
        frame_id = get("landing_target/frame_id", "landing_target_1")
        self._number = int(frame_id[-1]) if frame_id[-1:].isdecimal() else 0
        self._frame = mav_frame(uas, "landing_target/mav_frame", "LOCAL_NED")
        self._type = _type(get("landing_target/land_target_type", "VISION_FIDUCIAL"))
        self._size = get("landing_target/target_size/x", 1.0), get("landing_target/target_size/y", 1.0)
        self._pose_in = uas.topic("landing_target/pose_in", PoseStamped())
        self._marker = uas.topic("landing_target/lt_marker", Vector3Stamped())
        self._pose_in.message.header.frame_id = frame_id
        self._marker.message.vector.x, self._marker.message.vector.y = self._size
        self._tf = None
        topics = [self._pose_in, self._marker]
        if get("landing_target/tf/send", True):
            child = get("landing_target/tf/child_frame_id", "camera_center")
            self._tf = uas.topic("/tf", TFMessage([TransformStamped(child_frame_id=child)]))
        self.messages = {"LANDING_TARGET": Feed(self._on_target, *topics)}
        if get("landing_target/listen_lt", False):
            row = In("landing_target/raw", LandingTarget, "LANDING_TARGET", _raw)
        else:
            row = In("landing_target/pose", PoseStamped, "LANDING_TARGET", self._fields)
        uas.subscribe(row.topic, row.kind, lambda m: row.forward(uas, m))

    def _fields(self, stamped: Any) -> dict[str, Any]:
        place = _pose(stamped.pose)
        distance = math.hypot(place["x"], place["y"], place["z"])
        return {
            **place,
            "target_num": self._number,
            "frame": self._frame,
            "distance": distance,
            "angle_x": math.atan2(place["x"], abs(place["z"])),
            "angle_y": math.atan2(place["y"], abs(place["z"])),
            "size_x": 2.0 * math.atan2(self._size[0], 2.0 * distance),
            "size_y": 2.0 * math.atan2(self._size[1], 2.0 * distance),
            "type": self._type,
        }

    def _on_target(self, target: Any) -> None:
        uas, message = self.uas, self._pose_in.message
        uas.stamp_us(message.header, target.time_usec)
        place, turn = message.pose.position, message.pose.orientation
        place.x, place.y, place.z = frames.ned_to_enu(target.x, target.y, target.z)
        turn.w, turn.x, turn.y, turn.z = frames.attitude_ned_to_enu(*target.q)
        if self._pose_in.needed:
            self._pose_in.publish(message)
        if self._marker.needed:
            uas.stamp_us(self._marker.message.header, target.time_usec)
            self._marker.publish(self._marker.message)
        if self._tf is not None and self._tf.needed:
            [transform] = self._tf.message.transforms
            uas.stamp_us(transform.header, target.time_usec)
            transform.header.frame_id = f"landing_target_{target.target_num}"
            transform.transform.rotation = turn
            to = transform.transform.translation
            to.x, to.y, to.z = place.x, place.y, place.z
            self._tf.publish(self._tf.message)


def _type(name: str) -> int:
    if name not in _TYPES:
        raise ValueError(f"landing_target/land_target_type: {name!r} is not allowed; {', '.join(_TYPES)} are")
    return _TYPES[name]


def _pose(pose: Any) -> dict[str, Any]:
    """Convert an ENU pose to the position fields of LANDING_TARGET."""
    q = pose.orientation
    ned: Sequence[float] = frames.enu_to_ned(pose.position.x, pose.position.y, pose.position.z)
    return {
        **dict(zip("xyz", ned, strict=True)),
        "q": list(frames.attitude_enu_to_ned(q.w, q.x, q.y, q.z)),
        "position_valid": _VALID,
    }


def _raw(target: Any) -> dict[str, Any]:
    angles = {"angle_x": target.angle[0], "angle_y": target.angle[1]}
    return {**_pose(target.pose), **angles, "size_x": target.size[0], "size_y": target.size[1]}
