"""The mission protocol for missions, geofences and rally points, answered as PX4 v1.14 does, quirks included.

https://mavlink.io/en/services/mission.html; PX4 ``MavlinkMissionManager``. Each client has a transfer of its own, but
only one uploads at a time.
"""

from __future__ import annotations

import enum
from collections.abc import Sequence
from typing import Any, ClassVar

from pymavlink.dialects.v20 import common as mavlink

from xtdrone_control.autopilot.commander.commander import CRITICAL, INFO
from xtdrone_control.autopilot.events.events import ERROR, WARNING
from xtdrone_control.autopilot.navigator import geofence, plan
from xtdrone_control.autopilot.navigator.plan import PlanItem
from xtdrone_control.mavlink.link import Link
from xtdrone_control.mavlink.microservices import mission_items
from xtdrone_control.mavlink.service import NEVER_US, Service, Vehicle

_RETRY_US = 250_000  # until an item is asked for again
_TIMEOUT_US = 5_000_000  # of a partner's silence
_LOOK_US = 20_000  # between two looks at transfers: PX4's MAVLink loop makes its 250 ms about 270
_PROGRESS_US = 100_000  # between two looks at the mission
_REPEAT_US = 1_000_000  # MISSION_CURRENT and, for a while, MISSION_ITEM_REACHED
_REACHED_REPEATS = 10
_ACCEPTED, _ERROR, _NO_SPACE = 0, 1, 4  # MAV_MISSION_RESULT
_UNSUPPORTED, _CANCELLED = 3, 15
_LOCAL_NED = 1  # MAV_FRAME
# commands that belong to fences and rally points; PX4 refuses them in a mission
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
    """What is under way with one client.

    Attributes:
        state: whether and where items go.
        kind: MAV_MISSION_TYPE.
        partner: MAVLink system and component id of the other end.
        seq: next item.
        count: how many there are.
        items: those that have come.
        current: index of the item that came marked as the current one, -1 for none.
        integers: MISSION_REQUEST_INT and MISSION_ITEM_INT are spoken; MISSION_REQUEST comes first, as from PX4.
        sent_us, heard_us: simulated time of the last request, and of the last message from the partner.
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
    """Takes and tells plans, and tells of the mission's progress."""

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
        """Serve ``vehicle``."""
        super().__init__(vehicle)
        self._navigator = vehicle.commander.navigator
        self._transfers: dict[Link, _Transfer] = {}
        self._uploading: _Transfer | None = None
        self._told_current = -1
        self._told_reached = -1
        self._repeats = 0
        self._repeat_us = 0
        self._wake(0)

    # time

    def update(self, now_us: int) -> None:
        """Ask again, give up, and tell of the mission's progress."""
        self.due_us = NEVER_US
        self._drop_closed()
        for link, transfer in self._transfers.items():
            if transfer.state is not _State.IDLE:
                self._watch(link, transfer, now_us)
        self._tell_progress(now_us)
        self._wake(now_us)

    def _wake(self, now_us: int) -> None:
        """Set when ``update`` is due next."""
        if any(transfer.state is not _State.IDLE for transfer in self._transfers.values()):
            self.due_us = (now_us // _LOOK_US + 1) * _LOOK_US
        elif self._navigator.plans.mission or self._navigator.payload.shots:
            self.due_us = (now_us // _PROGRESS_US + 1) * _PROGRESS_US
        else:
            self.due_us = NEVER_US

    def _watch(self, link: Link, transfer: _Transfer, now_us: int) -> None:
        if transfer.state is _State.UPLOAD and now_us - transfer.sent_us > _RETRY_US:
            self._ask(link, transfer)
        elif now_us - transfer.heard_us > _TIMEOUT_US:
            self._refuse("Operation timeout", "mavlink_mission_op_timeout")
            self._end(transfer)

    def _end(self, transfer: _Transfer) -> None:
        transfer.state = _State.IDLE
        if self._uploading is transfer:
            self._uploading = None

    def _refuse(self, text: str, name: str) -> None:
        self.vehicle.commander.tell(CRITICAL, text, name, level=ERROR)

    def _transfer(self, link: Link) -> _Transfer:
        transfer = self._transfers.get(link)
        if transfer is None:
            self._drop_closed()
            transfer = self._transfers[link] = _Transfer()
        return transfer

    def _drop_closed(self) -> None:
        """Forget the clients that are gone, and what was under way with them."""
        for link in [link for link in self._transfers if not link.open]:
            self._end(self._transfers.pop(link))

    def _heard(self, transfer: _Transfer) -> None:
        transfer.heard_us = self.vehicle.now_us

    # progress

    def _tell_progress(self, now_us: int) -> None:
        mission, plans = self._navigator.mission, self._navigator.plans
        tell = self._tell
        for shot in self._taken_shots():
            tell(mavlink.MAVLink_camera_trigger_message(shot.time_us, shot.number))
        reached, current = mission.reached, plans.current
        if not plans.mission:
            self._told_current = self._told_reached = -1
            return
        if reached != self._told_reached:
            self._told_reached = reached
            self._repeats = 0
            if reached >= 0:
                tell(mavlink.MAVLink_mission_item_reached_message(reached))
        if current != self._told_current:
            self._told_current = current
            self._repeat_us = now_us + _REPEAT_US
            tell(mavlink.MAVLink_mission_current_message(current))
        elif now_us >= self._repeat_us:
            self._repeat_us = now_us + _REPEAT_US
            tell(mavlink.MAVLink_mission_current_message(current))
            if reached >= 0 and self._repeats < _REACHED_REPEATS:
                self._repeats += 1
                tell(mavlink.MAVLink_mission_item_reached_message(reached))

    def _tell(self, message: Any) -> None:
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
        self._wake(self.vehicle.now_us)

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
            return  # PX4 says nothing: some displays ask for no reason
        if link.sender != transfer.partner:
            self._refuse("WPM: REJ. CMD: partner id mismatch", "mavlink_mission_partner_id_mismatch2")
            return
        if transfer.state is _State.UPLOAD:
            self._refuse("WPM: REJ. CMD: Busy", "mavlink_mission_mis_req_ignored_busy")
            return
        if m.mission_type != transfer.kind:
            return
        self._heard(transfer)
        items = self._items(transfer.kind)
        expected = m.seq == transfer.seq and transfer.seq < transfer.count
        if not (expected or m.seq == transfer.seq - 1) or m.seq >= len(items):
            self._end(transfer)
            self._acknowledge(link, transfer.kind, _ERROR)
            self._refuse("WPM: REJ. CMD: Req. WP was unexpected", "mavlink_mission_wp_unexpected")
            return
        transfer.seq = m.seq + 1
        current = transfer.kind == plan.MISSION and m.seq == self._navigator.plans.current
        link.send_message(mission_items.write(items[m.seq], m.seq, current, transfer.kind, integers, link.sender))

    def _ack(self, link: Link, m: Any) -> None:
        transfer = self._transfer(link)
        if transfer.state is _State.IDLE and transfer.partner == (0, 0):
            return
        if link.sender != transfer.partner:
            self._refuse("REJ. WP CMD: partner id mismatch", "mavlink_mission_partner_id_mismatch")
        elif transfer.state is _State.DOWNLOAD and m.mission_type == transfer.kind:
            self._end(transfer)
        elif transfer.state is _State.UPLOAD and m.type == _UNSUPPORTED:
            transfer.integers = not transfer.integers
            self._ask(link, transfer)
        elif transfer.state is _State.UPLOAD and m.type == _CANCELLED:
            self._end(transfer)

    # from the client to the vehicle

    def _count(self, link: Link, m: Any) -> None:
        transfer = self._transfer(link)
        if transfer.state is _State.UPLOAD:
            self._count_again(link, transfer)
            return
        if transfer.state is _State.DOWNLOAD:
            self._refuse("WPM: IGN MISSION_COUNT: Busy", "mavlink_mission_ignore_mis_count")
            self._acknowledge(link, m.mission_type, _ERROR)
            return
        if self._uploading is not None:  # PX4 addresses this to the last partner on the link, at first to none
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
        self._ask(link, transfer)
        self._wake(self.vehicle.now_us)

    def _count_again(self, link: Link, transfer: _Transfer) -> None:
        """Answer a MISSION_COUNT during an upload: the first request was lost, or somebody else wants to begin."""
        if transfer.seq == 0 and link.sender == transfer.partner:
            self._heard(transfer)
            self._ask(link, transfer)
            return
        self._refuse("WPM: REJ. CMD: Busy", "mavlink_mission_getlist_busy")
        self._acknowledge(link, transfer.kind, _ERROR)

    def _ask(self, link: Link, transfer: _Transfer) -> None:
        transfer.sent_us = self.vehicle.now_us
        make = mavlink.MAVLink_mission_request_message
        if transfer.integers:
            make = mavlink.MAVLink_mission_request_int_message
        link.send_message(make(*transfer.partner, transfer.seq, transfer.kind))

    def _item(self, link: Link, m: Any) -> None:
        self._take_item(link, m, False)

    def _item_int(self, link: Link, m: Any) -> None:
        self._take_item(link, m, True)

    def _take_item(self, link: Link, m: Any, integers: bool) -> None:
        transfer = self._transfer(link)
        transfer.integers = integers
        if m.mission_type != transfer.kind:
            self._acknowledge(link, transfer.kind, _ERROR)
        elif transfer.state is _State.UPLOAD:
            self._heard(transfer)
            if m.seq == transfer.seq:  # another one is ignored, and asked for again in time
                self._keep_item(link, transfer, m)
        elif transfer.state is _State.IDLE and transfer.seq and transfer.seq == m.seq + 1:
            self._acknowledge(link, transfer.kind, _ACCEPTED)  # the last one again: the acknowledgement was lost
        else:
            what, name = "Busy", "mavlink_mission_mis_item_busy"
            if transfer.state is _State.IDLE:
                what, name = "No transfer", "mavlink_mission_no_transfer"
            self._refuse(f"IGN MISSION_ITEM: {what}", name)
            self._acknowledge(link, transfer.kind, _ERROR)

    def _keep_item(self, link: Link, transfer: _Transfer, m: Any) -> None:
        try:
            item = mission_items.parse(m, transfer.integers)
        except mission_items.ItemError as error:
            link.warn("mission", f"plan refused: item {m.seq}: {error}", self.vehicle.now_us)
            self._refuse("IGN MISSION_ITEM: Invalid item", "mavlink_mission_mis_item_invalid")
            self._acknowledge(link, transfer.kind, error.result)
            self._end(transfer)
            return
        if not self._fits(item, transfer.kind):
            self._acknowledge(link, transfer.kind, _ERROR)
            self._end(transfer)
            return
        transfer.items.append(item)
        transfer.seq += 1
        if m.current:
            transfer.current = m.seq
        if transfer.seq < transfer.count:
            self._ask(link, transfer)
        else:
            self._finish_upload(link, transfer)

    def _fits(self, item: PlanItem, kind: int) -> bool:
        """Return whether the list ``kind`` takes ``item``; a polygon that cannot be clears the fence, as in PX4."""
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
            return  # PX4 accepts to clear what it does not have
        self._navigator.set_plan(kind, items, current)
        self._wake(self.vehicle.now_us)

    # both ways

    def _clear_all(self, link: Link, m: Any) -> None:
        transfer = self._transfer(link)
        if transfer.state is not _State.IDLE:
            self._refuse("WPM: IGN CLEAR CMD: Busy", "mavlink_mission_ignore_clear")
            return
        transfer.kind = m.mission_type
        for kind in plan.KINDS if m.mission_type == plan.ALL_KINDS else (m.mission_type,):
            self._replace(kind, ())
        self._acknowledge(link, m.mission_type, _ACCEPTED)

    def _set_current(self, link: Link, m: Any) -> None:
        if self._transfer(link).state is not _State.IDLE:
            self._refuse("WPM: IGN WP CURR CMD: Busy", "mavlink_mission_state_busy")
        elif not self._navigator.set_current(m.seq):
            self._refuse("WPM: WP CURR CMD: Not in list", "mavlink_mission_seq_out_of_bounds")
        else:
            # at once for who asked, since he may hold the time, and in its turn for the others
            link.send_message(mavlink.MAVLink_mission_current_message(m.seq))
            self._told_current = -1
            self._wake(self.vehicle.now_us)

    def _acknowledge(self, link: Link, kind: int, result: int) -> None:
        link.send_message(mavlink.MAVLink_mission_ack_message(*link.sender, result, kind))

    # precision landing

    def _landing_target(self, _link: Link, m: Any) -> None:
        self.vehicle.in_turn(lambda: self._take_landing_target(m))

    def _take_landing_target(self, m: Any) -> None:
        if m.position_valid and m.frame != _LOCAL_NED:
            self.vehicle.commander.say(CRITICAL, f"landing target: coordinate frame {m.frame} unsupported")
        elif m.position_valid:
            self._navigator.set_landing_target((m.x, m.y, m.z))
        else:
            self._navigator.set_landing_target_angles(m.angle_x, m.angle_y, m.distance)
