"""Mission protocol for missions, geofences and rally points, with the behaviour and quirks of PX4 v1.14.

Sources: https://mavlink.io/en/services/mission.html, PX4 ``MavlinkMissionManager``. Each client has a separate
transfer; only one client uploads at a time.
"""

from __future__ import annotations

import enum
from collections.abc import Sequence
from typing import Any, ClassVar

from pymavlink.dialects.v20 import common as mavlink

from xtdrone_autopilot.commander.commander import CRITICAL, INFO
from xtdrone_autopilot.events.events import ERROR, WARNING
from xtdrone_autopilot.mavlink.client_link import Link
from xtdrone_autopilot.mavlink.microservices import mission_items
from xtdrone_autopilot.mavlink.service_base import NEVER_US, Service, Vehicle
from xtdrone_autopilot.navigator import geofence, plan
from xtdrone_autopilot.navigator.plan import PlanItem

_RETRY_US = 250_000  # until an item is requested again
_TIMEOUT_US = 5_000_000  # silence of the partner that ends a transfer
_TRANSFER_PERIOD_US = 20_000  # between two checks of transfers: PX4's MAVLink loop turns its 250 ms into about 270
_PROGRESS_US = 100_000  # between two checks of the mission's progress
_REPEAT_US = 1_000_000  # MISSION_CURRENT and, for a while, MISSION_ITEM_REACHED
_REACHED_REPEATS = 10
_ACCEPTED, _ERROR, _NO_SPACE = 0, 1, 4  # MAV_MISSION_RESULT
_UNSUPPORTED, _CANCELLED = 3, 15
_LOCAL_NED = 1  # MAV_FRAME
# commands of geofences and rally points; PX4 rejects them in a mission
_NOT_FOR_MISSIONS = (
    plan.FENCE_INCLUSION,
    plan.FENCE_EXCLUSION,
    plan.FENCE_CIRCLE_INCLUSION,
    plan.FENCE_CIRCLE_EXCLUSION,
    plan.RALLY_POINT,
)
_POLYGONS = (plan.FENCE_INCLUSION, plan.FENCE_EXCLUSION)
_LEAST_VERTICES = 3

Partner = tuple[int, int]


class _State(enum.Enum):
    IDLE = enum.auto()
    UPLOAD = enum.auto()  # from the client to the vehicle
    DOWNLOAD = enum.auto()


class _Transfer:
    """Transfer with one client.

    Attributes:
        state: direction of the transfer, if any.
        kind: MAV_MISSION_TYPE.
        partner: MAVLink system and component id of the client.
        seq: index of the next item.
        count: number of items.
        items: received items.
        current: index of the received item marked as current, -1 for none.
        integers: whether to use MISSION_REQUEST_INT and MISSION_ITEM_INT; PX4 starts with MISSION_REQUEST.
        sent_us, heard_us: simulated time of the last request, and of the last message from the partner, us.
    """

    def __init__(self) -> None:
        self.state = _State.IDLE
        self.kind = plan.MISSION
        self.partner: Partner = (0, 0)
        self.seq = 0
        self.count = 0
        self.items: list[PlanItem] = []
        self.current = -1
        self.integers = False
        self.sent_us = 0
        self.heard_us = 0


class MissionService(Service):
    """Receives and sends plans, and reports the progress of the mission."""

    CAPABILITIES = (
        mavlink.MAV_PROTOCOL_CAPABILITY_MISSION_FLOAT
        | mavlink.MAV_PROTOCOL_CAPABILITY_MISSION_INT
        | mavlink.MAV_PROTOCOL_CAPABILITY_MISSION_FENCE
        | mavlink.MAV_PROTOCOL_CAPABILITY_MISSION_RALLY
    )
    MESSAGES: ClassVar[dict[str, str]] = {
        "MISSION_REQUEST_LIST": "_request_list",
        "MISSION_REQUEST": "_request",
        "MISSION_REQUEST_INT": "_request_int",
        "MISSION_COUNT": "_count",
        "MISSION_ITEM": "_item",
        "MISSION_ITEM_INT": "_item_int",
        "MISSION_ACK": "_ack",
        "MISSION_CLEAR_ALL": "_clear_all",
        "MISSION_SET_CURRENT": "_set_current",
        "LANDING_TARGET": "_landing_target",
    }

    def __init__(self, vehicle: Vehicle) -> None:
        """Register the service with ``vehicle``."""
        super().__init__(vehicle)
        self._navigator = vehicle.commander.navigator
        self._transfers: dict[Link, _Transfer] = {}
        self._uploading: _Transfer | None = None
        self._sent_current = -1
        self._sent_reached = -1
        self._repeats = 0
        self._repeat_us = 0
        self._schedule(0)

    # time

    def update(self, now_us: int) -> None:
        """Repeat requests, time out transfers, and report the progress of the mission."""
        self.due_us = NEVER_US
        self._drop_closed()
        for link, transfer in self._transfers.items():
            if transfer.state is not _State.IDLE:
                self._check(link, transfer, now_us)
        self._send_progress(now_us)
        self._schedule(now_us)

    def _schedule(self, now_us: int) -> None:
        """Set the time of the next ``update``."""
        if any(transfer.state is not _State.IDLE for transfer in self._transfers.values()):
            self.due_us = (now_us // _TRANSFER_PERIOD_US + 1) * _TRANSFER_PERIOD_US
        elif self._navigator.plans.mission or self._navigator.payload.shots:
            self.due_us = (now_us // _PROGRESS_US + 1) * _PROGRESS_US
        else:
            self.due_us = NEVER_US

    def _check(self, link: Link, transfer: _Transfer, now_us: int) -> None:
        if transfer.state is _State.UPLOAD and now_us - transfer.sent_us > _RETRY_US:
            self._request_item(link, transfer)
        elif now_us - transfer.heard_us > _TIMEOUT_US:
            self._announce_error("Operation timeout", "mavlink_mission_op_timeout")
            self._end(transfer)

    def _end(self, transfer: _Transfer) -> None:
        transfer.state = _State.IDLE
        if self._uploading is transfer:
            self._uploading = None

    def _announce_error(self, text: str, name: str) -> None:
        self.vehicle.commander.tell(CRITICAL, text, name, level=ERROR)

    def _transfer(self, link: Link) -> _Transfer:
        transfer = self._transfers.get(link)
        if transfer is None:
            self._drop_closed()
            transfer = self._transfers[link] = _Transfer()
        return transfer

    def _drop_closed(self) -> None:
        """End the transfers of closed links."""
        for link in [link for link in self._transfers if not link.open]:
            self._end(self._transfers.pop(link))

    def _heard(self, transfer: _Transfer) -> None:
        transfer.heard_us = self.vehicle.now_us

    # progress

    def _send_progress(self, now_us: int) -> None:
        mission, plans = self._navigator.mission, self._navigator.plans
        send = self._broadcast
        for shot in self._taken_shots():
            send(mavlink.MAVLink_camera_trigger_message(shot.time_us, shot.number))
        reached, current = mission.reached, plans.current
        if not plans.mission:
            self._sent_current = self._sent_reached = -1
            return
        if reached != self._sent_reached:
            self._sent_reached = reached
            self._repeats = 0
            if reached >= 0:
                send(mavlink.MAVLink_mission_item_reached_message(reached))
        if current != self._sent_current:
            self._sent_current = current
            self._repeat_us = now_us + _REPEAT_US
            send(mavlink.MAVLink_mission_current_message(current))
        elif now_us >= self._repeat_us:
            self._repeat_us = now_us + _REPEAT_US
            send(mavlink.MAVLink_mission_current_message(current))
            if reached >= 0 and self._repeats < _REACHED_REPEATS:
                self._repeats += 1
                send(mavlink.MAVLink_mission_item_reached_message(reached))

    def _broadcast(self, message: Any) -> None:
        for link in self.vehicle.clients():
            link.send_message(message)

    def _taken_shots(self) -> list[Any]:
        shots = self._navigator.payload.shots
        taken = list(shots)
        shots.clear()
        return taken

    # from the vehicle to the client

    def _request_list(self, link: Link, m: Any) -> None:
        transfer = self._transfer(link)
        kind = m.mission_type
        if transfer.state is _State.DOWNLOAD and transfer.seq == transfer.count:
            self._end(transfer)  # its closing acknowledgement was lost
        if transfer.state is _State.UPLOAD or (transfer.state is _State.DOWNLOAD and transfer.kind != kind):
            text = "Mission download request ignored, already active"
            self.vehicle.commander.tell(INFO, text, "mavlink_mission_req_ignored", level=WARNING)
            return
        transfer.state = _State.DOWNLOAD
        transfer.kind = kind
        transfer.partner = link.sender
        transfer.seq = 0
        transfer.count = len(self._items(kind))
        self._heard(transfer)
        link.send_message(mavlink.MAVLink_mission_count_message(*link.sender, transfer.count, kind))
        self._schedule(self.vehicle.now_us)

    def _items(self, kind: int) -> plan.Items:
        return self._navigator.plans.items[kind] if kind in plan.KINDS else ()

    def _request(self, link: Link, m: Any) -> None:
        self._send_item(link, m, False)

    def _request_int(self, link: Link, m: Any) -> None:
        self._send_item(link, m, True)

    def _send_item(self, link: Link, m: Any, integers: bool) -> None:
        transfer = self._transfer(link)
        transfer.integers = integers
        if transfer.state is _State.IDLE:
            return  # PX4 does not reply: some displays send stray requests
        if link.sender != transfer.partner:
            self._announce_error("WPM: REJ. CMD: partner id mismatch", "mavlink_mission_partner_id_mismatch2")
            return
        if transfer.state is _State.UPLOAD:
            self._announce_error("WPM: REJ. CMD: Busy", "mavlink_mission_mis_req_ignored_busy")
            return
        if m.mission_type != transfer.kind:
            return
        self._heard(transfer)
        items = self._items(transfer.kind)
        expected = m.seq == transfer.seq and transfer.seq < transfer.count
        if not (expected or m.seq == transfer.seq - 1) or m.seq >= len(items):
            self._end(transfer)
            self._acknowledge(link, transfer.kind, _ERROR)
            self._announce_error("WPM: REJ. CMD: Req. WP was unexpected", "mavlink_mission_wp_unexpected")
            return
        transfer.seq = m.seq + 1
        current = transfer.kind == plan.MISSION and m.seq == self._navigator.plans.current
        link.send_message(mission_items.write(items[m.seq], m.seq, current, transfer.kind, integers, link.sender))

    def _ack(self, link: Link, m: Any) -> None:
        transfer = self._transfer(link)
        if transfer.state is _State.IDLE and transfer.partner == (0, 0):
            return
        if link.sender != transfer.partner:
            self._announce_error("REJ. WP CMD: partner id mismatch", "mavlink_mission_partner_id_mismatch")
        elif transfer.state is _State.DOWNLOAD and m.mission_type == transfer.kind:
            self._end(transfer)
        elif transfer.state is _State.UPLOAD and m.type == _UNSUPPORTED:
            transfer.integers = not transfer.integers
            self._request_item(link, transfer)
        elif transfer.state is _State.UPLOAD and m.type == _CANCELLED:
            self._end(transfer)

    # from the client to the vehicle

    def _count(self, link: Link, m: Any) -> None:
        transfer = self._transfer(link)
        if transfer.state is _State.UPLOAD:
            self._count_again(link, transfer)
            return
        if transfer.state is _State.DOWNLOAD:
            self._announce_error("WPM: IGN MISSION_COUNT: Busy", "mavlink_mission_ignore_mis_count")
            self._acknowledge(link, m.mission_type, _ERROR)
            return
        if self._uploading is not None:  # PX4 addresses this to the last partner on the link, initially 0
            link.send_message(mavlink.MAVLink_mission_ack_message(*transfer.partner, _ERROR, m.mission_type))
            return
        transfer.kind = m.mission_type
        capacity = plan.CAPACITY[m.mission_type] if m.mission_type in plan.KINDS else 0
        if m.count > capacity:
            self._acknowledge(link, m.mission_type, _NO_SPACE)
        elif m.count == 0:
            self._replace(m.mission_type, ())
            self._acknowledge(link, m.mission_type, _ACCEPTED)
        else:
            self._begin_upload(link, transfer, m.count)

    def _begin_upload(self, link: Link, transfer: _Transfer, count: int) -> None:
        transfer.state = _State.UPLOAD
        transfer.partner = link.sender
        transfer.seq = 0
        transfer.count = count
        transfer.items = []
        transfer.current = -1
        self._uploading = transfer
        self._heard(transfer)
        self._request_item(link, transfer)
        self._schedule(self.vehicle.now_us)

    def _count_again(self, link: Link, transfer: _Transfer) -> None:
        """Handle a MISSION_COUNT during an upload: the first request was lost, or another client starts an upload."""
        if transfer.seq == 0 and link.sender == transfer.partner:
            self._heard(transfer)
            self._request_item(link, transfer)
            return
        self._announce_error("WPM: REJ. CMD: Busy", "mavlink_mission_getlist_busy")
        self._acknowledge(link, transfer.kind, _ERROR)

    def _request_item(self, link: Link, transfer: _Transfer) -> None:
        transfer.sent_us = self.vehicle.now_us
        make = mavlink.MAVLink_mission_request_message
        if transfer.integers:
            make = mavlink.MAVLink_mission_request_int_message
        link.send_message(make(*transfer.partner, transfer.seq, transfer.kind))

    def _item(self, link: Link, m: Any) -> None:
        self._receive_item(link, m, False)

    def _item_int(self, link: Link, m: Any) -> None:
        self._receive_item(link, m, True)

    def _receive_item(self, link: Link, m: Any, integers: bool) -> None:
        transfer = self._transfer(link)
        transfer.integers = integers
        if m.mission_type != transfer.kind:
            self._acknowledge(link, transfer.kind, _ERROR)
        elif transfer.state is _State.UPLOAD:
            self._heard(transfer)
            if m.seq == transfer.seq:  # other items are ignored and requested again later
                self._store_item(link, transfer, m)
        elif transfer.state is _State.IDLE and transfer.seq and transfer.seq == m.seq + 1:
            self._acknowledge(link, transfer.kind, _ACCEPTED)  # the last item again: the acknowledgement was lost
        else:
            reason, name = "Busy", "mavlink_mission_mis_item_busy"
            if transfer.state is _State.IDLE:
                reason, name = "No transfer", "mavlink_mission_no_transfer"
            self._announce_error(f"IGN MISSION_ITEM: {reason}", name)
            self._acknowledge(link, transfer.kind, _ERROR)

    def _store_item(self, link: Link, transfer: _Transfer, m: Any) -> None:
        try:
            item = mission_items.parse(m, transfer.integers)
        except mission_items.ItemError as error:
            link.warn("mission", f"plan rejected: item {m.seq}: {error}", self.vehicle.now_us)
            self._announce_error("IGN MISSION_ITEM: Invalid item", "mavlink_mission_mis_item_invalid")
            self._acknowledge(link, transfer.kind, error.result)
            self._end(transfer)
            return
        if not self._is_valid(item, transfer.kind):
            self._acknowledge(link, transfer.kind, _ERROR)
            self._end(transfer)
            return
        transfer.items.append(item)
        transfer.seq += 1
        if m.current:
            transfer.current = m.seq
        if transfer.seq < transfer.count:
            self._request_item(link, transfer)
        else:
            self._finish_upload(link, transfer)

    def _is_valid(self, item: PlanItem, kind: int) -> bool:
        """Return whether ``item`` is valid in a plan of ``kind``; an invalid polygon clears the fence, as in PX4."""
        if kind == plan.MISSION:
            return item.command not in _NOT_FOR_MISSIONS
        if kind == plan.FENCE and item.command in _POLYGONS and geofence.vertex_count(item) < _LEAST_VERTICES:
            self._replace(plan.FENCE, ())
            return False
        return True

    def _finish_upload(self, link: Link, transfer: _Transfer) -> None:
        self._end(transfer)
        self._acknowledge(link, transfer.kind, _ACCEPTED)
        items, transfer.items = transfer.items, []
        self._replace(transfer.kind, items, transfer.current)

    def _replace(self, kind: int, items: Sequence[PlanItem], current: int = -1) -> None:
        if kind not in plan.KINDS:
            return  # PX4 accepts clearing of unknown kinds
        self._navigator.set_plan(kind, items, current)
        self._schedule(self.vehicle.now_us)

    # both ways

    def _clear_all(self, link: Link, m: Any) -> None:
        transfer = self._transfer(link)
        if transfer.state is not _State.IDLE:
            self._announce_error("WPM: IGN CLEAR CMD: Busy", "mavlink_mission_ignore_clear")
            return
        transfer.kind = m.mission_type
        for kind in plan.KINDS if m.mission_type == plan.ALL_KINDS else (m.mission_type,):
            self._replace(kind, ())
        self._acknowledge(link, m.mission_type, _ACCEPTED)

    def _set_current(self, link: Link, m: Any) -> None:
        if self._transfer(link).state is not _State.IDLE:
            self._announce_error("WPM: IGN WP CURR CMD: Busy", "mavlink_mission_state_busy")
        elif not self._navigator.set_current(m.seq):
            self._announce_error("WPM: WP CURR CMD: Not in list", "mavlink_mission_seq_out_of_bounds")
        else:
            # immediately to the sender, which may be a participant that blocks the tick; to the others in ``update``
            link.send_message(mavlink.MAVLink_mission_current_message(m.seq))
            self._sent_current = -1
            self._schedule(self.vehicle.now_us)

    def _acknowledge(self, link: Link, kind: int, result: int) -> None:
        link.send_message(mavlink.MAVLink_mission_ack_message(*link.sender, result, kind))

    # precision landing

    def _landing_target(self, _link: Link, m: Any) -> None:
        self.vehicle.call_or_queue(lambda: self._apply_landing_target(m))

    def _apply_landing_target(self, m: Any) -> None:
        if m.position_valid and m.frame != _LOCAL_NED:
            self.vehicle.commander.say(CRITICAL, f"landing target: coordinate frame {m.frame} unsupported")
        elif m.position_valid:
            self._navigator.set_landing_target((m.x, m.y, m.z), m.time_usec)
        else:
            self._navigator.set_landing_target_angles(m.angle_x, m.angle_y, m.distance)
