"""Parameters of a vehicle, read and written: exchanges of MAVLink's parameter protocol.

A value is a float on the wire whatever its type: PX4 has an integer's bytes there (bytewise), ArduPilot its number (C
cast). The protocol (https://mavlink.io/en/services/parameter.html) says nothing when a name is unknown, so who gets no
answer can only ask again, and then give up.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Mapping
from typing import Any

from pymavlink.dialects.v20 import common as mavlink

from xtdrone_control.parameter_text import LIMITS, REAL32, ParameterFile, Value, as_float32, checked, shown

from .exchanges import Beat, Exchange, Progress, RefusalError, nobody, request

IDENTITY = ("MAV_SYS_ID", "MAV_COMP_ID", "SYSID_THISMAV", "MAV_SYSID")
"""Parameters that say who a vehicle is; no other vehicle may have them."""
STACKS = {mavlink.MAV_AUTOPILOT_PX4: "PX4 Pro", mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA: "ArduPilot"}
"""What QGroundControl's files call an autopilot (MAV_AUTOPILOT)."""

_AUTOPILOT = mavlink.MAV_COMP_ID_AUTOPILOT1
_NO_INDEX = 0xFFFF
_BATCH = 50  # parameters that are asked for, or set, at a time
_FRUITLESS = 15  # requests in a row without an answer until nothing more is hoped for
_OTHER_ANSWERS = 5  # of another value, until a parameter counts as not taken
_HEADERS = {0xFD: 10, 0xFE: 6}  # bytes before the payload, by a frame's first
_CODES = {1: "B", 2: "b", 3: "H", 4: "h", 5: "I", 6: "i"}


def decode(message: Any, bytewise: bool) -> Value:
    """Return the value that a PARAM_VALUE tells."""
    kind = message.param_type
    if kind not in LIMITS:
        return as_float32(message.param_value), REAL32
    if not bytewise:
        return round(message.param_value), kind
    frame = bytes(message.get_msgbuf())  # the bytes themselves: some are a NaN's
    return struct.unpack_from(f"<{_CODES[kind]}", frame, _HEADERS[frame[0]])[0], kind


def encode(value: Value, bytewise: bool) -> float:
    """Return what stands for a value in PARAM_SET."""
    number, kind = value
    if kind == REAL32 or not bytewise:
        return float(number)
    raw = struct.pack(f"<{_CODES[kind]}", int(number)).ljust(4, b"\0")
    found: float = struct.unpack("<f", raw)[0]
    return found


def bytewise_of(beat: Beat) -> Exchange[bool]:
    """Return whether a vehicle tells integers by their bytes."""
    if beat.autopilot in STACKS:
        return beat.autopilot == mavlink.MAV_AUTOPILOT_PX4
    version = yield from request(beat.system, "AUTOPILOT_VERSION")
    flag = mavlink.MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_BYTEWISE
    return version is not None and bool(version.capabilities & flag)


def _name_of(answer: Any) -> str:
    """Return the name that a PARAM_VALUE is of, empty for another message."""
    return str(answer.param_id) if hasattr(answer, "param_id") else ""


def _read_message(beat: Beat, name: str, index: int = -1) -> Any:
    return mavlink.MAVLink_param_request_read_message(beat.system, _AUTOPILOT, name.encode(), index)


def fetch(beat: Beat, names: Iterable[str], progress: Progress = nobody) -> Exchange[dict[str, Value]]:
    """Return some parameters, by name.

    Raises:
        RefusalError: the vehicle does not tell one of them.
    """
    wanted = list(dict.fromkeys(names))
    bytewise = yield from bytewise_of(beat)
    found: dict[str, Value] = {}
    for start in range(0, len(wanted), _BATCH):
        missing = dict.fromkeys(wanted[start : start + _BATCH])
        fruitless = 0
        outgoing = [_read_message(beat, name) for name in missing]
        while missing:
            answer = yield outgoing
            outgoing = []
            if _name_of(answer) in missing:
                found[answer.param_id] = decode(answer, bytewise)
                del missing[answer.param_id]
                fruitless = 0
                progress("reading parameters", len(found), len(wanted))
            elif answer is None:
                fruitless += 1
                if fruitless > _FRUITLESS:
                    raise RefusalError(f"parameters: the vehicle tells nothing of {', '.join(missing)}", True)
                outgoing = [_read_message(beat, name) for name in missing]
    return {name: found[name] for name in wanted}


def fetch_all(beat: Beat, progress: Progress = nobody) -> Exchange[dict[str, Value]]:
    """Return all parameters, by name.

    Raises:
        RefusalError: the vehicle does not tell all of them.
    """
    bytewise = yield from bytewise_of(beat)
    whole = [mavlink.MAVLink_param_request_list_message(beat.system, _AUTOPILOT)]
    found: dict[int, tuple[str, Value]] = {}
    count = fruitless = 0
    listing, news = True, False  # the list may still be coming; something has come since the last time-out
    asked: set[int] = set()  # after the list: what was lost, part by part
    outgoing: list[Any] = whole
    while not count or len(found) < count:
        answer = yield outgoing
        outgoing = []
        if answer is not None:
            if not _name_of(answer) or answer.param_index == _NO_INDEX:
                continue
            count, news = answer.param_count, True
            found[answer.param_index] = answer.param_id, decode(answer, bytewise)
            asked.discard(answer.param_index)
            progress("reading parameters", len(found), count)
            if listing or asked:
                continue
        elif news:
            fruitless, news = 0, False
            if listing:
                continue
        else:
            fruitless += 1
        if fruitless > _FRUITLESS:
            raise RefusalError(f"parameters: the vehicle tells {len(found)} of {count or 'them'}", True)
        listing = not count
        asked = set([i for i in range(count) if i not in found][:_BATCH])
        outgoing = whole if listing else [_read_message(beat, "", i) for i in sorted(asked)]
    return dict(found.values())


def store(beat: Beat, values: Mapping[str, Value], progress: Progress = nobody) -> Exchange[dict[str, str]]:
    """Set parameters, and see that the vehicle has them.

    Args:
        beat: of the vehicle.
        values: by name, of the types that the vehicle has.
        progress: told of it.

    Returns:
        By name why some were not taken; empty when all were.
    """
    bytewise = yield from bytewise_of(beat)
    failed: dict[str, str] = {}
    names = list(values)
    for start in range(0, len(names), _BATCH):
        missing = dict.fromkeys(names[start : start + _BATCH], 0)  # how often each came back as something else
        fruitless = 0
        outgoing = [_set_message(beat, name, values[name], bytewise) for name in missing]
        while missing:
            answer = yield outgoing
            outgoing = []
            name = _name_of(answer)
            if name in missing:
                told = decode(answer, bytewise)
                if told[0] != values[name][0]:
                    missing[name] += 1
                    if missing[name] < _OTHER_ANSWERS:
                        continue
                    failed[name] = f"{shown(*values[name])} is not taken, {shown(*told)} stays"
                del missing[name]
                fruitless = 0
                progress("setting parameters", start + _BATCH - len(missing), len(names))
            elif answer is None:
                fruitless += 1
                if fruitless > _FRUITLESS:
                    failed |= dict.fromkeys(missing, "the vehicle does not take it")
                    break
                outgoing = [_set_message(beat, each, values[each], bytewise) for each in missing]
    return failed


def _set_message(beat: Beat, name: str, value: Value, bytewise: bool) -> Any:
    return mavlink.MAVLink_param_set_message(beat.system, _AUTOPILOT, name.encode(), encode(value, bytewise), value[1])


def change(beat: Beat, name: str, value: float) -> Exchange[tuple[Value, Value]]:
    """Set one parameter; return what it was and what it is.

    Raises:
        RefusalError: the vehicle has none of that name, or does not take the value.
    """
    old = (yield from fetch(beat, [name]))[name]
    try:
        new = checked(value, old[1]), old[1]
    except ValueError as error:
        raise RefusalError(f"{name}: {value:g} is not allowed, {error}", True) from error
    failed = yield from store(beat, {name: new})
    if failed:
        raise RefusalError(f"{name}: {failed[name]}", True)
    return old, new


# ---- files


def save(beat: Beat, progress: Progress = nobody) -> Exchange[ParameterFile]:
    """Return all parameters of a vehicle as a file holds them.

    Raises:
        RefusalError: it does not tell all of them.
    """
    values = yield from fetch_all(beat, progress)
    return ParameterFile(beat.system, values, STACKS.get(beat.autopilot, ""))


def differences(content: ParameterFile, present: Mapping[str, Value]) -> dict[str, tuple[Value, Value | None]]:
    """Return what a file has otherwise than a vehicle: by name the file's value and the vehicle's, None for none."""
    found: dict[str, tuple[Value, Value | None]] = {}
    for name, value in content.values.items():
        there = present.get(name)
        if there is None or there[0] != value[0]:
            found[name] = value, there
    return found


def check(content: ParameterFile, beat: Beat, present: Mapping[str, Value], of_another: bool) -> dict[str, Value]:
    """Return what is to be set so that a vehicle has what a file holds.

    Args:
        content: the file's.
        beat: of the vehicle.
        present: all that it has.
        of_another: whether the file may be another vehicle's; who it is stays as it is, then.

    Raises:
        RefusalError: the file is of another vehicle, or of another kind of autopilot.
    """
    stack = STACKS.get(beat.autopilot, "")
    if content.stack and stack and content.stack.split()[0] != stack.split()[0]:
        raise RefusalError(f"the file is of {content.stack}, this is {stack}", True)
    if content.system != beat.system and not of_another:
        raise RefusalError(f"the file is of vehicle {content.system}, this is system {beat.system}; "
                           "--of-another loads it without what says who a vehicle is", True)  # fmt: skip
    changes = differences(content, present)
    unknown = [name for name, (_, there) in changes.items() if there is None]
    if unknown:
        more = f" and {len(unknown) - 5} more" if len(unknown) > 5 else ""
        raise RefusalError(f"the vehicle has no {', '.join(unknown[:5])}{more}", True)
    for name, (value, there) in changes.items():
        if there is not None and there[1] != value[1]:
            raise RefusalError(f"{name} is of type {value[1]} in the file, of type {there[1]} in the vehicle", True)
    return {name: value for name, (value, _) in changes.items() if name not in IDENTITY}


def load(beat: Beat, content: ParameterFile, of_another: bool, progress: Progress = nobody) -> Exchange[Any]:
    """Give a vehicle what a file holds; see ``check``. Nothing is set unless all of it may be.

    Returns:
        What was set: by name what it was and what it is.

    Raises:
        RefusalError: the file is not for this vehicle, or some values were not taken; the others are set then.
    """
    present = yield from fetch_all(beat, progress)
    changes = check(content, beat, present, of_another)
    failed = yield from store(beat, changes, progress)
    if failed:
        text = "; ".join(f"{name}: {reason}" for name, reason in failed.items())
        raise RefusalError(f"{len(changes) - len(failed)} of {len(changes)} parameters are set; {text}", True)
    return {name: (present[name], value) for name, value in changes.items()}
