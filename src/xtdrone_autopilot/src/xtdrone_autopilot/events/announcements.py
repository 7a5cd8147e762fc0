"""Announcements of a vehicle to its operators: texts (STATUSTEXT) and events.

As PX4 does, most announcements are sent both as an event and as a text for ground stations without event support. Such
a text ends with a tab; ground stations that support events do not show it.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable

from xtdrone_autopilot.commander.failsafe import Action, Cause, Outcome
from xtdrone_autopilot.events import events
from xtdrone_autopilot.events.events import Event, event
from xtdrone_autopilot.vehicle_view import VehicleView
from xtdrone_common import modes
from xtdrone_common.modes import Mode

CRITICAL, WARNING, INFO = 2, 4, 6  # MAV_SEVERITY
_MAX_TEXTS = 64
_MAX_EVENTS = 64
_WARNING_INTERVAL_US = 1_000_000
_NEVER_US = -(1 << 60)
_UINT16 = 0xFFFF

# event name and log level of a failsafe that only warns, by cause
_BATTERY_WARNINGS = {
    Cause.BATTERY_LOW: ("commander_failsafe_enter_low_bat", events.WARNING),
    Cause.BATTERY_CRITICAL: ("commander_failsafe_enter_crit_bat_warn", events.CRITICAL),
    Cause.BATTERY_EMERGENCY: ("commander_failsafe_enter_crit_low_bat_warn", events.EMERGENCY),
}


class Announcements:
    """Queues of one vehicle's texts and events.

    Attributes:
        texts: (MAV_SEVERITY, text) not yet sent; beyond 64 the oldest are dropped.
        events: events not yet sent, likewise.
        on_text: callback for every text, with severity and text; may be None.
    """

    def __init__(self, view: VehicleView) -> None:
        """Create empty queues; ``view`` provides the simulated time."""
        self._view = view
        self.texts: deque[tuple[int, str]] = deque(maxlen=_MAX_TEXTS)
        self.events: deque[Event] = deque(maxlen=_MAX_EVENTS)
        self.on_text: Callable[[int, str], None] | None = None
        self._last_warning_us = _NEVER_US

    def say(self, severity: int, text: str) -> None:
        """Queue a text of a MAV_SEVERITY."""
        self.texts.append((severity, text))
        if self.on_text is not None:
            self.on_text(severity, text)

    def warn(self, text: str) -> None:
        """Queue a warning text, at most one per second."""
        if self._view.time_us - self._last_warning_us >= _WARNING_INTERVAL_US:
            self._last_warning_us = self._view.time_us
            self.say(WARNING, text)

    def emit(self, found: Iterable[Event]) -> None:
        """Queue events."""
        self.events.extend(found)

    def tell(self, severity: int, text: str, name: str, *values: float, level: int | None = None) -> None:
        """Queue a text and its event.

        Args:
            severity: MAV_SEVERITY of the text.
            text: text without the trailing tab.
            name: PX4's name of the event.
            values: arguments of the event.
            level: log level of the event; None for the text's severity.
        """
        self.say(severity, text + "\t")
        level = severity if level is None else level
        self.events.append(event(name, level, self._view.time_us, *values))

    def mode_refused(self, mode: Mode) -> None:
        """Announce that switching to ``mode`` was rejected."""
        text = f"Switching to {mode.label} is currently not available"
        number = modes.number_of(mode)
        self.tell(CRITICAL, text, "commander_modeswitch_not_avail", mode.custom_mode, number)

    def failsafe(self, outcome: Outcome) -> None:
        """Announce a failsafe action or warning."""
        mode = outcome.intended.custom_mode
        if outcome.action is Action.HOLD and outcome.delayed is not Action.NONE:
            self._delayed_failsafe(outcome, mode)
            return
        self.say(CRITICAL, "Failsafe activated\t")
        now_us = self._view.time_us
        inside = events.WARNING
        if outcome.action is Action.WARN:
            if outcome.cause in _BATTERY_WARNINGS:
                name, level = _BATTERY_WARNINGS[outcome.cause]
                found = event(name, level, now_us, internal=events.INFO)
            elif outcome.cause is Cause.GENERIC:
                found = event("commander_failsafe_enter_generic_warn", events.WARNING, now_us, mode)
            else:
                found = event("commander_failsafe_enter_warn", events.WARNING, now_us, mode, outcome.cause)
        elif outcome.cause is Cause.GENERIC:
            name = "commander_failsafe_enter_generic"
            found = event(name, events.CRITICAL, now_us, mode, outcome.action, internal=inside)
        else:
            found = event(
                "commander_failsafe_enter", events.CRITICAL, now_us, mode, outcome.action, outcome.cause,
                internal=inside,
            )  # fmt: skip
        self.events.append(found)

    def _delayed_failsafe(self, outcome: Outcome, mode: int) -> None:
        seconds = min(int(outcome.delay + 0.5), _UINT16)
        self.say(CRITICAL, f"Failsafe activated, entering Hold for {seconds} seconds\t")
        name, values = "commander_failsafe_enter_generic_hold", [mode, outcome.delayed, seconds]
        if outcome.cause is not Cause.GENERIC:
            name = "commander_failsafe_enter_hold"
            values.append(outcome.cause)
        self.events.append(event(name, events.CRITICAL, self._view.time_us, *values, internal=events.WARNING))
