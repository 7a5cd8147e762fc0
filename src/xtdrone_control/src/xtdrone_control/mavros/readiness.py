"""What keeps a vehicle from arming and from OFFBOARD, for the service ``~get_readiness`` of the MAVROS node."""

from __future__ import annotations

from pymavlink.dialects.v20 import common as mavlink
from xtdrone_msgs.msg import FailingCheck, VehicleReadiness

from xtdrone_control.autopilot import modes
from xtdrone_control.autopilot.events.events import ERROR
from xtdrone_control.mavros.uas import Uas


def readiness(uas: Uas) -> VehicleReadiness:
    """Return the state of a vehicle and its failing checks; may be called in any thread."""
    heartbeat, refusals, link = uas.heartbeat, uas.refusals, uas.link
    message = VehicleReadiness(vehicle=uas.name, connected=uas.connected, reported=refusals.reported)
    message.fcu_url = f"udp://:{link.port}@{link.remote[0]}:{link.remote[1]}"
    mode = modes.from_custom_mode(refusals.custom_mode)
    if uas.connected and heartbeat is not None:
        message.armed = bool(heartbeat.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)
        message.mode = mode.name if mode else ""
        message.system_status = heartbeat.system_status
    if uas.arming_held:
        message.checks.append(FailingCheck(text=uas.arming_held, level=ERROR, blocks_arming=True))
    for check in refusals.failing:
        message.checks.append(
            FailingCheck(
                name=check.name,
                text=check.words,
                level=check.level,
                blocks_arming=mode is not None and check.stands_against(mode.state),
                blocks_offboard=check.stands_against(modes.OFFBOARD.state),
            )
        )
    return message
