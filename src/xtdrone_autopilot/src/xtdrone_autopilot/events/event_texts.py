"""Event messages as plain text, for clients without event support."""

from __future__ import annotations

import re
from collections.abc import Sequence

from xtdrone_autopilot.commander.failsafe import Action, Cause
from xtdrone_autopilot.events.event_catalogue import CATALOGUE, Definition
from xtdrone_autopilot.events.events import event_id
from xtdrone_common import modes

# short name and label
MODES = {
    modes.MANUAL: ("manual", "manual"),
    modes.ALTCTL: ("altctl", "altitude"),
    modes.POSCTL: ("posctl", "position"),
    modes.AUTO_MISSION: ("mission", "mission"),
    modes.AUTO_LOITER: ("loiter", "hold"),
    modes.AUTO_RTL: ("rtl", "return"),
    modes.ACRO: ("acro", "acro"),
    modes.OFFBOARD: ("offboard", "offboard"),
    modes.STABILIZED: ("stab", "stabilized"),
    modes.AUTO_TAKEOFF: ("takeoff", "takeoff"),
    modes.AUTO_LAND: ("land", "land"),
    modes.AUTO_FOLLOW_TARGET: ("follow_target", "follow me"),
    modes.AUTO_PRECLAND: ("precland", "precision landing"),
    modes.ORBIT: ("orbit", "orbit"),
}
ACTIONS = {
    Action.NONE: "nothing",
    Action.WARN: "warning",
    Action.POSCTL: "position control",
    Action.ALTCTL: "altitude control",
    Action.STABILIZED: "stabilized by hand",
    Action.HOLD: "hold",
    Action.RETURN: "return",
    Action.LAND: "land",
    Action.DESCEND: "descend",
    Action.DISARM: "disarm",
    Action.TERMINATE: "terminate",
}
CAUSES = {
    Cause.GENERIC: "a failed check",
    Cause.MANUAL_CONTROL_LOSS: "loss of manual control",
    Cause.GCS_CONNECTION_LOSS: "loss of the ground station",
    Cause.BATTERY_LOW: "low battery",
    Cause.BATTERY_CRITICAL: "critical battery",
    Cause.BATTERY_EMERGENCY: "an almost empty battery",
}
_LABELS: dict[str, dict[int, str]] = {
    "navigation_mode_t": {modes.number_of(mode): words for mode, (_, words) in MODES.items()},
    "failsafe_action_t": {int(action): words for action, words in ACTIONS.items()},
    "failsafe_cause_t": {int(cause): words for cause, words in CAUSES.items()},
}
_PLACEHOLDER = re.compile(r"\{(\d+)\}")
_BY_NUMBER = {event_id(name): definition for name, definition in CATALOGUE.items()}


def definition_of(number: int) -> Definition | None:
    """Return the definition of the event with the number EVENT.id, or None."""
    return _BY_NUMBER.get(number)


def render_message(definition: Definition, values: Sequence[float]) -> str:
    """Return the message of an event with ``values`` inserted for its arguments, without units."""

    def value(match: re.Match[str]) -> str:
        index = int(match[1]) - 1
        _, of_type = definition.arguments[index]
        found = values[index]
        return _LABELS.get(of_type, {}).get(int(found), f"{found:g}")

    return _PLACEHOLDER.sub(value, definition.message)
