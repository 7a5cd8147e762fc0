"""Catalogue of the autopilot's events: their arguments, and their messages for ground stations.

Names, which determine the event numbers, types and order of the arguments, and the texts of the arming checks are PX4
v1.14's; the other messages are written for this project. ``tables/events.csv`` has them in libevents' notation: ``{2}``
is the second argument, ``{1:.1m_v}`` the first as a height with one decimal; arguments are ``name:type``.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

from xtdrone_autopilot.tables.reader import Converter, one_of, read_table

CODES = {"uint8_t": "B", "int8_t": "b", "uint16_t": "H", "int16_t": "h", "uint32_t": "I", "int32_t": "i", "float": "f"}
ENUM_TYPES = {
    "navigation_mode_group_t": "uint32_t",
    "health_component_t": "uint32_t",
    "navigation_mode_t": "uint8_t",
    "failsafe_action_t": "uint8_t",
    "failsafe_cause_t": "uint8_t",
    "arm_disarm_reason_t": "uint8_t",
}
DEFAULT, ARMING_CHECK, HEALTH = "default", "arming_check", "health"
MAX_ARGUMENTS = 25  # bytes of arguments in PX4's event.msg

WITH_CHECKS = "append_health_and_arming_messages"  # the ground station appends the failed checks of the mode


def _split_arguments(text: str) -> tuple[tuple[str, str], ...]:
    """Return name and type of each argument of ``name:type``, separated by spaces."""
    return tuple((label, of_type) for label, of_type in (part.split(":") for part in text.split()))


_COLUMNS: dict[str, Converter] = {
    "name": str,
    "group": one_of(DEFAULT, ARMING_CHECK, HEALTH),
    "kind": str,
    "arguments": _split_arguments,
    "message": str,
    "description": str,
}


@dataclass(frozen=True)
class Definition:
    """Definition of an event.

    Attributes:
        name: PX4's name.
        message: message text.
        arguments: (name, type) of each argument.
        group: libevents' group: "default", "arming_check" or "health".
        kind: libevents' type within the group, empty for none.
        description: additional text, empty for none.
        layout: binary layout of the arguments.
    """

    name: str
    message: str
    arguments: tuple[tuple[str, str], ...]
    group: str
    kind: str
    description: str
    layout: struct.Struct


def _read_catalogue() -> dict[str, Definition]:
    """Return the definitions by name.

    Raises:
        ValueError: the arguments of an event exceed MAX_ARGUMENTS bytes.
    """
    found = {}
    for name, group, kind, arguments, message, description in read_table("events", _COLUMNS):
        layout = struct.Struct("<" + "".join(CODES[ENUM_TYPES.get(of_type, of_type)] for _, of_type in arguments))
        if layout.size > MAX_ARGUMENTS:
            raise ValueError(f"event {name}: {layout.size} bytes of arguments, at most {MAX_ARGUMENTS} are allowed")
        found[name] = Definition(name, message, arguments, group, kind, description, layout)
    return found


CATALOGUE = _read_catalogue()
