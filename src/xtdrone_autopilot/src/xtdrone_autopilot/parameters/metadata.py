"""Metadata of events and parameters for ground stations, as JSON.

Formats: mavlink.io, "Component Metadata Protocol" (``general.schema.json`` for the index of all files,
``parameter.schema.json`` for parameters) and libevents' definitions. The bytes depend only on the code and the
vehicle's defaults, so that ground stations can cache them by checksum.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from enum import Enum
from functools import cache
from typing import Any

from xtdrone_autopilot.commander.commander import ArmReason
from xtdrone_autopilot.commander.failsafe import Action, Cause
from xtdrone_autopilot.events import events
from xtdrone_autopilot.events.event_catalogue import CATALOGUE, ENUM_TYPES, Definition
from xtdrone_autopilot.events.event_texts import ACTIONS, CAUSES, MODES
from xtdrone_autopilot.events.events import event_id
from xtdrone_autopilot.parameters.parameters import FIXED, INT32, NAMES, VOLATILE, Parameter, Parameters, describe
from xtdrone_autopilot.tables.reader import Converter, one_of, read_table
from xtdrone_common import modes

GENERAL, PARAMETER, EVENTS = 0, 1, 4  # COMP_METADATA_TYPE

_AUTOPILOT = "1"  # component id of the events
_SUB_ID = 0xFFFFFF
_COMPONENT_LABELS = {
    events.GPS: ("gps", "GPS"),
    events.REMOTE_CONTROL: ("remote_control", "manual control"),
    events.MOTORS: ("motors_escs", "motors"),
    events.BATTERY: ("battery", "battery"),
    events.LINKS: ("communication_links", "links"),
    events.ATTITUDE_ESTIMATE: ("attitude_estimate", "attitude estimate"),
    events.LOCAL_POSITION: ("local_position_estimate", "local position estimate"),
    events.SYSTEM: ("system", "system"),
    events.GLOBAL_POSITION: ("global_position_estimate", "global position estimate"),
}
_GROUPS = dict(read_table("parameter_groups", {"prefix": str, "group": str}))
_RADIO = "Radio"
_MOST_DECIMALS = 7
_KINDS = one_of("value", "bit")
_LABEL_COLUMNS: dict[str, Converter] = {"parameters": str.split, "kind": _KINDS, "number": int, "label": str}

AT_START = frozenset({"EKF2_ABIAS_INIT", "EKF2_ANGERR_INIT", "EKF2_GBIAS_INIT"})
"""Parameters that take effect only at start."""


def _read_labels(kind: str) -> dict[str, dict[int, str]]:
    found: dict[str, dict[int, str]] = {}
    for names, of_kind, index, label in read_table("parameter_labels", _LABEL_COLUMNS):
        for name in names if of_kind == kind else ():
            found.setdefault(name, {})[index] = label
    return found


CHOICES = _read_labels("value")
"""Labels of the values of enumerated parameters, which ground stations show instead of the numbers."""
BITS = _read_labels("bit")
"""Labels of the bits of parameters, by bit number."""


def _to_json(content: Mapping[str, Any]) -> bytes:
    return json.dumps(content, separators=(",", ":"), ensure_ascii=False).encode()


def general(files: Mapping[int, tuple[str, int]]) -> bytes:
    """Return the general metadata file, which lists the other files.

    Args:
        files: COMP_METADATA_TYPE to URI and CRC-32.
    """
    types = [{"type": kind, "uri": uri, "fileCrc": crc} for kind, (uri, crc) in files.items()]
    return _to_json({"version": 1, "vendorName": "XTDrone", "modelName": "PX4 v1.14 simulated", "metadataTypes": types})


# events


@cache
def event_definitions() -> bytes:
    """Return libevents' definitions of all events of the autopilot."""
    groups: dict[str, Any] = {}
    for definition in CATALOGUE.values():
        found = groups.setdefault(definition.group, {"events": {}})["events"]
        found[str(event_id(definition.name) & _SUB_ID)] = _event(definition)
    component = {
        "namespace": "px4",
        "enums": _enums(),
        "event_groups": groups,
        "supported_protocols": ["health_and_arming_check"],
        # group of arming checks of each mode, by custom_mode: one group per mode
        "navigation_mode_groups": {"groups": {str(mode.state): [mode.custom_mode] for mode in MODES}},
    }
    return _to_json({"version": 2, "components": {_AUTOPILOT: component}})


def _event(definition: Definition) -> dict[str, Any]:
    entry: dict[str, Any] = {"name": definition.name, "message": definition.message}
    if definition.description:
        entry["description"] = definition.description
    if definition.kind:
        entry["type"] = definition.kind
    if definition.arguments:
        entry["arguments"] = [{"name": name, "type": of_type} for name, of_type in definition.arguments]
    return entry


def _enums() -> dict[str, Any]:
    groups = {1 << mode.state: words for mode, words in MODES.items()}
    components = {1: ("none", "none"), **{1 << bit: words for bit, words in _COMPONENT_LABELS.items()}}
    numbers = {modes.number_of(mode): words for mode, words in MODES.items()}
    numbers[modes.UNKNOWN_NUMBER] = ("unknown", "unknown")
    reasons = {reason.value[0]: (_lower(reason), reason.value[1]) for reason in ArmReason}
    return {
        "navigation_mode_group_t": _enum("navigation_mode_group_t", groups, bits=True),
        "health_component_t": _enum("health_component_t", components, bits=True),
        "navigation_mode_t": _enum("navigation_mode_t", numbers),
        "failsafe_action_t": _enum("failsafe_action_t", {int(a): (_lower(a), ACTIONS[a]) for a in Action}),
        "failsafe_cause_t": _enum("failsafe_cause_t", {int(c): (_lower(c), CAUSES[c]) for c in Cause}),
        "arm_disarm_reason_t": _enum("arm_disarm_reason_t", reasons),
    }


def _lower(member: Enum) -> str:
    return member.name.lower()


def _enum(name: str, entries: Mapping[int, tuple[str, str]], *, bits: bool = False) -> dict[str, Any]:
    found: dict[str, Any] = {"type": ENUM_TYPES[name]}
    if bits:
        found["is_bitfield"] = True
    found["entries"] = {
        str(value): {"name": label, "description": words} for value, (label, words) in sorted(entries.items())
    }
    return found


# parameters


def parameter_definitions(parameters: Parameters) -> bytes:
    """Return the definitions of all parameters, with the vehicle's defaults."""
    entries = [_parameter(describe(name), parameters.default(name)) for name in NAMES]
    return _to_json({"version": 1, "parameters": entries})


def _parameter(entry: Parameter, default: float) -> dict[str, Any]:
    found: dict[str, Any] = {
        "name": entry.name,
        "type": "Int32" if entry.type == INT32 else "Float",
        "shortDesc": entry.text[:1].upper() + entry.text[1:],
        "group": _group(entry.name),
        "category": "Standard" if entry.has_effect else "Without effect",
        "default": default,
    }
    if entry.unit:
        found["units"] = entry.unit
    for key, limit in (("min", entry.minimum), ("max", entry.maximum)):
        if math.isfinite(limit):
            found[key] = limit
    if entry.type != INT32:
        found["decimalPlaces"] = max(_decimals(default), _decimals(entry.minimum), 2)
    if entry.name in AT_START:
        found["rebootRequired"] = True
    if entry.name in VOLATILE:
        found["volatile"] = True
    if entry.name in FIXED:
        found["readOnly"] = True
    if entry.name in CHOICES:
        found["values"] = [{"value": value, "description": words} for value, words in CHOICES[entry.name].items()]
    if entry.name in BITS:
        found["bitmask"] = [{"index": index, "description": words} for index, words in BITS[entry.name].items()]
    return found


def _group(name: str) -> str:
    return _GROUPS.get(name.split("_", 1)[0], _RADIO)


def _decimals(value: float) -> int:
    """Return the number of decimals needed for ``value``, at most 7."""
    if not math.isfinite(value):
        return 0
    return len(f"{value:.{_MOST_DECIMALS}f}".rstrip("0").split(".")[1])
