"""The mission protocol: there is no mission, and none can be loaded."""

from __future__ import annotations

from typing import Any, ClassVar

from pymavlink.dialects.v20 import common as mavlink

from xtdrone_control.autopilot.commander import CRITICAL
from xtdrone_control.mavlink.link import Link
from xtdrone_control.mavlink.service import Service

_MISSION_ACCEPTED, _MISSION_ERROR, _MISSION_UNSUPPORTED = 0, 1, 3  # MAV_MISSION_RESULT


class MissionService(Service):
    """Answers that the mission is empty."""

    MESSAGES: ClassVar[dict[str, str]] = {
        "MISSION_REQUEST_LIST": "_mission_request_list",
        "MISSION_COUNT": "_mission_count",
        "MISSION_ITEM": "_mission_item",
        "MISSION_ITEM_INT": "_mission_item",
        "MISSION_CLEAR_ALL": "_mission_clear_all",
    }

    def _mission_request_list(self, link: Link, m: Any) -> None:
        link.send_message(mavlink.MAVLink_mission_count_message(*link.sender, 0, m.mission_type))

    def _mission_count(self, link: Link, m: Any) -> None:
        result = _MISSION_ACCEPTED
        if m.count:
            self.vehicle.commander.say(CRITICAL, "Missions are not supported")
            result = _MISSION_UNSUPPORTED
        self._acknowledge_mission(link, result, m.mission_type)

    def _mission_item(self, link: Link, m: Any) -> None:
        self._acknowledge_mission(link, _MISSION_ERROR, m.mission_type)

    def _mission_clear_all(self, link: Link, m: Any) -> None:
        self._acknowledge_mission(link, _MISSION_ACCEPTED, m.mission_type)

    def _acknowledge_mission(self, link: Link, result: int, kind: int) -> None:
        link.send_message(mavlink.MAVLink_mission_ack_message(*link.sender, result, kind))
