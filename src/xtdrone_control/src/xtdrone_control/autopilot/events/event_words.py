"""Events in words, for those who have no ground station that knows them."""

from __future__ import annotations

import re
from collections.abc import Sequence

from xtdrone_control.autopilot import modes
from xtdrone_control.autopilot.commander.failsafe import Action, Cause
from xtdrone_control.autopilot.events.event_catalogue import CATALOGUE, Definition
from xtdrone_control.autopilot.events.events import event_id

# a short name, and words
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
_WORDS: dict[str, dict[int, str]] = {
    "navigation_mode_t": {modes.number_of(mode): words for mode, (_, words) in MODES.items()},
    "failsafe_action_t": {int(action): words for action, words in ACTIONS.items()},
    "failsafe_cause_t": {int(cause): words for cause, words in CAUSES.items()},
}
_PLACE = re.compile(r"\{(\d+)\}")
_BY_NUMBER = {event_id(name): definition for name, definition in CATALOGUE.items()}


def definition_of(number: int) -> Definition | None:
    """Return what is known of the event with that number (EVENT.id), None for nothing."""
    return _BY_NUMBER.get(number)


def told(definition: Definition, values: Sequence[float]) -> str:
    """Return an event's words with its arguments' ``values`` in their places; numbers as they are, without a unit."""

    def value(match: re.Match[str]) -> str:
        index = int(match[1]) - 1
        _, of_type = definition.arguments[index]
        found = values[index]
        return _WORDS.get(of_type, {}).get(int(found), f"{found:g}")

    return _PLACE.sub(value, definition.message)
