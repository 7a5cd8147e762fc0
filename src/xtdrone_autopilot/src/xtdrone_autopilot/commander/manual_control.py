"""Manual control input from a joystick (MANUAL_CONTROL) or an RC transmitter (RC_CHANNELS_OVERRIDE).

Modelled on PX4 v1.14's ``manual_control`` and ``rc_update``. COM_RC_IN_MODE selects the source and COM_RC_LOSS_T its
timeout. RCn_* calibrate the channels and RC_MAP_* assign their functions.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from xtdrone_autopilot.commander.offboard_setpoint import SetpointError

Get = Callable[[str], float]

CHANNELS = 18
_UNUSED = 0xFFFF  # UINT16_MAX: channel is not overridden
_MANDATORY_CHANNELS = 8  # in later channels 0 also means not overridden
_NEVER_US = -(1 << 60)
_MEMORY = 1.0  # s, window over which stick movements accumulate for COM_RC_STICK_OV
_STICKS_CENTRED, _YAW_CORNER, _THROTTLE_LOW = 0.1, 0.9, -0.8  # of the arming gesture
_SLOTS = 6  # COM_FLTMODE1..6
_RC_ONLY, _JOYSTICK_ONLY, _EITHER, _FIRST = range(4)  # COM_RC_IN_MODE; 4 disables all input


class Sticks(NamedTuple):
    """Stick positions, each -1..1: forward, right, up (0 is centred), clockwise."""

    x: float
    y: float
    z: float
    yaw: float


CENTRED = Sticks(0.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Request:
    """Request made by a stick gesture or a switch.

    Attributes:
        action: "arm", "disarm", "toggle" (arm or disarm), "kill", "unkill" or "mode".
        origin: "stick", "switch" or "button".
        mode: mode number as in COM_FLTMODE1, -1 for none; for the action "mode" only.
    """

    action: str
    origin: str
    mode: int = -1


class _Source:
    """Latest stick positions of one source."""

    def __init__(self) -> None:
        self.sticks = CENTRED
        self.time_us = _NEVER_US

    def fresh(self, now_us: int, limit_us: float) -> bool:
        return now_us - self.time_us <= limit_us


class _HoldTimer:
    """Timer that triggers once after a condition has held long enough."""

    def __init__(self) -> None:
        self._since_us: int | None = None
        self._triggered = False

    def triggers(self, holds: bool, now_us: int, delay_us: float) -> bool:
        """Return True once, as soon as ``holds`` has been true for ``delay_us``."""
        if not holds:
            self._since_us, self._triggered = None, False
            return False
        if self._since_us is None:
            self._since_us = now_us
        if self._triggered or now_us - self._since_us < delay_us:
            return False
        self._triggered = True
        return True


class ManualControl:
    """Manual control input of one vehicle.

    Attributes:
        channels: RC pulse widths of the last message, us, without unused channels at the end.
        switches: RC switches by name: 0 or 1 for "kill", "arm", "return", "loiter" and "offboard", 1..6 for "slot".
        receiver_works: False after a failure of the RC receiver.
    """

    def __init__(self, get: Get) -> None:
        """Start without input; ``get`` returns a parameter by name."""
        self._get = get
        self._rc, self._joystick = _Source(), _Source()
        self._selected: _Source | None = None
        self._first: _Source | None = None
        self._moved = [0.0] * 4
        self._last: Sticks | None = None
        self._last_us = 0
        self._arm_gesture, self._disarm_gesture = _HoldTimer(), _HoldTimer()
        self._switches_before: dict[str, int] | None = None
        self._last_slot_mode = -1
        self.channels: tuple[int, ...] = ()
        self.switches: dict[str, int] = {}
        self.receiver_works = True

    # input

    def joystick(self, sticks: Sticks, now_us: int) -> None:
        """Store the sticks of a MANUAL_CONTROL message.

        Raises:
            SetpointError: a value is not finite.
        """
        if not all(map(math.isfinite, sticks)):
            raise SetpointError(f"sticks are {tuple(sticks)}, not finite numbers")
        self._joystick.sticks = Sticks(*(min(max(value, -1.0), 1.0) for value in sticks))
        self._joystick.time_us = now_us
        self._select_source(now_us)
        self._track_movement(self._joystick, now_us)

    def radio(self, channels: Sequence[int], now_us: int) -> None:
        """Store the channels of an RC_CHANNELS_OVERRIDE message.

        Args:
            channels: pulse widths, us, from channel 1; 65535 marks a channel as unused, as does 0 after the eighth.
                A message in which all channels are unused releases the override and does not count as input.
            now_us: simulated time, microseconds.
        """
        count = channel_count(channels)
        self.channels = tuple(channels[:count])
        sticks = self._radio_sticks(channels, count)
        if sticks is None:
            return
        self._rc.sticks = sticks
        self._rc.time_us = now_us
        self.switches = self._radio_switches(channels, count)
        self._select_source(now_us)
        self._track_movement(self._rc, now_us)

    def _radio_sticks(self, channels: Sequence[int], count: int) -> Sticks | None:
        values = []
        for axis, sign in (("PITCH", 1.0), ("ROLL", 1.0), ("THROTTLE", 1.0), ("YAW", 1.0)):
            number = int(self._get(f"RC_MAP_{axis}"))
            if not 1 <= number <= count:
                return None  # a stick without a channel: PX4 ignores such a transmitter
            values.append(sign * self._scaled(channels, number))
        return Sticks(*values)

    def _scaled(self, channels: Sequence[int], number: int) -> float:
        """Return a channel's position, -1..1, after calibration and dead zone."""
        get = self._get
        low, trim, high = (get(f"RC{number}_{end}") for end in ("MIN", "TRIM", "MAX"))
        dead = get(f"RC{number}_DZ")
        pulse = min(max(channels[number - 1], low), high)
        above, below = pulse - trim - dead, trim - dead - pulse
        if above > 0.0:
            value = above / (high - trim - dead)
        elif below > 0.0 and low < trim - dead:  # false for an inconsistent calibration
            value = -min(below / (trim - dead - low), 1.0)
        else:
            value = 0.0
        return value if get(f"RC{number}_REV") > 0 else -value

    def _radio_switches(self, channels: Sequence[int], count: int) -> dict[str, int]:
        found = {}
        for name, channel, threshold in (
            ("kill", "RC_MAP_KILL_SW", "RC_KILLSWITCH_TH"),
            ("arm", "RC_MAP_ARM_SW", "RC_ARMSWITCH_TH"),
            ("return", "RC_MAP_RETURN_SW", "RC_RETURN_TH"),
            ("loiter", "RC_MAP_LOITER_SW", "RC_LOITER_TH"),
            ("offboard", "RC_MAP_OFFB_SW", "RC_OFFB_TH"),
        ):
            number = int(self._get(channel))
            if 1 <= number <= count:
                found[name] = self._switched(self._scaled(channels, number), self._get(threshold))
        number = int(self._get("RC_MAP_FLTMODE"))
        if 1 <= number <= count:
            found["slot"] = mode_slot(self._scaled(channels, number))
        return found

    @staticmethod
    def _switched(value: float, threshold: float) -> int:
        """Return 1 for on; a negative threshold inverts the switch."""
        share = 0.5 * value + 0.5
        return int(share > threshold) if threshold >= 0 else int(share < -threshold)

    # selection of the source

    def _select_source(self, now_us: int) -> None:
        limit_us = self._get("COM_RC_LOSS_T") * 1e6
        sources = (self._rc, self._joystick) if self.receiver_works else (self._joystick,)
        fresh = [source for source in sources if source.fresh(now_us, limit_us)]
        kind = int(self._get("COM_RC_IN_MODE"))
        if kind == _RC_ONLY:
            fresh = [source for source in fresh if source is self._rc]
        elif kind == _JOYSTICK_ONLY:
            fresh = [source for source in fresh if source is self._joystick]
        elif kind == _FIRST:
            if self._first is None and fresh:
                self._first = fresh[0]
            fresh = [source for source in fresh if source is self._first]
        elif kind != _EITHER:
            fresh = []
        if self._selected not in fresh:
            self._selected = fresh[0] if fresh else None
            self._last = None

    @property
    def sticks(self) -> Sticks | None:
        """Sticks of the selected source, None without manual control."""
        return None if self._selected is None else self._selected.sticks

    @property
    def by_radio(self) -> bool:
        """Whether the selected source is the RC transmitter."""
        return self._selected is self._rc

    @property
    def moving(self) -> bool:
        """Whether a stick has moved by more than COM_RC_STICK_OV within about a second."""
        return max(self._moved) > 0.01 * self._get("COM_RC_STICK_OV")

    def _track_movement(self, source: _Source, now_us: int) -> None:
        """Accumulate the movements of each stick, with linear decay over one second."""
        if source is not self._selected:
            return
        if self._last is None:
            self._moved = [0.0] * 4
        else:
            keep = max(1.0 - (now_us - self._last_us) * 1e-6 / _MEMORY, 0.0)
            for axis in range(4):
                self._moved[axis] = abs(source.sticks[axis] - self._last[axis]) + keep * self._moved[axis]
        self._last, self._last_us = source.sticks, now_us

    # requests

    def update(self, now_us: int) -> list[Request]:
        """Update the selected source; return the requests by gesture or switch since the last call."""
        if self._selected is None and not self._joystick.time_us > 0 and not self._rc.time_us > 0:
            return []  # no input so far
        self._select_source(now_us)
        if self._selected is None:
            self._moved = [0.0] * 4
            self._switches_before = None
            return []
        found = self._gestures(self._selected.sticks, now_us)
        if self._selected is self._rc:
            found += self._switch_requests()
        else:
            self._switches_before = None
        return found

    def _gestures(self, sticks: Sticks, now_us: int) -> list[Request]:
        if not int(self._get("MAN_ARM_GESTURE")):
            return []
        ready = (
            abs(sticks.x) < _STICKS_CENTRED and abs(sticks.y) < _STICKS_CENTRED and sticks.z < _THROTTLE_LOW
        )  # throttle down, right stick centred
        delay_us = self._get("COM_RC_ARM_HYST") * 1e3
        found = []
        if self._arm_gesture.triggers(ready and sticks.yaw > _YAW_CORNER, now_us, delay_us):
            found.append(Request("arm", "stick"))
        if self._disarm_gesture.triggers(ready and sticks.yaw < -_YAW_CORNER, now_us, delay_us):
            found.append(Request("disarm", "stick"))
        return found

    def _switch_requests(self) -> list[Request]:
        before, now = self._switches_before, self.switches
        self._switches_before = dict(now)
        if before is None:  # new source: only its mode switch takes effect
            return self._slot_request(now)
        found = []
        if now.get("slot") != before.get("slot"):
            found += self._slot_request(now)
        if now.get("arm") != before.get("arm") and "arm" in now:
            found += self._arm_switch(now["arm"])
        for name, number in (("return", 5), ("loiter", 4), ("offboard", 7)):
            if name in now and now[name] != before.get(name, 0):
                found.append(Request("mode", "switch", number if now[name] else self._last_slot_mode))
        if "kill" in now and now["kill"] != before.get("kill", 0):
            found.append(Request("kill" if now["kill"] else "unkill", "switch"))
        return [request for request in found if request.action != "mode" or request.mode >= 0]

    def _arm_switch(self, on: int) -> list[Request]:
        if int(self._get("COM_ARM_SWISBTN")):
            return [Request("toggle", "button")] if on else []
        return [Request("arm" if on else "disarm", "switch")]

    def _slot_request(self, switches: dict[str, int]) -> list[Request]:
        slot = switches.get("slot")
        self._last_slot_mode = -1 if slot is None else int(self._get(f"COM_FLTMODE{slot}"))
        return [Request("mode", "switch", self._last_slot_mode)] if self._last_slot_mode >= 0 else []


def channel_count(channels: Sequence[int]) -> int:
    """Return the number of channels up to the last one in use."""
    for index in range(len(channels) - 1, -1, -1):
        left_out = channels[index] == _UNUSED or (index >= _MANDATORY_CHANNELS and channels[index] == 0)
        if not left_out:
            return index + 1
    return 0


def mode_slot(value: float) -> int:
    """Return the slot, 1..6, of a mode switch at ``value`` (-1..1), with PX4's six equal ranges."""
    low, high, half = -1.05, 1.05, 1.0 / _SLOTS
    slot = int(((value - low) * _SLOTS + half) / (high - low) + half) + 1
    return min(slot, _SLOTS)
