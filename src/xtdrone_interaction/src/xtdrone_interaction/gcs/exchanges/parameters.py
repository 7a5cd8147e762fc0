"""Exchanges of MAVLink's parameter protocol (https://mavlink.io/en/services/parameter.html).

Messages carry every value as a float; for an integer PX4 reinterprets its bytes ("bytewise"). A request for an unknown
name has no answer, so it is repeated a few times and then given up.
"""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from itertools import islice
from typing import Any

from pymavlink.dialects.v20 import common as mavlink

from xtdrone_autopilot.parameters import former_parameters
from xtdrone_autopilot.parameters.dependent_parameters import in_order
from xtdrone_autopilot.parameters.parameter_file import LIMITS, REAL32, ParameterFile, Value, as_float32, checked, shown

from .exchange import AUTOPILOT, Exchange, Heartbeat, Progress, RefusalError, ignore_progress

IDENTITY = ("MAV_SYS_ID", "MAV_COMP_ID")
"""Parameters that identify a vehicle; they are never copied to another one."""
STACK = "PX4 Pro"
"""Name of the autopilot in QGroundControl's files."""

_NO_INDEX = 0xFFFF
_BATCH = 50  # parameters per request, or per change
_UNANSWERED = 15  # consecutive unanswered requests before giving up
_OTHER_ANSWERS = 5  # with another value, before a change counts as rejected
_HEADERS = {0xFD: 10, 0xFE: 6}  # bytes before the payload, by first byte of the frame
_CODES = {1: "B", 2: "b", 3: "H", 4: "h", 5: "I", 6: "i"}


def decode(message: Any) -> Value:
    """Return the value in a PARAM_VALUE message."""
    kind = message.param_type
    if kind not in LIMITS:
        return as_float32(message.param_value), REAL32
    frame = bytes(message.get_msgbuf())  # not the float: some integers are NaNs, whose bits may change
    return struct.unpack_from(f"<{_CODES[kind]}", frame, _HEADERS[frame[0]])[0], kind


def encode(value: Value) -> float:
    """Return the float for a value in a PARAM_SET message."""
    number, kind = value
    if kind == REAL32:
        return float(number)
    raw = struct.pack(f"<{_CODES[kind]}", int(number)).ljust(4, b"\0")
    found: float = struct.unpack("<f", raw)[0]
    return found


def _name_of(answer: Any) -> str:
    """Return the name in a PARAM_VALUE message; empty for other messages."""
    return str(answer.param_id) if hasattr(answer, "param_id") else ""


def _read_message(heartbeat: Heartbeat, name: str, index: int = -1) -> Any:
    return mavlink.MAVLink_param_request_read_message(heartbeat.system, AUTOPILOT, name.encode(), index)


def _batches(names: Iterable[str]) -> Iterator[list[str]]:
    rest = iter(names)
    while batch := list(islice(rest, _BATCH)):
        yield batch


def _answer_batch(
    names: Iterable[str], ask: Callable[[str], Any], accept: Callable[[str, Value], bool]
) -> Exchange[list[str]]:
    """Repeat a request for each name until its answer is accepted; return the names that stay without an answer."""
    missing = dict.fromkeys(names)
    unanswered = 0
    outgoing = [ask(name) for name in missing]
    while missing and unanswered <= _UNANSWERED:
        answer = yield outgoing
        outgoing = []
        name = _name_of(answer)
        if name in missing and accept(name, decode(answer)):
            del missing[name]
            unanswered = 0
        elif answer is None:
            unanswered += 1
            outgoing = [ask(name) for name in missing]
    return list(missing)


def fetch(
    heartbeat: Heartbeat, names: Iterable[str], progress: Progress = ignore_progress
) -> Exchange[dict[str, Value]]:
    """Return some parameters by name.

    Raises:
        RefusalError: the vehicle does not send one of them.
    """
    wanted = list(dict.fromkeys(names))
    found: dict[str, Value] = {}

    def accept(name: str, value: Value) -> bool:
        found[name] = value
        progress("reading parameters", len(found), len(wanted))
        return True

    for batch in _batches(wanted):
        missing = yield from _answer_batch(batch, lambda name: _read_message(heartbeat, name), accept)
        if missing:
            raise RefusalError(f"parameters: the vehicle sends no value of {', '.join(missing)}", True)
    return {name: found[name] for name in wanted}


def fetch_all(heartbeat: Heartbeat, progress: Progress = ignore_progress) -> Exchange[dict[str, Value]]:
    """Return all parameters by name.

    Raises:
        RefusalError: the vehicle does not send all of them.
    """
    whole = [mavlink.MAVLink_param_request_list_message(heartbeat.system, AUTOPILOT)]
    found: dict[int, tuple[str, Value]] = {}
    count = unanswered = 0
    listing, news = True, False  # whether the list may still be arriving; any value since the last timeout
    asked: set[int] = set()  # indices requested one by one, after the list
    outgoing: list[Any] = whole
    while not count or len(found) < count:
        answer = yield outgoing
        outgoing = []
        if answer is not None:
            if not _name_of(answer) or answer.param_index == _NO_INDEX:
                continue
            count, news = answer.param_count, True
            found[answer.param_index] = answer.param_id, decode(answer)
            asked.discard(answer.param_index)
            progress("reading parameters", len(found), count)
            if listing or asked:
                continue
        elif news:
            unanswered, news = 0, False
            if listing:
                continue
        else:
            unanswered += 1
        if unanswered > _UNANSWERED:
            raise RefusalError(f"parameters: the vehicle has sent {len(found)} of {count or 'them'}", True)
        listing = not count
        asked = set([i for i in range(count) if i not in found][:_BATCH])
        outgoing = whole if listing else [_read_message(heartbeat, "", i) for i in sorted(asked)]
    return dict(found.values())


def store(
    heartbeat: Heartbeat, values: Mapping[str, Value], progress: Progress = ignore_progress
) -> Exchange[dict[str, str]]:
    """Set parameters and check the vehicle's confirmations.

    Args:
        heartbeat: of the vehicle.
        values: by name, with the vehicle's types.
        progress: callback.

    Returns:
        Reasons of failures by name; empty for none.
    """
    failed: dict[str, str] = {}
    others: Counter[str] = Counter()  # confirmations with another value, by name
    done: set[str] = set()

    def ask(name: str) -> Any:
        number = encode(values[name])
        return mavlink.MAVLink_param_set_message(heartbeat.system, AUTOPILOT, name.encode(), number, values[name][1])

    def accept(name: str, value: Value) -> bool:
        if value[0] != values[name][0]:
            others[name] += 1
            if others[name] < _OTHER_ANSWERS:
                return False
            failed[name] = f"{shown(*values[name])} is rejected, {shown(*value)} is kept"
        done.add(name)
        progress("setting parameters", len(done), len(values))
        return True

    for batch in _batches(values):
        missing = yield from _answer_batch(batch, ask, accept)
        failed |= dict.fromkeys(missing, "the vehicle does not accept it")
    return failed


def change(heartbeat: Heartbeat, name: str, value: float) -> Exchange[tuple[Value, Value]]:
    """Set one parameter and return the old and the new value.

    Raises:
        RefusalError: the vehicle does not have the parameter, or rejects the value.
    """
    old = (yield from fetch(heartbeat, [name]))[name]
    try:
        new = checked(value, old[1]), old[1]
    except ValueError as error:
        raise RefusalError(f"{name}: {value:g} is not allowed, {error}", True) from error
    failed = yield from store(heartbeat, {name: new})
    if failed:
        raise RefusalError(f"{name}: {failed[name]}", True)
    return old, new


# files


def save(heartbeat: Heartbeat, progress: Progress = ignore_progress) -> Exchange[ParameterFile]:
    """Return all parameters of a vehicle as the content of a file.

    Raises:
        RefusalError: the vehicle does not send all of them.
    """
    values = yield from fetch_all(heartbeat, progress)
    return ParameterFile(heartbeat.system, values, STACK)


def differences(content: ParameterFile, present: Mapping[str, Value]) -> dict[str, tuple[Value, Value | None]]:
    """Compare a file with a vehicle: differing values by name, the file's and the vehicle's (None for none)."""
    found: dict[str, tuple[Value, Value | None]] = {}
    for name, value in content.values.items():
        there = present.get(name)
        if there is None or there[0] != value[0]:
            found[name] = value, there
    return found


@dataclass(frozen=True)
class Loaded:
    """Result of setting a vehicle's parameters to a file's.

    Attributes:
        changed: old and new value of each changed parameter by name.
        skipped: descriptions of the rows of the file that are not set.
    """

    changed: dict[str, tuple[Value, Value]]
    skipped: tuple[str, ...] = ()


def check(
    content: ParameterFile, heartbeat: Heartbeat, present: Mapping[str, Value], of_another: bool
) -> tuple[dict[str, Value], tuple[str, ...]]:
    """Return the changes that make a vehicle's parameters equal to a file's, and what of the file is left out.

    Left out are, as in QGroundControl, the parameters that the vehicle does not have or has with another type.

    Args:
        content: of the file.
        heartbeat: of the vehicle.
        present: all parameters of the vehicle.
        of_another: accept the file of another vehicle; ``IDENTITY`` stays unchanged then.

    Raises:
        RefusalError: the file belongs to another vehicle or autopilot, or the vehicle has none of its parameters.
    """
    if content.stack and content.stack.split()[0] != STACK.split()[0]:
        raise RefusalError(f"the file is of {content.stack}, this is {STACK}", True)
    if content.system != heartbeat.system and not of_another:
        raise RefusalError(f"the file is of vehicle {content.system}, this is system {heartbeat.system}; "
                           "--of-another loads it without the vehicle's identity", True)  # fmt: skip
    skipped = list(content.skipped)
    changes: dict[str, Value] = {}
    for name, (value, there) in differences(content, present).items():
        if there is None:
            skipped.append(f"{name} does not exist{former_parameters.hint(name)}")
        elif there[1] != value[1]:
            skipped.append(f"{name} is of type {value[1]} in the file, of type {there[1]} in the vehicle")
        elif name not in IDENTITY:
            changes[name] = value
    if not content.values.keys() & present.keys():
        raise RefusalError(
            f"the vehicle has none of the file's parameters, for example {next(iter(content.values))}", True
        )
    return {name: changes[name] for name in in_order(changes)}, tuple(skipped)


def load(
    heartbeat: Heartbeat, content: ParameterFile, of_another: bool, progress: Progress = ignore_progress
) -> Exchange[Any]:
    """Set a vehicle's parameters to a file's; see ``check``.

    Returns:
        What is changed and what is skipped, as ``Loaded``.

    Raises:
        RefusalError: the file does not fit the vehicle, or the vehicle has rejected some values; the rest are set then.
    """
    present = yield from fetch_all(heartbeat, progress)
    changes, skipped = check(content, heartbeat, present, of_another)
    failed = yield from store(heartbeat, changes, progress)
    if failed:
        text = "; ".join(f"{name}: {reason}" for name, reason in failed.items())
        raise RefusalError(f"{len(changes) - len(failed)} of {len(changes)} parameters are set; {text}", True)
    return Loaded({name: (present[name], value) for name, value in changes.items()}, skipped)
