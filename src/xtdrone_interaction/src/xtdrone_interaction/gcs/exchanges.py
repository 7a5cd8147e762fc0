"""What a ground station says and hears when it gives a vehicle a plan, or asks for one: no sockets, no clock.

An ArduPilot has its home as the first item of its mission, whatever is sent there; a plan has not. It keeps only those
of an item's parameters that its command needs, so what comes back is compared by commands and places alone.

An exchange is a generator. It yields the messages to send, and is given the next message of the vehicle that it may be
waiting for (one of ``ANSWERS``), or None when none has come in time; it returns its result. Whoever runs it gives up on
a vehicle that says nothing at all.

The mission protocol (https://mavlink.io/en/services/mission.html) repairs losses by the sender's repeating himself. A
vehicle whose time stands still never asks a second time, so repeating is ours alone here: after the item that was asked
for last comes also the one behind it, for the vehicle's request for that may be what was lost.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Generator, Iterable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple, TypeVar

from pymavlink.dialects.v20 import common as mavlink

from xtdrone_control.autopilot.navigator import plan
from xtdrone_control.autopilot.navigator.plan import FRAME_MISSION, Items, PlanItem
from xtdrone_control.mavlink.microservices import mission_items
from xtdrone_control.mavlink.wire.dialect import MESSAGE_ID
from xtdrone_control.plans.qgc_plan import FRAME_GLOBAL, Place, Plan

SYSTEM, COMPONENT = 254, mavlink.MAV_COMP_ID_MISSIONPLANNER
"""Who we are; 255 is QGroundControl's system id, which may be there too."""

ANSWERS = (
    "AUTOPILOT_VERSION",
    "COMMAND_ACK",
    "ESTIMATOR_STATUS",
    "EXTENDED_SYS_STATE",
    "GLOBAL_POSITION_INT",
    "GPS_GLOBAL_ORIGIN",
    "GPS_RAW_INT",
    "HEARTBEAT",
    "HOME_POSITION",
    "LOG_DATA",
    "LOG_ENTRY",
    "LOCAL_POSITION_NED",
    "MISSION_ACK",
    "MISSION_COUNT",
    "MISSION_ITEM_INT",
    "MISSION_REQUEST",
    "MISSION_REQUEST_INT",
    "PARAM_VALUE",
    "STATUSTEXT",
    "SYS_STATUS",
    "TIMESYNC",
)
KINDS = ("mission", "fence", "rally points")  # by MAV_MISSION_TYPE

_AUTOPILOT = mavlink.MAV_COMP_ID_AUTOPILOT1
_PX4, _ARDUPILOT = mavlink.MAV_AUTOPILOT_PX4, mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA
_ATTEMPTS = 10
_REQUESTS = 100  # of a message, until it counts as one that the vehicle does not have
_PATIENT_REPEATS = 8  # requests without an answer until a download begins anew: the vehicle may have given it up
_RETRIED = (mavlink.MAV_MISSION_ERROR, mavlink.MAV_MISSION_INVALID_SEQUENCE, mavlink.MAV_MISSION_OPERATION_CANCELLED)
_ALL = plan.ALL_KINDS
_FRAMES = {0: 0, 5: 0, 3: 3, 6: 3, FRAME_MISSION: FRAME_MISSION}  # MAV_FRAME, those with integers as those without
_PLACE_TOLERANCE = 1.5e-7  # degrees: one digit of the wire
_NUMBER_TOLERANCE = 1e-6  # relative, of MAVLink's floats

Progress = Callable[[str, int, int], None]
"""Told what is under way, how many of its parts are done, and how many there are."""

T = TypeVar("T")
Exchange = Generator[list[Any], Any, T]


class Beat(NamedTuple):
    """A vehicle's HEARTBEAT, as an exchange is given it: who it is of, and what it is.

    Attributes:
        system: MAVLink system id.
        autopilot: MAV_AUTOPILOT.
        kind: MAV_TYPE.
        base_mode, custom_mode: its mode.
    """

    system: int
    autopilot: int
    kind: int
    base_mode: int
    custom_mode: int


class Heard(NamedTuple):
    """A vehicle's TIMESYNC, as an exchange is given it: it is there."""

    system: int


class RefusalError(Exception):
    """The vehicle does not do what it was asked for.

    Attributes:
        final: whether to try again is of no use.
    """

    def __init__(self, text: str, final: bool) -> None:
        """Take what is to be told."""
        super().__init__(text)
        self.final = final


def nobody(_what: str, _done: int, _total: int) -> None:
    """Take progress for somebody who wants to know of none."""


def hello() -> list[Any]:
    """Return what makes a vehicle whose system id is not known speak to us; it has no part in the flight."""
    return [mavlink.MAVLink_timesync_message(0, 1)]


def greet(system: int = 0) -> Exchange[Beat]:
    """Return what the heartbeat of a vehicle tells; ``system``: its id, 0 when that is not known yet."""
    answer = yield [*hello(), *([ask_for(system, mavlink.MAVLINK_MSG_ID_HEARTBEAT)] if system else [])]
    while not isinstance(answer, Beat):
        if isinstance(answer, Heard):
            system = answer.system
        ask = [ask_for(system, mavlink.MAVLINK_MSG_ID_HEARTBEAT)] if system else hello()
        answer = yield ask if answer is None or isinstance(answer, Heard) else []
    return answer


def ask_for(system: int, number: int) -> Any:
    """Return the request for a message that the vehicle sends once."""
    return mavlink.MAVLink_command_long_message(
        system, _AUTOPILOT, mavlink.MAV_CMD_REQUEST_MESSAGE, 0, number, *[0.0] * 6
    )


def request(system: int, name: str) -> Exchange[Any]:
    """Return a message that the vehicle sends when it is asked for it, None when it does not have it."""
    ask = ask_for(system, MESSAGE_ID[name])
    answer = yield [ask]
    for _ in range(_REQUESTS):
        while answer is not None:
            if _is(answer, name):
                return answer
            denied = _is(answer, "COMMAND_ACK") and answer.command == mavlink.MAV_CMD_REQUEST_MESSAGE
            if denied and answer.result != mavlink.MAV_RESULT_ACCEPTED:
                return None
            answer = yield []
        answer = yield [ask]
    return None


_LOOKED_AT = (
    "SYS_STATUS",
    "EXTENDED_SYS_STATE",
    "GLOBAL_POSITION_INT",
    "LOCAL_POSITION_NED",
    "GPS_RAW_INT",
    "ESTIMATOR_STATUS",
)
_FRUITLESS = 4  # requests in a row without an answer until nothing more is hoped for


def look(beat: Beat) -> Exchange[None]:
    """Have a vehicle tell its state once, also while its time stands; what it does not have it does not tell."""
    missing = dict.fromkeys(_LOOKED_AT)
    fruitless = 0
    outgoing = _ask_all(beat.system, missing)
    while missing and fruitless < _FRUITLESS:
        answer = yield outgoing
        outgoing = []
        name = type(answer).__name__
        if name in missing:
            del missing[name]
            fruitless = 0
        elif answer is None:
            fruitless += 1
            outgoing = _ask_all(beat.system, missing)


def _ask_all(system: int, names: Iterable[str]) -> list[Any]:
    return [ask_for(system, MESSAGE_ID[name]) for name in names]


def to_message(item: PlanItem, seq: int, kind: int, system: int) -> Any:
    """Return an item as MISSION_ITEM_INT for the autopilot of ``system``."""
    scale = 1.0 if item.frame == FRAME_MISSION else 1e7
    return mavlink.MAVLink_mission_item_int_message(
        system,
        _AUTOPILOT,
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


def difference(sent: Sequence[PlanItem], found: Sequence[PlanItem], kind: int, autopilot: int = _PX4) -> str:
    """Return in what a list that came back differs from the one that was sent, empty for nothing.

    A PX4 tells of an item what it keeps of it, so ``sent`` is compared as it would come back.

    Args:
        sent, found: the lists.
        kind: MAV_MISSION_TYPE.
        autopilot: MAV_AUTOPILOT of the vehicle.
    """
    if len(sent) != len(found):
        return f"{len(found)} items came back of {len(sent)}"
    for seq, (item, back) in enumerate(zip(sent, found, strict=True)):
        if autopilot == _ARDUPILOT:
            alike = item.command == back.command and (item.frame == FRAME_MISSION or _at_one_place(item, back))
        else:
            message = to_message(item, seq, kind, 1)
            kept = mission_items.write(mission_items.parse(message, True), seq, False, kind, True, (0, 0))
            alike = _alike(mission_items.parse(kept, True), back, kind)
        if not alike:
            return f"item {seq + 1} came back as {back}, not as {item}"
    return ""


def _at_one_place(a: PlanItem, b: PlanItem) -> bool:
    return max(abs(a.x - b.x), abs(a.y - b.y)) <= _PLACE_TOLERANCE


def _alike(a: PlanItem, b: PlanItem, kind: int) -> bool:
    if (a.command, _FRAMES.get(a.frame)) != (b.command, _FRAMES.get(b.frame)):
        return False
    if kind == plan.MISSION and a.autocontinue != b.autocontinue:
        return False
    if a.frame != FRAME_MISSION and not _at_one_place(a, b):
        return False
    numbers = zip((*a.params, a.z), (*b.params, b.z), strict=True)
    return all(math.isclose(x, y, rel_tol=_NUMBER_TOLERANCE, abs_tol=1e-6) or (x != x and y != y) for x, y in numbers)


def cancel(system: int) -> list[Any]:
    """Return what ends whatever transfer the autopilot of ``system`` has with us."""
    cancelled = mavlink.MAV_MISSION_OPERATION_CANCELLED
    return [mavlink.MAVLink_mission_ack_message(system, _AUTOPILOT, cancelled, kind) for kind in plan.KINDS]


# ---- one list


def _upload(system: int, kind: int, items: Items, progress: Progress) -> Exchange[None]:
    """Send a list once.

    Raises:
        RefusalError: the vehicle does not take it.
    """
    count = len(items)
    outgoing: list[Any] = [mavlink.MAVLink_mission_count_message(system, _AUTOPILOT, count, kind)]
    first = outgoing[0]
    asked = sent = -1  # the item asked for last, and the furthest that was sent
    while True:
        answer = yield outgoing
        outgoing = []
        if answer is None:
            if asked < 0:
                outgoing = [first]
            else:
                sent = min(sent + 1, count - 1)
                outgoing = [to_message(items[seq], seq, kind, system) for seq in range(asked, sent + 1)]
        elif getattr(answer, "mission_type", None) != kind:
            continue
        elif _is(answer, "MISSION_ACK"):
            if answer.type == mavlink.MAV_MISSION_ACCEPTED and sent == count - 1:
                return
            # with all items sent, an error may answer one that was sent twice: what comes back will tell
            if answer.type == mavlink.MAV_MISSION_ERROR and count and sent == count - 1:
                return
            if answer.type != mavlink.MAV_MISSION_ACCEPTED:
                raise _refusal(answer.type, kind, asked, items)
        elif _is(answer, "MISSION_REQUEST", "MISSION_REQUEST_INT") and answer.seq < count:
            asked = answer.seq
            sent = max(sent, asked)
            progress(f"sending {KINDS[kind]}", asked, count)
            outgoing = [to_message(items[asked], asked, kind, system)]


def _is(message: Any, *names: str) -> bool:
    return type(message).__name__ in names


def _refusal(result: int, kind: int, asked: int, items: Items) -> RefusalError:
    entry = mavlink.enums["MAV_MISSION_RESULT"].get(result)
    name = entry.name if entry is not None else f"result {result}"
    where = f"item {asked + 1} (command {items[asked].command})" if 0 <= asked < len(items) else f"{len(items)} items"
    return RefusalError(f"{KINDS[kind]}: the vehicle refuses {where}: {name}", result not in _RETRIED)


def _download(system: int, kind: int, progress: Progress) -> Exchange[Items]:
    """Ask for a list once.

    Raises:
        RefusalError: the vehicle does not tell it.
    """
    first = mavlink.MAVLink_mission_request_list_message(system, _AUTOPILOT, kind)
    items: list[PlanItem] = []
    count = -1
    silent = 0
    outgoing = [first]
    while count < 0 or len(items) < count:
        answer = yield outgoing
        outgoing = []
        if answer is None:
            silent += 1
            if silent > _PATIENT_REPEATS:
                raise RefusalError(f"{KINDS[kind]}: the vehicle has ended the transfer", False)
            outgoing = [first if count < 0 else _request(system, len(items), kind)]
        elif getattr(answer, "mission_type", None) != kind:
            continue
        elif _is(answer, "MISSION_COUNT") and count < 0:
            count = answer.count
            outgoing = [_request(system, 0, kind)] if count else []
        elif _is(answer, "MISSION_ITEM_INT") and answer.seq == len(items) and count > 0:
            silent = 0
            items.append(_parse(answer, kind))
            progress(f"reading {KINDS[kind]}", len(items), count)
            outgoing = [_request(system, len(items), kind)] if len(items) < count else []
        elif _is(answer, "MISSION_ACK") and answer.type != mavlink.MAV_MISSION_ACCEPTED:
            raise _refusal(answer.type, kind, -1, ())
    return tuple(items)


def _parse(message: Any, kind: int) -> PlanItem:
    try:
        return mission_items.parse(message, True)
    except mission_items.ItemError as error:
        raise RefusalError(f"{KINDS[kind]}: item {message.seq + 1} of the vehicle: {error}", True) from error


def _request(system: int, seq: int, kind: int) -> Any:
    return mavlink.MAVLink_mission_request_int_message(system, _AUTOPILOT, seq, kind)


def _closing(system: int, kind: int) -> list[Any]:
    return [mavlink.MAVLink_mission_ack_message(system, _AUTOPILOT, mavlink.MAV_MISSION_ACCEPTED, kind)]


def _repeat(system: int, once: Callable[[], Exchange[T]]) -> Exchange[T]:
    """Run an exchange again and again until it comes to its end, or to a refusal that is final.

    Raises:
        RefusalError: the last one.
    """
    for attempt in range(_ATTEMPTS):
        try:
            return (yield from once())
        except RefusalError as error:
            if error.final or attempt == _ATTEMPTS - 1:
                raise
        # what is under way ends, and what is still to come of it is heard out
        answer = yield cancel(system)
        while answer is not None:
            answer = yield []
    raise AssertionError("unreachable")


def _with_home(items: Items, home: Place) -> Items:
    """Return an ArduPilot's mission: its home, and a plan's items behind it."""
    first = PlanItem(plan.WAYPOINT, FRAME_GLOBAL, (0.0,) * 4, *home)
    return (first, *(_jumping(item, 1.0) for item in items)) if items else ()


def _without_home(items: Items) -> Items:
    """Return a plan's items of an ArduPilot's mission."""
    return tuple(_jumping(item, -1.0) for item in items[1:])


def _jumping(item: PlanItem, further: float) -> PlanItem:
    """Return an item; if it jumps, to a place in the list that is ``further``."""
    if item.command != plan.JUMP:
        return item
    return replace(item, params=(item.params[0] + further, *item.params[1:]))


def store(
    system: int,
    kind: int,
    items: Items,
    progress: Progress = nobody,
    autopilot: int = _PX4,
    home: Place = (0.0, 0.0, 0.0),
) -> Exchange[None]:
    """Replace a list of the vehicle, and see that it has come whole.

    Args:
        system: its MAVLink system id.
        kind: MAV_MISSION_TYPE.
        items: the list, as a plan holds it.
        progress: told of it.
        autopilot: MAV_AUTOPILOT.
        home: latitude, longitude, degrees, m AMSL: for the first item of an ArduPilot's mission.

    Raises:
        RefusalError: the vehicle does not take it.
    """
    with_home = autopilot == _ARDUPILOT and kind == plan.MISSION
    sent = _with_home(items, home) if with_home else items

    def once() -> Exchange[None]:
        yield from _upload(system, kind, sent, progress)
        found = yield from _download(system, kind, progress)
        yield from _say(_closing(system, kind))
        wrong = difference(items, _without_home(found) if with_home else found, kind, autopilot)
        if wrong:
            raise RefusalError(f"{KINDS[kind]}: {wrong}", False)

    yield from _repeat(system, once)


def fetch(system: int, kind: int, progress: Progress = nobody, autopilot: int = _PX4) -> Exchange[Items]:
    """Return a list of the vehicle, as a plan holds it; ``autopilot``: MAV_AUTOPILOT.

    Raises:
        RefusalError: the vehicle does not tell it.
    """
    found = yield from _repeat(system, lambda: _download(system, kind, progress))
    yield from _say(_closing(system, kind))
    return _without_home(found) if autopilot == _ARDUPILOT and kind == plan.MISSION else found


class Say(list[Any]):
    """Messages that nobody answers: whoever runs the exchange sends them and goes on at once."""


def _say(messages: list[Any]) -> Exchange[None]:
    yield Say(messages)


# ---- whole plans


def check_kinds(content: Plan) -> str:
    """Return which list of a plan is longer than a PX4 takes, empty for none."""
    for kind in plan.KINDS:
        count = len(content.items(kind))
        if count > plan.CAPACITY[kind]:
            return f"{KINDS[kind]}: {count} items are not allowed, at most {plan.CAPACITY[kind]}"
    return ""


def store_plan(system: int, content: Plan, progress: Progress = nobody, autopilot: int = _PX4) -> Exchange[None]:
    """Give a vehicle all three lists of a plan, also empty ones, as QGroundControl does; see ``store``.

    Raises:
        RefusalError: it does not take one of them.
    """
    for kind in plan.KINDS:
        yield from store(system, kind, content.items(kind), progress, autopilot, content.home)


def fetch_plan(system: int, progress: Progress = nobody, autopilot: int = _PX4) -> Exchange[Plan]:
    """Return the plan that a vehicle has; see ``fetch``.

    Raises:
        RefusalError: it does not tell one of the lists.
    """
    lists = []
    for kind in plan.KINDS:
        lists.append((yield from fetch(system, kind, progress, autopilot)))
    home = yield from _fetch_home(system)
    return Plan(lists[0], lists[1], lists[2], home, firmware=autopilot if autopilot == _ARDUPILOT else _PX4)


def _fetch_home(system: int) -> Exchange[Place]:
    """Return the vehicle's home: latitude, longitude, degrees, m AMSL; zeros when it has none."""
    home = yield from request(system, "HOME_POSITION")
    return (0.0, 0.0, 0.0) if home is None else (home.latitude * 1e-7, home.longitude * 1e-7, home.altitude * 1e-3)


def clear(system: int, progress: Progress = nobody, autopilot: int = _PX4) -> Exchange[None]:
    """Empty all lists of a vehicle; ``autopilot``: MAV_AUTOPILOT.

    Raises:
        RefusalError: it does not.
    """

    def once() -> Exchange[None]:
        ask = mavlink.MAVLink_mission_clear_all_message(system, _AUTOPILOT, _ALL)
        progress("clearing", 0, 1)
        answer = yield [ask]
        while not (_is(answer, "MISSION_ACK") and answer.mission_type == _ALL):
            answer = yield [*cancel(system), ask] if answer is None else []
        if answer.type != mavlink.MAV_MISSION_ACCEPTED:
            raise RefusalError(f"the vehicle does not clear its plan: result {answer.type}", False)

    yield from _repeat(system, once)
    for kind in plan.KINDS:
        left = yield from fetch(system, kind, progress, autopilot)
        if left:
            raise RefusalError(f"{KINDS[kind]}: {len(left)} items are left after the clearing", True)
