"""Set-points with MAVLink's own masks and frames, and the autopilot's current targets."""

from __future__ import annotations

from typing import Any

from mavros_msgs.msg import AttitudeTarget, PositionTarget
from pymavlink.dialects.v20 import common as mavlink

from xtdrone_control import frames
from xtdrone_control.mavros.plugin import Feed, Plugin
from xtdrone_control.mavros.setpoints import position_target
from xtdrone_control.mavros.uas import Uas

_VECTORS = (
    ("position", PositionTarget.IGNORE_PX),
    ("velocity", PositionTarget.IGNORE_VX),
    ("acceleration_or_force", PositionTarget.IGNORE_AFX),
)
_FRAMES = (
    PositionTarget.FRAME_LOCAL_NED,
    PositionTarget.FRAME_LOCAL_OFFSET_NED,
    PositionTarget.FRAME_BODY_NED,
    PositionTarget.FRAME_BODY_OFFSET_NED,
)


class SetpointRawPlugin(Plugin):
    """MAVROS's setpoint_raw: local and attitude in, target_local and target_attitude out."""

    name = "setpoint_raw"

    def __init__(self, uas: Uas) -> None:
        """Subscribe and advertise."""
        super().__init__(uas)
        self._thrust_scaling = uas.params.get("setpoint_raw/thrust_scaling", 1.0)
        self._target_local = uas.topic("setpoint_raw/target_local", PositionTarget())
        self._target_attitude = uas.topic("setpoint_raw/target_attitude", AttitudeTarget())
        self.messages = {
            "POSITION_TARGET_LOCAL_NED": Feed(self._on_target_local, self._target_local),
            "ATTITUDE_TARGET": Feed(self._on_target_attitude, self._target_attitude),
        }
        uas.subscribe("setpoint_raw/local", PositionTarget, self._local)
        uas.subscribe("setpoint_raw/attitude", AttitudeTarget, self._attitude)

    def _local(self, target: PositionTarget) -> None:
        if target.coordinate_frame not in _FRAMES:
            self.uas.warn(
                "setpoint_raw/local",
                "setpoint_raw/local: coordinate_frame %d is not allowed, %s are; the set-point is not forwarded",
                target.coordinate_frame,
                _FRAMES,
            )
            return
        if not self.uas.finite("setpoint_raw/local", _used_fields(target)):
            return
        p, v, a = target.position, target.velocity, target.acceleration_or_force
        self.uas.link.send(
            position_target(
                self.uas,
                self.uas.boot_ms(target.header),
                target.coordinate_frame,
                target.type_mask,
                (p.x, p.y, p.z),
                (v.x, v.y, v.z),
                (a.x, a.y, a.z),
                target.yaw,
                target.yaw_rate,
            )
        )

    def _attitude(self, target: AttitudeTarget) -> None:
        mask, q, rate = target.type_mask, target.orientation, target.body_rate
        fields = []
        if not mask & AttitudeTarget.IGNORE_ATTITUDE:
            fields += [(f"orientation.{axis}", getattr(q, axis)) for axis in "xyzw"]
        for axis, bit in (
            ("x", AttitudeTarget.IGNORE_ROLL_RATE),
            ("y", AttitudeTarget.IGNORE_PITCH_RATE),
            ("z", AttitudeTarget.IGNORE_YAW_RATE),
        ):
            if not mask & bit:
                fields.append((f"body_rate.{axis}", getattr(rate, axis)))
        if not mask & AttitudeTarget.IGNORE_THRUST:
            fields.append(("thrust", target.thrust))
        if not self.uas.finite("setpoint_raw/attitude", fields):
            return
        system, component = self.uas.target
        thrust = min(1.0, max(0.0, target.thrust * self._thrust_scaling))
        self.uas.link.send(
            mavlink.MAVLink_set_attitude_target_message(
                self.uas.boot_ms(target.header),
                system,
                component,
                mask,
                list(frames.attitude_enu_to_ned(q.w, q.x, q.y, q.z)),
                *frames.flu_to_frd(rate.x, rate.y, rate.z),
                thrust,
            )
        )

    def _on_target_local(self, target: Any) -> None:
        message = self._target_local.message
        self.uas.stamp(message.header, target.time_boot_ms)
        message.coordinate_frame = target.coordinate_frame
        message.type_mask = target.type_mask
        _set(message.position, frames.ned_to_enu(target.x, target.y, target.z))
        _set(message.velocity, frames.ned_to_enu(target.vx, target.vy, target.vz))
        _set(message.acceleration_or_force, frames.ned_to_enu(target.afx, target.afy, target.afz))
        # A yaw that is not controlled is NaN.
        message.yaw = frames.yaw_ned_to_enu(target.yaw) if target.yaw == target.yaw else target.yaw
        message.yaw_rate = -target.yaw_rate
        self._target_local.publish(message)

    def _on_target_attitude(self, target: Any) -> None:
        message = self._target_attitude.message
        self.uas.stamp(message.header, target.time_boot_ms)
        message.type_mask = target.type_mask
        q = message.orientation
        q.w, q.x, q.y, q.z = frames.attitude_ned_to_enu(*target.q)
        rates = target.body_roll_rate, target.body_pitch_rate, target.body_yaw_rate
        _set(message.body_rate, frames.frd_to_flu(*rates))
        message.thrust = target.thrust
        self._target_attitude.publish(message)


def _used_fields(target: PositionTarget) -> list[tuple[str, float]]:
    """Return (field, value) of what ``target`` does not mask out."""
    mask = target.type_mask
    fields = []
    for name, first_bit in _VECTORS:
        vector = getattr(target, name)
        for axis, bit in zip("xyz", (first_bit, first_bit << 1, first_bit << 2), strict=True):
            if not mask & bit:
                fields.append((f"{name}.{axis}", getattr(vector, axis)))
    if not mask & PositionTarget.IGNORE_YAW:
        fields.append(("yaw", target.yaw))
    if not mask & PositionTarget.IGNORE_YAW_RATE:
        fields.append(("yaw_rate", target.yaw_rate))
    return fields


def _set(message: Any, vector: frames.Vector) -> None:
    message.x, message.y, message.z = vector
