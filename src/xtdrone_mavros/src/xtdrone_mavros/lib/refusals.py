"""Reasons for refused arming, refused mode changes and failsafes, for users without a ground station.

PX4 v1.14 reports such reasons only as events (MAVLink EVENT): a report lists the failing checks, each with the modes
that it affects. It begins with the summary of the arming checks and ends with that of the vehicle's health; PX4 sends
one after each change and after each refusal to arm. MAVROS ignores events.
"""

from __future__ import annotations

import struct
from typing import Any, NamedTuple

from xtdrone_autopilot.events import event_texts
from xtdrone_autopilot.events.event_catalogue import HEALTH, WITH_CHECKS, Definition
from xtdrone_autopilot.events.events import ERROR
from xtdrone_common import modes

_NS = 1_000_000_000
_ARMING_LIMIT_NS = _NS // 2  # between a refusal and the report that explains it
_LATE_LIMIT_NS = 3 * _NS  # ns; PX4 reports changes at most every 2 s
_SUMMARY, _END = "commander_arming_check_summary", "commander_health_summary"
_FAILSAFE = "commander_failsafe_enter"
_ALL_MODES = 0xFFFFFFFF
_CHECK = struct.Struct("<IB")  # modes, component
_CRITICAL = 2  # MAV_SEVERITY

Line = tuple[int, str]  # MAV_SEVERITY and text


class FailingCheck(NamedTuple):
    """A failing check.

    Attributes:
        name: Name of PX4's event, such as ``check_modes_local_pos``; empty if it is not known here.
        modes: the affected navigation states, one bit each.
        level: Level of the event; smaller is worse.
        words: its text.
    """

    name: str
    modes: int
    level: int
    words: str

    def stands_against(self, state: int) -> bool:
        """Whether the check blocks a navigation state; a check that affects all modes may be just a warning."""
        return bool(self.modes >> state & 1) and (self.modes != _ALL_MODES or self.level <= ERROR)


class Refusals:
    """Tracker of one autopilot's events.

    Attributes:
        custom_mode: the autopilot's mode as far as known; set by the plugin that receives it.
        reported: whether the autopilot has reported its checks.
    """

    def __init__(self) -> None:
        """Start with an unknown state."""
        self.custom_mode = 0
        self.reported = False
        self._checks: tuple[FailingCheck, ...] = ()  # the last complete report
        self._coming: list[FailingCheck] | None = None  # the report being received
        self._arming_until_ns = -1
        self._late: tuple[str, int, int] | None = None  # text, navigation state, deadline

    def arming_refused(self, now_ns: int) -> None:
        """Record an ack that denies arming; call it before the events that follow the ack."""
        self._arming_until_ns = now_ns + _ARMING_LIMIT_NS

    def reset(self) -> None:
        """Reset the state after the autopilot was replaced or rebooted."""
        self._checks, self._coming, self._late = (), None, None
        self._arming_until_ns = -1
        self.reported = False

    @property
    def failing(self) -> tuple[FailingCheck, ...]:
        """The checks that failed in the last complete report; may be read in any thread."""
        return self._checks

    def process(self, event: Any, now_ns: int) -> list[Line]:
        """Process an EVENT and return the lines to show to the user now.

        Args:
            event: the message.
            now_ns: ROS time.
        """
        definition = event_texts.definition_of(event.id)
        name = definition.name if definition else ""
        if name == _SUMMARY:
            self._coming = []
        elif name == _END:
            return self._report(now_ns)
        elif self._coming is not None and (definition is None or definition.group != "default"):
            self._coming.append(_check(event, definition))
        elif definition is not None and (definition.kind == WITH_CHECKS or name.startswith(_FAILSAFE)):
            return self._describe(event, definition, now_ns)
        return []

    def _report(self, now_ns: int) -> list[Line]:
        """Complete a report, and return the explanations that were waiting for it."""
        if self._coming is None:
            return []
        self._checks, self._coming = tuple(self._coming), None
        self.reported = True
        lines = []
        if now_ns <= self._arming_until_ns:
            mode = modes.from_custom_mode(self.custom_mode)
            reasons = self._reasons(mode.state if mode else None) or self._reasons(None)
            lines.append((_CRITICAL, f"Arming denied: {reasons or 'for a reason that is not known here'}"))
        self._arming_until_ns = -1
        if self._late is not None:
            words, state, until_ns = self._late
            self._late = None
            if (reasons := self._reasons(state)) and now_ns <= until_ns:
                lines.append((_CRITICAL, f"{words}: {reasons}"))
        return lines

    def _describe(self, event: Any, definition: Definition, now_ns: int) -> list[Line]:
        values = definition.layout.unpack_from(bytes(event.arguments))
        words, level = event_texts.render_message(definition, values), event.log_levels & 0xF
        if definition.kind != WITH_CHECKS:
            return [(level, words)]
        mode = modes.from_custom_mode(values[0])
        reasons = self._reasons(mode.state) if mode else ""
        if mode and not reasons:
            self._late = words, mode.state, now_ns + _LATE_LIMIT_NS
        return [(level, f"{words}: {reasons}" if reasons else words)]

    def _reasons(self, state: int | None) -> str:
        """Return the checks that block a navigation state; None for any state."""
        states = range(32) if state is None else (state,)
        return "; ".join(check.words for check in self._checks if any(map(check.stands_against, states)))


def _check(event: Any, definition: Definition | None) -> FailingCheck:
    concerned, _ = _CHECK.unpack_from(bytes(event.arguments))
    kind = "health" if definition and definition.group == HEALTH else "arming"
    words = definition.message if definition else f"{kind} check 0x{event.id:08x}, which is not known here"
    name = definition.name if definition else ""
    return FailingCheck(name, concerned, event.log_levels & 0xF, words)
