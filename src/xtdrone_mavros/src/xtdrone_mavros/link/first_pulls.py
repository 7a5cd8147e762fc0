"""The transfer of a list that MAVROS starts by itself after a connection (mission_protocol_base.h, scheduled_pull_cb).

It runs in the main thread and in ROS time, so that a flight in lockstep is repeated exactly: the timer starts it, and
the autopilot's messages carry it on.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from mavros_msgs.msg import Waypoint
from pymavlink.dialects.v20 import common as mavlink

from xtdrone_mavros.link.plan_transfers import RETRIES, PlanTransfers, to_waypoint

BOOT_TIME_NS = 15_000_000_000  # from the connection to the transfer, MAVROS's BOOTUP_TIME
_TRY_TIME_NS = 1_000_000_000  # timeout of an answer, MAVROS's WP_TIMEOUT


class FirstPull:
    """The transfer of one list of one autopilot. It is a ``Need`` of the messages that answer it.

    Attributes:
        needed: whether it is running.
    """

    def __init__(
        self,
        kind: int,
        transfers: PlanTransfers,
        send: Callable[[Any], None],
        target: tuple[int, int],
        on_end: Callable[[list[Waypoint] | None], None],
    ) -> None:
        """Prepare the transfer.

        Args:
            kind: MAV_MISSION_TYPE of the list.
            transfers: those of the services; both do not run at the same time.
            send: sends a message.
            target: the autopilot's system and component id.
            on_end: called with the list, or with None if the autopilot does not send it.
        """
        self.needed = False
        self._kind = kind
        self._transfers = transfers
        self._send = send
        self._target = target
        self._on_end = on_end
        self._next_ns: int | None = None  # ROS time of the start, or of the next attempt
        self._tries = 0
        self._count: int | None = None
        self._found: list[Waypoint] = []

    def refresh(self) -> None:
        """Do nothing: ``needed`` is always up to date."""

    def schedule(self, now_ns: int) -> None:
        """Start the transfer 15 s of ROS time from now; one that is running ends."""
        self.cancel()
        self._next_ns = now_ns + BOOT_TIME_NS

    def cancel(self) -> None:
        """End the transfer without a result."""
        self._next_ns = None
        if self.needed:
            self.needed = False
            self._transfers.release()

    def tend(self, now_ns: int) -> None:
        """Start the transfer when it is due and no service transfers a list, or repeat an unanswered request."""
        if self._next_ns is None or now_ns < self._next_ns:
            return
        if self.needed:
            self._ask_again(now_ns)
        elif self._transfers.claim():
            self.needed = True
            self._count, self._found = None, []
            self._ask_next(now_ns)

    def on_count(self, message: Any, now_ns: int) -> None:
        """Handle MISSION_COUNT."""
        if self.needed and message.mission_type == self._kind and self._count is None:
            self._count = message.count
            self._ask_next(now_ns)

    def on_item(self, message: Any, now_ns: int) -> None:
        """Handle MISSION_ITEM_INT."""
        if self.needed and message.mission_type == self._kind and message.seq == len(self._found):
            self._found.append(to_waypoint(message))
            self._ask_next(now_ns)

    def on_ack(self, message: Any) -> None:
        """Handle MISSION_ACK, by which the autopilot refuses the list."""
        if self.needed and message.mission_type == self._kind and message.type != mavlink.MAV_MISSION_ACCEPTED:
            self._end(None)

    def _ask_next(self, now_ns: int) -> None:
        self._tries = 0
        if self._count is not None and len(self._found) >= self._count:
            self._send(mavlink.MAVLink_mission_ack_message(*self._target, mavlink.MAV_MISSION_ACCEPTED, self._kind))
            self._end(self._found)
        else:
            self._ask(now_ns)

    def _ask_again(self, now_ns: int) -> None:
        if self._tries > RETRIES:
            self._end(None)
        else:
            self._ask(now_ns)

    def _ask(self, now_ns: int) -> None:
        self._tries += 1
        self._next_ns = now_ns + _TRY_TIME_NS
        if self._count is None:
            self._send(mavlink.MAVLink_mission_request_list_message(*self._target, self._kind))
        else:
            self._send(mavlink.MAVLink_mission_request_int_message(*self._target, len(self._found), self._kind))

    def _end(self, found: list[Waypoint] | None) -> None:
        self.cancel()
        self._on_end(found)
