"""Missions, geofences and rally points: services that transfer them, and topics with the autopilot's lists."""

from __future__ import annotations

import logging
from typing import Any, ClassVar

from mavros_msgs.msg import WaypointList, WaypointReached
from mavros_msgs.srv import (
    WaypointClear,
    WaypointClearResponse,
    WaypointPull,
    WaypointPullResponse,
    WaypointPush,
    WaypointPushResponse,
    WaypointSetCurrent,
    WaypointSetCurrentResponse,
)

from xtdrone_mavros.feeds import Feed
from xtdrone_mavros.link.first_pulls import FirstPull
from xtdrone_mavros.link.plan_transfers import MISSION
from xtdrone_mavros.uas import Plugin, Uas

log = logging.getLogger("rosout.mavros")

_PUBLISH_PERIOD = 0.1  # s of ROS time between checks for a changed list


class PlanPlugin(Plugin):
    """Base class of the three plugins.

    The main thread publishes the list, in the order of simulated time; services only store it. As in MAVROS, the list
    is fetched 15 s after the connection and published, even if it is empty; ``pull`` fetches one that another program
    has uploaded since.
    """

    kind: ClassVar[int]
    space: ClassVar[str]

    def __init__(self, uas: Uas) -> None:
        """Advertise topic and services."""
        super().__init__(uas)
        self._list = uas.topic(f"{self.space}/waypoints", WaypointList(), latch=True)
        self._changed = False
        self._waypoints: list[Any] = []
        self._current = 0
        self.replies = dict(uas.plans.replies)
        self._first_pull = pull = FirstPull(self.kind, uas.plans, uas.link.send, uas.target, self._end_first_pull)
        self.messages = {
            "MISSION_COUNT": Feed(lambda m: pull.on_count(m, uas.now_ns), pull),
            "MISSION_ITEM_INT": Feed(lambda m: pull.on_item(m, uas.now_ns), pull),
            "MISSION_ACK": Feed(pull.on_ack, pull),
        }
        uas.service(f"{self.space}/push", WaypointPush, self._push)
        uas.service(f"{self.space}/pull", WaypointPull, self._pull)
        uas.service(f"{self.space}/clear", WaypointClear, self._clear)
        uas.timer(_PUBLISH_PERIOD, self._tend)

    def connected(self, connected: bool) -> None:
        """Fetch the list after the connection."""
        if connected:
            self._first_pull.schedule(self.uas.now_ns)
        else:
            self._first_pull.cancel()

    def _tend(self) -> None:
        was_needed = self._first_pull.needed
        self._first_pull.tend(self.uas.now_ns)
        if self._first_pull.needed and not was_needed:
            self.uas.refresh()  # so that the answers are handled
        self._publish()

    def _end_first_pull(self, found: list[Any] | None) -> None:
        self.uas.refresh()
        if found is None:
            log.warning("%s: the autopilot does not send the list of %s/waypoints", self.uas.name, self.space)
        else:
            self._keep(found)

    def _push(self, request: Any) -> WaypointPushResponse:
        if request.start_index:
            log.warning("%s: %s/push: start_index %d: PX4 accepts only complete lists", self.uas.name, self.space,
                        request.start_index)  # fmt: skip
            return WaypointPushResponse(success=False, wp_transfered=0)
        success, transferred = self.uas.plans.push(self.kind, request.waypoints)
        if success:
            self._keep(request.waypoints)
        else:
            total = len(request.waypoints)
            log.warning("%s: %s/push: %d of %d items sent, rejected", self.uas.name, self.space, transferred, total)
        return WaypointPushResponse(success=success, wp_transfered=transferred)

    def _pull(self, _: Any) -> WaypointPullResponse:
        found = self.uas.plans.pull(self.kind)
        if found is None:
            log.warning("%s: %s/pull: the autopilot does not answer", self.uas.name, self.space)
            return WaypointPullResponse(success=False, wp_received=0)
        self._keep(found)
        return WaypointPullResponse(success=True, wp_received=len(found))

    def _clear(self, _: Any) -> WaypointClearResponse:
        success = self.uas.plans.clear(self.kind)
        if success:
            self._keep([])
        return WaypointClearResponse(success=success)

    def _keep(self, waypoints: Any) -> None:
        self._waypoints = list(waypoints)
        self._changed = True

    def _publish(self) -> None:
        if not self._changed:
            return
        self._changed = False
        message = self._list.message
        message.waypoints = self._waypoints
        message.current_seq = self._current
        if self.kind == MISSION:
            for i, waypoint in enumerate(message.waypoints):
                waypoint.is_current = i == self._current
        self._list.publish(message)


class WaypointPlugin(PlanPlugin):
    """MAVROS's waypoint."""

    name = "waypoint"
    kind = MISSION
    space = "mission"

    def __init__(self, uas: Uas) -> None:
        """Advertise the additional topics and services of missions."""
        super().__init__(uas)
        self._reached = uas.topic("mission/reached", WaypointReached(), latch=True)
        self.messages |= {
            "MISSION_CURRENT": Feed(self._on_current, always=True),
            "MISSION_ITEM_REACHED": Feed(self._on_reached, always=True),
        }
        uas.service("mission/set_current", WaypointSetCurrent, self._set_current)

    def _on_current(self, message: Any) -> None:
        if message.seq != self._current:
            self._current = message.seq
            self._changed = bool(self._waypoints)

    def _on_reached(self, message: Any) -> None:
        reached = self._reached.message
        self.uas.stamp_now(reached.header)
        reached.wp_seq = message.seq
        self._reached.publish(reached)

    def _set_current(self, request: Any) -> WaypointSetCurrentResponse:
        return WaypointSetCurrentResponse(success=self.uas.plans.set_current(request.wp_seq))


class GeofencePlugin(PlanPlugin):
    """MAVROS's geofence."""

    name = "geofence"
    kind = 1
    space = "geofence"


class RallypointPlugin(PlanPlugin):
    """MAVROS's rallypoint."""

    name = "rallypoint"
    kind = 2
    space = "rallypoint"
