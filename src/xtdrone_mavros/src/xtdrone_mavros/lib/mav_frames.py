"""The ``mav_frame`` setting of setpoint plugins."""

from __future__ import annotations

from typing import Any

from mavros_msgs.srv import SetMavFrame, SetMavFrameResponse
from pymavlink.dialects.v20 import common as mavlink

from xtdrone_mavros.uas import Uas

# The frames that the autopilot accepts in SET_POSITION_TARGET_LOCAL_NED, by MAVROS's names
_ALLOWED = {
    "LOCAL_NED": mavlink.MAV_FRAME_LOCAL_NED,
    "BODY_NED": mavlink.MAV_FRAME_BODY_NED,
    "BODY_OFFSET_NED": mavlink.MAV_FRAME_BODY_OFFSET_NED,
}
_NAMES = {number: name for name, number in _ALLOWED.items()}

_PREFIX = "MAV_FRAME_"
_BY_NAME = {
    entry.name.removeprefix(_PREFIX): number
    for number, entry in mavlink.enums["MAV_FRAME"].items()
    if not entry.name.endswith("ENUM_END")
}


def mav_frame(uas: Uas, parameter: str, default: str) -> int:
    """Return the MAV_FRAME named by a parameter, e.g. ``LOCAL_NED``.

    Raises:
        ValueError: the name is unknown.
    """
    name = uas.params.get(parameter, default)
    if name not in _BY_NAME:
        raise ValueError(f"{parameter}: {name!r} is not a MAVLink frame; {', '.join(_BY_NAME)} are")
    return _BY_NAME[name]


class MavFrame:
    """A plugin's frame: read from ``<plugin>/mav_frame``, changed by the service of the same name.

    The service also updates the parameter.

    Attributes:
        value: MAV_FRAME number.
    """

    def __init__(self, uas: Uas, plugin: str) -> None:
        """Read the setting and offer the service.

        Raises:
            ValueError: the frame is not allowed.
        """
        name = uas.params.get(f"{plugin}/mav_frame", "LOCAL_NED")
        if name not in _ALLOWED:
            raise ValueError(f"{plugin}/mav_frame: {name!r} is not allowed; {', '.join(_ALLOWED)} are")
        self.value = _ALLOWED[name]
        self._uas = uas
        self._plugin = plugin
        uas.service(f"{plugin}/mav_frame", SetMavFrame, self._set)

    def _set(self, request: Any) -> SetMavFrameResponse:
        if request.mav_frame not in _ALLOWED.values():
            self._uas.warn(
                f"{self._plugin}/mav_frame", "%s/mav_frame: %d is not allowed", self._plugin, request.mav_frame
            )
            return SetMavFrameResponse(success=False)
        self.value = request.mav_frame
        self._uas.ros.set_param(f"{self._uas.prefix}/{self._plugin}/mav_frame", _NAMES[self.value])
        return SetMavFrameResponse(success=True)
