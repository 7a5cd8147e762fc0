"""Client operations of the rosbridge protocol, version 2: parsing and validation, without ROS.

Source: ROSBRIDGE_PROTOCOL.md of RobotWebTools/rosbridge_suite, branch ros1. An operation is a JSON object in a text
frame.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

from xtdrone_common.files import shortened

COMPRESSIONS = ("none", "png", "cbor", "cbor-raw")
LEVELS = ("none", "error", "warning", "info")
"""Levels of status messages; each includes those before it."""
_SHOWN = 80  # characters of a value quoted in an error
_MAX_TIME = 3_600_000  # ms of throttle_rate
_MAX_QUEUE = 10_000  # messages
_FRAGMENTS = "fragments are not supported, send and request complete messages"
_REFUSED = {
    "fragment": _FRAGMENTS,
    "png": "PNG operations are not accepted from clients, send JSON",
    "auth": "this server has no passwords, see docs/bridges.md on who may connect",
    "cancel_action_goal": "the protocol has no actions for ROS 1, use the action's topics",
    "send_action_goal": "the protocol has no actions for ROS 1, use the action's topics",
    "advertise_action": "the protocol has no actions for ROS 1, use the action's topics",
}


class OperationError(ValueError):
    """A rejected operation.

    Attributes:
        id: the client's id for it, if given.
    """

    def __init__(self, text: str, id_: str | int | None = None) -> None:
        super().__init__(text)
        self.id = id_


class _Field(NamedTuple):
    """A field of an operation.

    Attributes:
        kinds: the allowed types.
        allowed: the same in words, with the range.
        default: value of a missing or null field; required if there is none.
        choices: the allowed values; all by default.
        low, high: inclusive limits of numbers.
    """

    kinds: tuple[type, ...]
    allowed: str
    default: Any = ...
    choices: tuple[Any, ...] = ()
    low: float = 0
    high: float = _MAX_QUEUE

    def checked(self, name: str, value: Any) -> Any:
        """Return an allowed value.

        Raises:
            ValueError: it is not allowed.
        """
        if value is None and self.default is not ...:
            return self.default
        fits = isinstance(value, self.kinds) and (bool in self.kinds or not isinstance(value, bool))
        if fits and self.choices:
            fits = value in self.choices
        if fits and isinstance(value, (int, float)) and not isinstance(value, bool):
            fits = self.low <= value <= self.high
        if not fits:
            raise ValueError(f"{name}: {shown(value)} is not allowed, {self.allowed}")
        return value


_NAME = _Field((str,), "a name")
_TYPE = _Field((str,), "a type such as std_msgs/String", None)
_FLAG = _Field((bool,), "true or false", False)
_QUEUE = _Field((int,), f"a whole number from 0 to {_MAX_QUEUE}", 0)
_NO_FRAGMENTS = _Field((), _FRAGMENTS, None)
_COMPRESSION = _Field((str,), "none, png, cbor or cbor-raw", "none", COMPRESSIONS)
_OPERATIONS: Mapping[str, Mapping[str, _Field]] = {
    "advertise": {
        "topic": _NAME,
        "type": _TYPE._replace(default=...),
        "latch": _FLAG,
        "queue_size": _QUEUE._replace(default=100),
    },
    "unadvertise": {"topic": _NAME},
    "publish": {"topic": _NAME, "msg": _Field((dict,), "an object with the message's fields", {}), "latch": _FLAG},
    "subscribe": {
        "topic": _NAME,
        "type": _TYPE,
        "throttle_rate": _Field((int, float), f"milliseconds from 0 to {_MAX_TIME}", 0, high=_MAX_TIME),
        "queue_length": _QUEUE,
        "fragment_size": _NO_FRAGMENTS,
        "compression": _COMPRESSION,
    },
    "unsubscribe": {"topic": _NAME},
    "call_service": {
        "service": _NAME,
        "type": _TYPE,
        "args": _Field((dict, list), "an object, or a list of the fields' values in order", {}),
        "timeout": _Field((int, float), "seconds from 0 to 3600", None, high=3600),
        "fragment_size": _NO_FRAGMENTS,
        "compression": _COMPRESSION._replace(allowed="none or png", choices=("none", "png")),
    },
    "advertise_service": {"service": _NAME, "type": _TYPE._replace(default=...)},
    "unadvertise_service": {"service": _NAME},
    "service_response": {
        "service": _NAME,
        "values": _Field((dict, str), "an object with the response's fields", {}),
        "result": _FLAG._replace(default=True),
    },
    "set_level": {"level": _Field((str,), ", ".join(LEVELS), choices=LEVELS)},
}


@dataclass(frozen=True)
class Operation:
    """A valid operation.

    Attributes:
        op: its name.
        id: the client's id for it, if given.
        fields: its known fields, with the defaults of those not given.
    """

    op: str
    id: str | int | None
    fields: Mapping[str, Any]

    def __getitem__(self, name: str) -> Any:
        return self.fields[name]


def shown(value: object) -> str:
    """Return a value for a message, truncated if long."""
    return shortened(repr(value), _SHOWN)


def parse_operation(frame: str | bytes) -> Operation:
    """Return the operation in a frame.

    Raises:
        OperationError: not an operation, an unknown or unsupported one, or a field that is missing or not allowed.
    """
    given = _object(frame)
    id_ = given.get("id")
    if not (id_ is None or isinstance(id_, str) or type(id_) is int):
        raise OperationError(f"id: {shown(id_)} is not allowed, text or a whole number")
    op = given.get("op")
    if isinstance(op, str) and op in _REFUSED:
        raise OperationError(f"{op}: {_REFUSED[op]}", id_)
    fields = _OPERATIONS.get(op) if isinstance(op, str) else None
    if fields is None:
        raise OperationError(f"op: {shown(op)} is not allowed, {', '.join(_OPERATIONS)}", id_)
    try:
        values = {name: field.checked(name, given.get(name)) for name, field in fields.items()}
    except ValueError as error:
        raise OperationError(f"{op}: {error}", id_) from error
    return Operation(str(op), id_, values)


def _object(frame: str | bytes) -> dict[str, Any]:
    """Return the JSON object in a frame.

    Raises:
        OperationError: there is none.
    """
    if isinstance(frame, bytes):
        raise OperationError("binary frame: not accepted from a client, send JSON in a text frame")
    try:
        given = json.loads(frame, parse_constant=_no_number)
    except (ValueError, RecursionError) as error:
        text = "nested too deep" if isinstance(error, RecursionError) else str(error)
        raise OperationError(f"frame: {shown(frame)} is not JSON: {text}") from error
    if not isinstance(given, dict):
        raise OperationError(f"frame: {shown(given)} is not allowed, a JSON object with a field op")
    return given


def _no_number(name: str) -> float:
    raise ValueError(f"{name} is no JSON number, null stands for it")
