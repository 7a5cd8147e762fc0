"""Messages of gimbal protocol v2.

Commands are in ``command_execution``, streams in ``streams.device_telemetry``.
"""

from __future__ import annotations

import math
from typing import Any, ClassVar

from pymavlink.dialects.v20 import common as mavlink

from xtdrone_autopilot.mavlink.client_link import Link
from xtdrone_autopilot.mavlink.service_base import Service, Vehicle
from xtdrone_autopilot.mavlink.streams.device_telemetry import GIMBAL_CAPABILITIES, GIMBAL_DEVICE, GIMBAL_RANGE
from xtdrone_autopilot.navigator.gimbal_manager import GimbalManager
from xtdrone_common import frames

_DEVICES = (0, GIMBAL_DEVICE)  # 0: all


class GimbalService(Service):
    """Applies setpoints of the system with primary control, and sends the device information."""

    MESSAGES: ClassVar[dict[str, str]] = {
        "GIMBAL_MANAGER_SET_ATTITUDE": "_set_attitude",
        "GIMBAL_MANAGER_SET_PITCHYAW": "_set_pitch_yaw",
    }

    def __init__(self, vehicle: Vehicle) -> None:
        """Register the service with ``vehicle``."""
        super().__init__(vehicle)
        self._payload = vehicle.commander.navigator.payload
        vehicle.on_request[mavlink.MAVLINK_MSG_ID_GIMBAL_DEVICE_INFORMATION] = self._send_device_information

    def _manager(self, link: Link, m: Any) -> GimbalManager | None:
        """Return the gimbal manager if the sender has control of the gimbal."""
        manager = self._payload.gimbal_manager
        if self._payload.gimbal_attitude is None or m.gimbal_device_id not in _DEVICES:
            return None
        return manager if manager.controlled_by(link.sender) else None

    def _set_attitude(self, link: Link, m: Any) -> None:
        manager = self._manager(link, m)
        if manager is None:
            return
        nan = (math.nan,) * 3
        norm = math.sqrt(sum(value * value for value in m.q))  # NaN: only the rates are used
        angles = frames.rpy_from_quaternion(tuple(value / norm for value in m.q)) if 0.0 < norm < math.inf else nan
        rates = (m.angular_velocity_y, m.angular_velocity_z)
        self.vehicle.call_or_queue(lambda: manager.look(angles, m.flags, rates))

    def _set_pitch_yaw(self, link: Link, m: Any) -> None:
        manager = self._manager(link, m)
        if manager is not None:
            angles = (0.0, m.pitch, m.yaw)
            self.vehicle.call_or_queue(lambda: manager.look(angles, m.flags, (m.pitch_rate, m.yaw_rate)))

    def _send_device_information(self, link: Link) -> bool:
        if self._payload.gimbal_attitude is None:
            return False
        name = self.vehicle.commander.vehicle.type.encode("ascii", "replace")[:32]
        time_ms = self.vehicle.now_us // 1000
        message = mavlink.MAVLink_gimbal_device_information_message(
            time_ms, b"XTDrone", name, b"", 0, 0, 0, GIMBAL_CAPABILITIES & 0xFFFF, 0, *GIMBAL_RANGE, GIMBAL_DEVICE
        )
        link.send_message(message)
        return True
