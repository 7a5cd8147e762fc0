"""Gimbal: commanded and measured orientation."""

from __future__ import annotations

import math
from typing import Any

from geometry_msgs.msg import Quaternion, Vector3Stamped
from mavros_msgs.msg import MountControl
from mavros_msgs.srv import MountConfigure, MountConfigureResponse
from pymavlink.dialects.v20 import common as mavlink

from xtdrone_common import frames
from xtdrone_mavros.feeds import Feed
from xtdrone_mavros.uas import Plugin, Uas

_CONFIGURE, _CONTROL = mavlink.MAV_CMD_DO_MOUNT_CONFIGURE, mavlink.MAV_CMD_DO_MOUNT_CONTROL
_FIELDS = ("pitch", "roll", "yaw", "altitude", "latitude", "longitude")  # of MountControl, as DO_MOUNT_CONTROL has them


class MountControlPlugin(Plugin):
    """MAVROS's mount_control.

    Angles of ``command`` and ``orientation`` are degrees in MAVLink's axes: pitch positive up, yaw positive to the
    right of the heading; ``mount_control/negate_measured_roll`` (and pitch, yaw) negates a measured angle. ``status``
    is advertised but never published, because MAVROS fills it from an ArduPilot message.
    """

    name = "mount_control"

    def __init__(self, uas: Uas) -> None:
        """Advertise, subscribe and offer the service."""
        super().__init__(uas)
        self._orientation = uas.topic("mount_control/orientation", Quaternion())
        self._signs = [
            -1.0 if uas.params.get(f"mount_control/negate_measured_{axis}", False) else 1.0
            for axis in ("roll", "pitch", "yaw")
        ]
        uas.topic("mount_control/status", Vector3Stamped())
        self.messages = {"MOUNT_ORIENTATION": Feed(self._on_orientation, self._orientation)}
        uas.subscribe("mount_control/command", MountControl, self._command)
        uas.service("mount_control/configure", MountConfigure, self._configure)

    def _on_orientation(self, mount: Any) -> None:
        measured = zip(self._signs, (mount.roll, mount.pitch, mount.yaw), strict=True)
        angles = (math.radians(sign * angle) for sign, angle in measured)
        q = self._orientation.message
        q.w, q.x, q.y, q.z = frames.quaternion_from_rpy(*angles)
        self._orientation.publish(q)

    def _command(self, command: Any) -> None:
        values = [getattr(command, field) for field in _FIELDS]
        if self.uas.finite("mount_control/command", zip(_FIELDS, values, strict=True)):
            self.uas.link.send(
                mavlink.MAVLink_command_long_message(*self.uas.target, _CONTROL, 0, *values, float(command.mode))
            )

    def _configure(self, request: Any) -> MountConfigureResponse:
        values = (
            request.mode,
            request.stabilize_roll,
            request.stabilize_pitch,
            request.stabilize_yaw,
            request.roll_input,
            request.pitch_input,
            request.yaw_input,
        )
        result = self.uas.commands.call(
            _CONFIGURE,
            lambda attempt: mavlink.MAVLink_command_long_message(
                *self.uas.target, _CONFIGURE, attempt, *map(float, values)
            ),
        )
        if result is None:
            self.uas.warn("mount", "mount_control/configure: the autopilot has not answered; is there a gimbal?")
            return MountConfigureResponse(False, mavlink.MAV_RESULT_FAILED)
        return MountConfigureResponse(result == mavlink.MAV_RESULT_ACCEPTED, result)
