"""Setpoints with MAVLink's type masks and frames, and the autopilot's current targets."""

from __future__ import annotations

from collections.abc import Sequence
from math import inf
from typing import Any

from mavros_msgs.msg import AttitudeTarget, GlobalPositionTarget, PositionTarget

from xtdrone_common import frames
from xtdrone_mavros.feeds import Feed
from xtdrone_mavros.lib.setpoint_messages import (
    attitude_target,
    certainly_finite,
    global_target,
    position_target,
    set_xyz,
    vector_fields,
    xyz,
)
from xtdrone_mavros.uas import Plugin, Uas

_LOCAL = "setpoint_raw/local"
_UNSET_FRAME = 0
_LOCAL_FRAMES = (  # LOCAL_OFFSET_NED is not among them: the autopilot rejects it, as PX4 does
    PositionTarget.FRAME_LOCAL_NED,
    PositionTarget.FRAME_BODY_NED,
    PositionTarget.FRAME_BODY_OFFSET_NED,
)
_GLOBAL_FRAMES = (
    GlobalPositionTarget.FRAME_GLOBAL_INT,
    GlobalPositionTarget.FRAME_GLOBAL_REL_ALT,
    GlobalPositionTarget.FRAME_GLOBAL_TERRAIN_ALT,
)
_POSITION = ("position.x", "position.y", "position.z")
_PLACE = ("latitude", "longitude", "altitude")
_OTHER_FIELDS = (
    *(f"{name}.{axis}" for name in ("velocity", "acceleration_or_force") for axis in "xyz"),
    "yaw",
    "yaw_rate",
)
_MASK_BITS = (*range(9), 10, 11)  # of the position and the other fields


class SetpointRawPlugin(Plugin):
    """MAVROS's setpoint_raw: local, global and attitude in; target_local, target_global and target_attitude out.

    Altitudes of ``global`` and ``target_global`` are the autopilot's: above mean sea level, or above the reference of
    ``coordinate_frame``. A ``local`` target whose ``coordinate_frame`` was left unset (0) counts as LOCAL_NED, with one
    warning: MAVROS converts it the same way, and PX4 v1.11 ignored the frame of a position. Thrust is multiplied by
    ``setpoint_raw/thrust_scaling`` and limited to 0..1.
    """

    name = "setpoint_raw"

    def __init__(self, uas: Uas) -> None:
        """Subscribe and advertise.

        Raises:
            ValueError: a thrust scaling that is negative or not finite.
        """
        super().__init__(uas)
        self._thrust_scaling = uas.params.get("setpoint_raw/thrust_scaling", 1.0)
        if not 0.0 <= self._thrust_scaling < inf:
            raise ValueError(f"setpoint_raw/thrust_scaling: {self._thrust_scaling} is not allowed; 0 or more is")
        self._target_local = uas.topic("setpoint_raw/target_local", PositionTarget())
        self._target_global = uas.topic("setpoint_raw/target_global", GlobalPositionTarget())
        self._target_attitude = uas.topic("setpoint_raw/target_attitude", AttitudeTarget())
        self.messages = {
            "POSITION_TARGET_LOCAL_NED": Feed(self._on_target_local, self._target_local),
            "POSITION_TARGET_GLOBAL_INT": Feed(self._on_target_global, self._target_global),
            "ATTITUDE_TARGET": Feed(self._on_target_attitude, self._target_attitude),
        }
        self._frame_was_unset = False
        uas.subscribe_setpoint(_LOCAL, PositionTarget, self._local)
        uas.subscribe("setpoint_raw/global", GlobalPositionTarget, self._global)
        uas.subscribe("setpoint_raw/attitude", AttitudeTarget, self._attitude)

    def _local(self, target: PositionTarget) -> None:
        if target.coordinate_frame == _UNSET_FRAME:
            self._use_local_frame(target)
        place = xyz(target.position)
        if not self._accepts(_LOCAL, target, _LOCAL_FRAMES, _POSITION, place):
            return
        self.uas.link.send(
            position_target(
                self.uas,
                self.uas.boot_ms(target.header),
                target.coordinate_frame,
                target.type_mask,
                place,
                xyz(target.velocity),
                xyz(target.acceleration_or_force),
                target.yaw,
                target.yaw_rate,
            )
        )

    def _use_local_frame(self, target: PositionTarget) -> None:
        """Set the unset frame of a target, with a warning the first time."""
        target.coordinate_frame = PositionTarget.FRAME_LOCAL_NED
        if not self._frame_was_unset:
            self._frame_was_unset = True
            text = "%s: coordinate_frame is 0, unset; it counts as %d (LOCAL_NED) from now on"
            self.uas.warn(f"{_LOCAL} frame", text, _LOCAL, PositionTarget.FRAME_LOCAL_NED)

    def _global(self, target: GlobalPositionTarget) -> None:
        place = target.latitude, target.longitude, target.altitude
        if not self._accepts("setpoint_raw/global", target, _GLOBAL_FRAMES, _PLACE, place):
            return
        self.uas.link.send(
            global_target(
                self.uas,
                self.uas.boot_ms(target.header),
                target.coordinate_frame,
                target.type_mask,
                place,
                xyz(target.velocity),
                xyz(target.acceleration_or_force),
                target.yaw,
                target.yaw_rate,
            )
        )

    def _accepts(
        self, topic: str, target: Any, allowed: Sequence[int], names: Sequence[str], place: frames.Vector
    ) -> bool:
        """Return whether a target's frame is allowed and its unmasked fields are finite; otherwise warn.

        Args:
            topic: name of the topic, for the warning.
            target: the ROS message.
            allowed: its allowed frames.
            names: names of the fields in ``place``.
            place: its position.
        """
        if target.coordinate_frame not in allowed:
            text = "%s: coordinate_frame %d is not allowed, %s are; the setpoint is not forwarded"
            self.uas.warn(topic, text, topic, target.coordinate_frame, allowed)
            return False
        numbers = *place, *xyz(target.velocity), *xyz(target.acceleration_or_force), target.yaw, target.yaw_rate
        if certainly_finite(numbers):
            return True
        fields = zip((*names, *_OTHER_FIELDS), numbers, _MASK_BITS, strict=True)
        return self.uas.finite(topic, [(name, n) for name, n, bit in fields if not target.type_mask >> bit & 1])

    def _attitude(self, target: AttitudeTarget) -> None:
        mask, q = target.type_mask, target.orientation
        fields = []
        if not mask & AttitudeTarget.IGNORE_ATTITUDE:
            fields += vector_fields("orientation", q, "xyzw")
        for axis, bit in (
            ("x", AttitudeTarget.IGNORE_ROLL_RATE),
            ("y", AttitudeTarget.IGNORE_PITCH_RATE),
            ("z", AttitudeTarget.IGNORE_YAW_RATE),
        ):
            if not mask & bit:
                fields += vector_fields("body_rate", target.body_rate, axis)
        if not mask & AttitudeTarget.IGNORE_THRUST:
            fields.append(("thrust", target.thrust))
        if not self.uas.finite("setpoint_raw/attitude", fields):
            return
        thrust = min(1.0, max(0.0, target.thrust * self._thrust_scaling))
        time_boot_ms = self.uas.boot_ms(target.header)
        attitude = q.w, q.x, q.y, q.z
        self.uas.link.send(attitude_target(self.uas, time_boot_ms, mask, thrust, attitude, xyz(target.body_rate)))

    def _on_target_local(self, target: Any) -> None:
        message = self._target_local.message
        self._fill(message, target)
        set_xyz(message.position, frames.ned_to_enu(target.x, target.y, target.z))
        self._target_local.publish(message)

    def _on_target_global(self, target: Any) -> None:
        message = self._target_global.message
        self._fill(message, target)
        message.latitude, message.longitude = target.lat_int / 1e7, target.lon_int / 1e7
        message.altitude = target.alt
        self._target_global.publish(message)

    def _fill(self, message: Any, target: Any) -> None:
        """Fill in the fields common to local and global targets."""
        self.uas.stamp(message.header, target.time_boot_ms)
        message.coordinate_frame = target.coordinate_frame
        message.type_mask = target.type_mask
        set_xyz(message.velocity, frames.ned_to_enu(target.vx, target.vy, target.vz))
        set_xyz(message.acceleration_or_force, frames.ned_to_enu(target.afx, target.afy, target.afz))
        # An uncontrolled yaw is NaN.
        message.yaw = frames.yaw_ned_to_enu(target.yaw) if target.yaw == target.yaw else target.yaw
        message.yaw_rate = -target.yaw_rate

    def _on_target_attitude(self, target: Any) -> None:
        message = self._target_attitude.message
        self.uas.stamp(message.header, target.time_boot_ms)
        message.type_mask = target.type_mask
        q = message.orientation
        q.w, q.x, q.y, q.z = frames.attitude_ned_to_enu(*target.q)
        rates = target.body_roll_rate, target.body_pitch_rate, target.body_yaw_rate
        set_xyz(message.body_rate, frames.frd_to_flu(*rates))
        message.thrust = target.thrust
        self._target_attitude.publish(message)
