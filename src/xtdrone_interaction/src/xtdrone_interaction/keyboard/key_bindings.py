"""Mapping of keys to messages, without ROS and terminal.

Keys, steps and limits are those of XTDrone's multirotor_keyboard_control.py. Intended differences:

- Setpoints are published while they are not zero, and once when they become zero, instead of forever, so that an idle
  keyboard does not disturb a formation. Vehicles are stopped when the target changes or the keyboard ends.
- OFFBOARD with zero speeds is preceded by HOVER, so that the vehicle holds its current position rather than the last
  one where it hovered.
- A digit selects one of the leader's patterns; other digits do nothing but explain why.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import Enum

STEPS = 100  # key presses per m/s (m/s^2 for accelerations) or rad/s
MAX_SPEED = 20  # m/s, m/s^2
MAX_TURN = 3  # rad/s
NO_PATTERN = "waiting"  # the leader's command for the digit 0

AXES = ("forward", "left", "up", "turn")
_STEERING = {
    "w": (0, 1),
    "x": (0, -1),
    "a": (1, 1),
    "d": (1, -1),
    "i": (2, 1),
    ",": (2, -1),
    "j": (3, 1),
    "l": (3, -1),
}
_COMMANDS = {
    "t": "ARM",
    "y": "DISARM",
    "v": "AUTO.TAKEOFF",
    "n": "AUTO.LAND",
    "r": "AUTO.RTL",
    "b": "OFFBOARD",
}
_MOST = (MAX_SPEED * STEPS, MAX_SPEED * STEPS, MAX_SPEED * STEPS, MAX_TURN * STEPS)


class Target(Enum):
    """Receiver of the commands."""

    ALL = "all vehicles"
    LEADER = "leader"


@dataclass(frozen=True)
class Command:
    """A command string for the target's topic ``cmd``."""

    target: Target
    text: str


@dataclass(frozen=True)
class Setpoint:
    """A velocity (m/s) or acceleration (m/s^2) in FLU, and a yaw rate (rad/s)."""

    target: Target
    forward: float = 0.0
    left: float = 0.0
    up: float = 0.0
    turn: float = 0.0


Message = Command | Setpoint


def digits(patterns: Sequence[str]) -> dict[str, str]:
    """Assign digits from 1 to patterns.

    Args:
        patterns: names, XTDrone's first. ``origin``, which XTDrone's keyboard lacks, gets the last digit.
    """
    names = [name for name in patterns if name != "origin"]
    if "origin" in patterns:
        names = [*names[:8], "origin"]
    return {str(i): name for i, name in enumerate(names[:9], start=1)}


class Pilot:
    """Speeds and target that the keys set.

    Attributes:
        target: receiver of the commands.
        patterns: name by digit, from "1".
        note: effect of the last key, for the screen.
    """

    def __init__(self, patterns: Mapping[str, str] | None = None) -> None:
        """Start with all vehicles as target and zero speeds.

        Args:
            patterns: name by digit, see :func:`digits`.
        """
        self.patterns = dict(patterns or {})
        self.target = Target.ALL
        self.note = ""
        self._counts = [0, 0, 0, 0]  # key presses per axis; sums of 0.01 would accumulate rounding errors
        self._moving = False  # whether the last setpoint was not zero

    @property
    def speeds(self) -> tuple[float, float, float, float]:
        """Forward, left, up in m/s (m/s^2), turn in rad/s: multiples of 0.01."""
        forward, left, up, turn = (count / STEPS for count in self._counts)
        return forward, left, up, turn

    def press(self, key: str) -> list[Message]:
        """Process a key and return the messages to publish at once; setpoints follow from :meth:`cycle`."""
        if key in _STEERING:
            self._change(*_STEERING[key])
            return []
        if key in _COMMANDS:
            return self._command(_COMMANDS[key])
        if key in ("s", "k"):
            return self._hover()
        if key == "g":
            return self._turn_to_other_target()
        if key.isdecimal():
            return self._choose(key)
        self.note = f"{key!r} is not a key of this keyboard"
        return []

    def cycle(self) -> Setpoint | None:
        """Return the setpoint to publish, or None; to be called at 10 Hz."""
        moving, was_moving = any(self._counts), self._moving
        self._moving = moving
        return Setpoint(self.target, *self.speeds) if moving or was_moving else None

    def steer(self, forward: float, left: float, up: float, turn: float) -> None:
        """Set the speeds at once, as sticks do: m/s (m/s^2), turn in rad/s, to multiples of 0.01 within the limits."""
        wanted = (round(value * STEPS) for value in (forward, left, up, turn))
        self._counts = [max(-most, min(most, count)) for count, most in zip(wanted, _MOST, strict=True)]

    def stop(self) -> Setpoint | None:
        """Set all speeds to zero and return the setpoint that stops moving vehicles, or None."""
        self._counts = [0, 0, 0, 0]
        return self.cycle()

    def _change(self, axis: int, sign: int) -> None:
        count, most = self._counts[axis] + sign, _MOST[axis]
        self.note = f"{AXES[axis]}: {most // STEPS} is the maximum" if abs(count) > most else ""
        self._counts[axis] = max(-most, min(most, count))

    def _command(self, text: str) -> list[Message]:
        self.note = f"{text} to {self._addressee()}"
        said: list[Message] = [Command(self.target, text)]
        if text == "OFFBOARD" and not any(self._counts):
            self.note += ", hovering"
            said.insert(0, Command(self.target, "HOVER"))
        return said

    def _hover(self) -> list[Message]:
        self._counts = [0, 0, 0, 0]
        self._moving = False
        self.note = f"HOVER to {self._addressee()}"
        # The zero setpoint comes last: an earlier one may arrive after the command, which has another topic.
        return [Command(self.target, "HOVER"), Setpoint(self.target)]

    def _turn_to_other_target(self) -> list[Message]:
        stopped = self.stop()
        self.target = Target.ALL if self.target is Target.LEADER else Target.LEADER
        self.note = f"steering {self._addressee()}"
        return [] if stopped is None else [stopped]

    def _choose(self, digit: str) -> list[Message]:
        if self.target is not Target.LEADER:
            self.note = f"{digit}: patterns are for the leader, press g first"
            return []
        if digit != "0" and digit not in self.patterns:
            there = ", ".join(f"{key} {name}" for key, name in self.patterns.items())
            self.note = f"{digit}: there is no such pattern" + (f", but {there}" if there else "")
            return []
        name = self.patterns.get(digit, NO_PATTERN)
        self.note = f"{name} to {self._addressee()}"
        return [Command(self.target, name)]

    def _addressee(self) -> str:
        return "the leader" if self.target is Target.LEADER else "all"
