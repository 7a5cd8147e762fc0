"""Compare acks, texts, modes, landed states and mission items of a flight with the reference: order and time.

Times count from the flight's last command, or from the previous event if the vehicle had to fly in between. The
reference's heartbeats and landed states were sent once a second: the change they report is up to one second older.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

from pymavlink.dialects.v20 import common as mavlink

from validation.compare_px4.reference import Event, Flight
from validation.compare_px4.response_tolerances import SHARE
from xtdrone_common import modes

LIMIT = 0.2  # s
_SECOND = 1.0  # s, between the reference's heartbeats
_TOGETHER = 0.12  # s: events this close have no order
_PHASES = {
    "takeoff": ("takeoff",),
    "position_step": ("offb_pos",),
    "velocity_step": (),
    "yaw_step": (),
    "offboard_loss": ("offboard_loss", "land"),
    "mission": ("mission",),
    "rtl": ("goto_away", "rtl"),
}
_FLOWN = ("reached", "current")
_FLOWN_TEXTS = (
    "Takeoff detected",
    "Landing detected",
    "Mission finished",
    "RTL: return",
    "RTL: descend",
    "RTL: land at",
)
_LATE_TEXT = "Landing detected"  # its order counts; its time does not, the recorded estimator sank on the ground
_LANDED = {"1": "on ground", "2": "in air", "3": "taking off", "4": "landing"}


@dataclass(frozen=True)
class Match:
    """One compared event.

    Attributes:
        flight: name of the flight.
        what: the event.
        reference: time since the previous event, s; None if the reference has no such event.
        ours: the same for this autopilot.
        allowed: largest difference, s.
        uncertain: how much earlier than observed the reference's event may have occurred, s.
        reason: text printed instead of a verdict; "" if the event is judged.
    """

    flight: str
    what: str
    reference: float | None
    ours: float | None
    allowed: float
    uncertain: float = 0.0
    reason: str = ""

    @property
    def difference(self) -> float:
        """Difference between ours and the reference, s; infinite if one of them is missing."""
        if self.reference is None or self.ours is None:
            return float("inf")
        late, early = self.ours - self.reference, self.reference - self.uncertain - self.ours
        return late if late > 0.0 else -early if early > 0.0 else 0.0

    @property
    def within(self) -> bool:
        """Whether the difference is within the tolerance."""
        return bool(self.reason) or abs(self.difference) <= self.allowed


def label(event: Event) -> str:
    """Return a description of the event, without figures that depend on the location."""
    value = event.value
    if event.kind == "ack":
        command, result = value.split()
        name = mavlink.enums["MAV_CMD"][int(command)].name.removeprefix("MAV_CMD_")
        return f"ack {name}: {mavlink.enums['MAV_RESULT'][int(result)].name.removeprefix('MAV_RESULT_')}"
    if event.kind == "mode":
        base, custom, status = (int(part) for part in value.split())
        mode = modes.from_custom_mode(custom)
        return f"mode {mode.name if mode else custom}, base_mode {base}, system_status {status}"
    if event.kind == "landed_state":
        return f"landed state: {_LANDED.get(value, value)}"
    if event.kind == "text":
        return "text " + re.sub(r"\d+ m \(", "# m (", value.split(" ", 1)[1])
    return f"mission item {value} {'reached' if event.kind == 'reached' else 'current'}"


def compare(reference: Flight, ours: Flight, flight: str) -> list[Match]:
    """Return the compared events of ``flight`` (a name of ``flown_scripts.FLIGHTS``), in the reference's order."""
    found = []
    for phase in _PHASES[flight]:
        found += _compare_phase(flight, _of(reference, phase), _of(ours, phase))
    return found


def _of(flight: Flight, phase: str) -> list[Event]:
    kinds = ("phase", "ack", "text", "mode", "landed_state", "reached", "setpoints")
    found = [event for event in flight.events if event.phase == phase and event.kind in kinds]
    return [event for event in found if not _passing(event, found)]


def _passing(event: Event, events: list[Event]) -> bool:
    """Return whether a mode or landed state changed within a second, so that reports at 1 Hz may miss it."""
    return event.kind in ("mode", "landed_state") and any(
        other.kind == event.kind and event.time < other.time < event.time + _SECOND - _TOGETHER for other in events
    )


def _compare_phase(flight: str, theirs: list[Event], ours: list[Event]) -> list[Match]:
    """Match each event of the reference with our first equal one that is not matched yet."""
    matches: list[Match] = []
    left = list(ours)
    anchor = (theirs[0].time, ours[0].time if ours else theirs[0].time)
    last = anchor[1]
    for event in theirs:
        if event.kind in ("phase", "setpoints"):
            anchor = (event.time, next((e.time for e in left if e.kind == event.kind), anchor[1]))
            continue
        what = label(event)
        mine = next((e for e in left if e.kind == event.kind and label(e) == what), None)
        since = event.time - anchor[0]
        flown = event.kind == "reached" or any(text in what for text in _FLOWN_TEXTS)
        late = event.kind in ("mode", "landed_state")
        allowed = max(LIMIT, SHARE * since) if flown or (late and since > 3.0) else LIMIT
        if mine is None:
            matches.append(Match(flight, what, since, None, allowed))
            continue
        left.remove(mine)
        if mine.time < last - _TOGETHER:
            what += " (out of order)"
            allowed = -1.0
        last = max(last, mine.time)
        reason = "info" if _LATE_TEXT in what and allowed > 0.0 else ""
        matches.append(Match(flight, what, since, mine.time - anchor[1], allowed, _SECOND if late else 0.0, reason))
        if event.kind == "ack" or flown:
            anchor = (event.time, mine.time)
    for event in left:
        if event.kind not in ("phase", "setpoints"):
            matches.append(Match(flight, label(event), None, event.time - anchor[1], LIMIT))
    return matches
