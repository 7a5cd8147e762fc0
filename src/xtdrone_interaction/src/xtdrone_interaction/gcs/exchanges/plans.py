"""Exchanges that upload, download and clear a vehicle's plan: mission, geofence and rally points.

In the mission protocol (https://mavlink.io/en/services/mission.html) the sender repairs losses by repetition. A vehicle
whose time stands still never repeats a request, so here only the ground station repeats: after a timeout it sends the
item requested last and the one after it, because the request for that one may have been lost.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

from pymavlink.dialects.v20 import common as mavlink

from xtdrone_autopilot.mavlink.microservices import mission_items
from xtdrone_autopilot.navigator import plan
from xtdrone_autopilot.navigator.plan import FRAME_MISSION, Items, PlanItem
from xtdrone_autopilot.plans.qgc_plan import Plan

from .exchange import (
    AUTOPILOT,
    Exchange,
    Progress,
    RefusalError,
    T,
    Unanswered,
    fetch_message,
    ignore_progress,
    is_message,
)

KINDS = ("mission", "fence", "rally points")  # by MAV_MISSION_TYPE

_ATTEMPTS = 10
_SHOWN = 4  # alterations in the text
_REPEATS = 8  # unanswered requests before a download starts over: the vehicle may have ended the transfer
_RETRIED = (mavlink.MAV_MISSION_ERROR, mavlink.MAV_MISSION_INVALID_SEQUENCE, mavlink.MAV_MISSION_OPERATION_CANCELLED)
_ALL = plan.ALL_KINDS
_FRAMES = {0: 0, 5: 0, 3: 3, 6: 3, FRAME_MISSION: FRAME_MISSION}  # MAV_FRAME; integer frames as their float frames
_PLACE_TOLERANCE = 1.5e-7  # degrees, one digit in a message
_NUMBER_TOLERANCE = 1e-6  # relative, of MAVLink's floats
_HEADING = 4  # number of the parameter
_HEADING_TOLERANCE = 1e-3  # degrees


def to_message(item: PlanItem, seq: int, kind: int, system: int) -> Any:
    """Convert a plan's item to MISSION_ITEM_INT for the autopilot of ``system``."""
    scale = 1.0 if item.frame == FRAME_MISSION else 1e7
    return mavlink.MAVLink_mission_item_int_message(
        system,
        AUTOPILOT,
        seq,
        item.frame,
        item.command,
        int(seq == 0 and kind == plan.MISSION),
        int(item.autocontinue),
        *item.params,
        round(item.x * scale),
        round(item.y * scale),
        item.z,
        kind,
    )


def difference(sent: Sequence[PlanItem], found: Sequence[PlanItem], kind: int) -> str:
    """Describe the first difference between an uploaded list and the downloaded one; empty for none.

    PX4 returns only what it stores of an item, so ``sent`` is reduced to that before the comparison.

    Args:
        sent, found: Items uploaded and downloaded.
        kind: MAV_MISSION_TYPE of the list.
    """
    if len(sent) != len(found):
        return f"{len(found)} items came back of {len(sent)}"
    for seq, (item, back) in enumerate(zip(sent, found, strict=True)):
        message = to_message(item, seq, kind, 1)
        kept = mission_items.write(mission_items.parse(message, True), seq, False, kind, True, (0, 0))
        if not _are_equal(mission_items.parse(kept, True), back, kind):
            return f"item {seq + 1} came back as {back}, not as {item}"
    return ""


def alterations(sent: Sequence[PlanItem], found: Sequence[PlanItem], kind: int) -> list[str]:
    """Describe each number of the items that a vehicle has stored otherwise than it was sent; headings are modulo 360.

    Args:
        sent, found: uploaded and downloaded items, without a ``difference``.
        kind: MAV_MISSION_TYPE.
    """
    altered = []
    for seq, (item, back) in enumerate(zip(sent, found, strict=True), 1):
        if item.command != back.command:
            altered.append(f"item {seq} as command {back.command}")
        heads = math.isfinite(item.yaw)
        for number, (value, stored) in enumerate(zip(_numbers(item), _numbers(back), strict=True), 1):
            turned = math.remainder(value - stored, 360.0) if heads and number == _HEADING else math.nan
            if not (_are_alike(value, stored) or abs(turned) < _HEADING_TOLERANCE):
                altered.append(f"param{number} {value:g} of item {seq} as {stored:g}")
    return altered if kind == plan.MISSION else [f"{KINDS[kind]}: {text}" for text in altered]


def _numbers(item: PlanItem) -> tuple[float, ...]:
    """Return the parameters of an item; 0 for a position, which ``difference`` compares."""
    return (*item.params, item.x, item.y, item.z) if item.frame == FRAME_MISSION else (*item.params, 0.0, 0.0, item.z)


def _are_alike(a: float, b: float) -> bool:
    return math.isclose(a, b, rel_tol=_NUMBER_TOLERANCE, abs_tol=1e-6) or (a != a and b != b)


def _are_equal(a: PlanItem, b: PlanItem, kind: int) -> bool:
    if (a.command, _FRAMES.get(a.frame)) != (b.command, _FRAMES.get(b.frame)):
        return False
    if kind == plan.MISSION and a.autocontinue != b.autocontinue:
        return False
    if a.frame != FRAME_MISSION and max(abs(a.x - b.x), abs(a.y - b.y)) > _PLACE_TOLERANCE:
        return False
    return all(map(_are_alike, (*a.params, a.z), (*b.params, b.z)))


def cancel_transfers(system: int) -> list[Any]:
    """Return the messages that cancel all our transfers with the autopilot of ``system``."""
    cancelled = mavlink.MAV_MISSION_OPERATION_CANCELLED
    return [mavlink.MAVLink_mission_ack_message(system, AUTOPILOT, cancelled, kind) for kind in plan.KINDS]


# single lists


def _upload_once(system: int, kind: int, items: Items, progress: Progress) -> Exchange[None]:
    """Upload a list, without retries.

    Raises:
        RefusalError: the vehicle rejects it.
    """
    count = len(items)
    outgoing: list[Any] = [mavlink.MAVLink_mission_count_message(system, AUTOPILOT, count, kind)]
    first = outgoing[0]
    requested = sent = -1  # the item requested last, and the highest one sent
    while True:
        answer = yield outgoing
        outgoing = []
        if answer is None:
            if requested < 0:
                outgoing = [first]
            else:
                sent = min(sent + 1, count - 1)
                outgoing = [to_message(items[seq], seq, kind, system) for seq in range(requested, sent + 1)]
        elif getattr(answer, "mission_type", None) != kind:
            continue
        elif is_message(answer, "MISSION_ACK"):
            if answer.type == mavlink.MAV_MISSION_ACCEPTED and sent == count - 1:
                return
            # after the last item, an error may be about an item that was sent twice: the download will show
            if answer.type == mavlink.MAV_MISSION_ERROR and count and sent == count - 1:
                return
            if answer.type != mavlink.MAV_MISSION_ACCEPTED:
                raise _refusal(answer.type, kind, requested, items)
        elif is_message(answer, "MISSION_REQUEST", "MISSION_REQUEST_INT") and answer.seq < count:
            requested = answer.seq
            sent = max(sent, requested)
            progress(f"sending {KINDS[kind]}", requested, count)
            outgoing = [to_message(items[requested], requested, kind, system)]


def _refusal(result: int, kind: int, requested: int, items: Items) -> RefusalError:
    entry = mavlink.enums["MAV_MISSION_RESULT"].get(result)
    name = f"result {result}" if entry is None else entry.name
    known = 0 <= requested < len(items)
    where = f"item {requested + 1} (command {items[requested].command})" if known else f"{len(items)} items"
    return RefusalError(f"{KINDS[kind]}: the vehicle rejects {where}: {name}", result not in _RETRIED)


def _download_once(system: int, kind: int, progress: Progress) -> Exchange[Items]:
    """Download a list, without retries.

    Raises:
        RefusalError: the vehicle does not send it.
    """
    first = mavlink.MAVLink_mission_request_list_message(system, AUTOPILOT, kind)
    items: list[PlanItem] = []
    count = -1
    repeats = 0
    outgoing = [first]
    while count < 0 or len(items) < count:
        answer = yield outgoing
        outgoing = []
        if answer is None:
            repeats += 1
            if repeats > _REPEATS:
                raise RefusalError(f"{KINDS[kind]}: the vehicle has ended the transfer", False)
            outgoing = [first if count < 0 else _request(system, len(items), kind)]
        elif getattr(answer, "mission_type", None) != kind:
            continue
        elif is_message(answer, "MISSION_COUNT") and count < 0:
            count = answer.count
            outgoing = [_request(system, 0, kind)] if count else []
        elif is_message(answer, "MISSION_ITEM_INT") and answer.seq == len(items) and count > 0:
            repeats = 0
            items.append(_parse(answer, kind))
            progress(f"reading {KINDS[kind]}", len(items), count)
            outgoing = [_request(system, len(items), kind)] if len(items) < count else []
        elif is_message(answer, "MISSION_ACK") and answer.type != mavlink.MAV_MISSION_ACCEPTED:
            raise _refusal(answer.type, kind, -1, ())
    return tuple(items)


def _parse(message: Any, kind: int) -> PlanItem:
    try:
        return mission_items.parse(message, True)
    except mission_items.ItemError as error:
        raise RefusalError(f"{KINDS[kind]}: item {message.seq + 1} of the vehicle: {error}", True) from error


def _request(system: int, seq: int, kind: int) -> Any:
    return mavlink.MAVLink_mission_request_int_message(system, AUTOPILOT, seq, kind)


def _acceptance(system: int, kind: int) -> Unanswered:
    return Unanswered([mavlink.MAVLink_mission_ack_message(system, AUTOPILOT, mavlink.MAV_MISSION_ACCEPTED, kind)])


def _retry(system: int, once: Callable[[], Exchange[T]]) -> Exchange[T]:
    """Run an exchange until it succeeds, or fails finally or for the last of several times.

    Raises:
        RefusalError: from the last attempt.
    """
    for attempt in range(_ATTEMPTS):
        try:
            return (yield from once())
        except RefusalError as error:
            if error.final or attempt == _ATTEMPTS - 1:
                raise
        # cancel the transfer, and skip its messages that are still arriving
        answer = yield cancel_transfers(system)
        while answer is not None:
            answer = yield []
    raise AssertionError("unreachable")


def upload_list(system: int, kind: int, items: Items, progress: Progress = ignore_progress) -> Exchange[list[str]]:
    """Replace a list of a vehicle, download it again and compare; return its ``alterations``.

    Args:
        system: MAVLink system id of the vehicle.
        kind: MAV_MISSION_TYPE of the list.
        items: Items of a plan.
        progress: Callback.

    Raises:
        RefusalError: the vehicle rejects the list.
    """

    def once() -> Exchange[list[str]]:
        yield from _upload_once(system, kind, items, progress)
        found = yield from _download_once(system, kind, progress)
        yield _acceptance(system, kind)
        wrong = difference(items, found, kind)
        if wrong:
            raise RefusalError(f"{KINDS[kind]}: {wrong}", False)
        return alterations(items, found, kind)

    return (yield from _retry(system, once))


def download_list(system: int, kind: int, progress: Progress = ignore_progress) -> Exchange[Items]:
    """Return a list of a vehicle as the items of a plan.

    Raises:
        RefusalError: the vehicle does not send it.
    """
    found = yield from _retry(system, lambda: _download_once(system, kind, progress))
    yield _acceptance(system, kind)
    return found


# whole plans


def outcome(altered: Sequence[str]) -> str:
    """Describe the result of an upload from its ``alterations``."""
    if not altered:
        return "sent, and come back the same"
    more = f" and {len(altered) - _SHOWN} more" if len(altered) > _SHOWN else ""
    return f"sent, and stored in the vehicle's own form: {', '.join(altered[:_SHOWN])}{more}"


def check_capacity(content: Plan) -> str:
    """Describe the list of a plan that is too long for a PX4; empty for none."""
    for kind in plan.KINDS:
        count = len(content.items(kind))
        if count > plan.CAPACITY[kind]:
            return f"{KINDS[kind]}: {count} items are not allowed, at most {plan.CAPACITY[kind]}"
    return ""


def upload_plan(
    system: int, content: Plan, progress: Progress = ignore_progress, kinds: Sequence[int] = plan.KINDS
) -> Exchange[list[str]]:
    """Replace lists of a vehicle, also by empty ones, as QGroundControl does; see ``upload_list``.

    Args:
        system: MAVLink system id of the vehicle.
        content: Plan with the lists.
        progress: Callback.
        kinds: MAV_MISSION_TYPEs of the lists, all by default.

    Raises:
        RefusalError: the vehicle rejects one of them.
    """
    altered: list[str] = []
    for kind in kinds:
        altered += yield from upload_list(system, kind, content.items(kind), progress)
    return altered


def download_plan(system: int, progress: Progress = ignore_progress) -> Exchange[Plan]:
    """Return the plan of a vehicle with its home position, zeros for none; see ``download_list``.

    Raises:
        RefusalError: the vehicle does not send one of the lists.
    """
    lists = []
    for kind in plan.KINDS:
        lists.append((yield from download_list(system, kind, progress)))
    home = yield from fetch_message(system, "HOME_POSITION")
    place = (0.0, 0.0, 0.0) if home is None else (home.latitude * 1e-7, home.longitude * 1e-7, home.altitude * 1e-3)
    return Plan(lists[0], lists[1], lists[2], place)


def clear_plan(system: int, progress: Progress = ignore_progress) -> Exchange[None]:
    """Clear all lists of a vehicle.

    Raises:
        RefusalError: the vehicle does not clear them.
    """

    def once() -> Exchange[None]:
        ask = mavlink.MAVLink_mission_clear_all_message(system, AUTOPILOT, _ALL)
        progress("clearing", 0, 1)
        answer = yield [ask]
        while not (is_message(answer, "MISSION_ACK") and answer.mission_type == _ALL):
            answer = yield [*cancel_transfers(system), ask] if answer is None else []
        if answer.type != mavlink.MAV_MISSION_ACCEPTED:
            raise RefusalError(f"the vehicle does not clear its plan: result {answer.type}", False)

    yield from _retry(system, once)
    for kind in plan.KINDS:
        left = yield from download_list(system, kind, progress)
        if left:
            raise RefusalError(f"{KINDS[kind]}: {len(left)} items are left after the clearing", True)
