"""What the keyboard's keys mean: keys in, messages out. No ROS and no terminal here.

Keys, steps and limits are XTDrone's (multirotor_keyboard_control.py). What differs, on purpose:

- Velocities are said while they are not zero, and zero once when they have become so, not zero for ever: the keyboard
  lies beside a formation without a word. A vehicle that was steered keeps still when the keyboard turns to another
  target or ends.
- OFFBOARD with all speeds zero is preceded by HOVER, so that the vehicle stays where it is then, and does not go where
  it last hovered.
- A digit is a pattern that there is, for the leader; else it does nothing and says why.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import Enum

STEPS = 100  # presses to 1 m/s (m/s^2 in accelerations), or to 1 rad/s
MAX_SPEED = 20  # m/s, m/s^2
MAX_TURN = 3  # rad/s
NO_PATTERN = "waiting"  # what the digit 0 says to the leader

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
    """Who hears the keyboard."""

    ALL = "all vehicles"
    LEADER = "leader"


@dataclass(frozen=True)
class Say:
    """A command string for the target's topic ``cmd``."""

    target: Target
    text: str


@dataclass(frozen=True)
class Steer:
    """A velocity (m/s) or acceleration (m/s^2) in FLU, and a yaw rate (rad/s), for the target."""

    target: Target
    forward: float = 0.0
    left: float = 0.0
    up: float = 0.0
    turn: float = 0.0


Message = Say | Steer


def digits(patterns: Sequence[str]) -> dict[str, str]:
    """Return which pattern each digit from 1 chooses.

    Args:
        patterns: names, XTDrone's first. Its keyboard leaves ``origin`` out; here it has the last digit.
    """
    names = [name for name in patterns if name != "origin"]
    if "origin" in patterns:
        names = [*names[:8], "origin"]
    return {str(i): name for i, name in enumerate(names[:9], start=1)}


class Pilot:
    """Speeds and target that the keys set.

    Attributes:
        target: who hears the keyboard.
        patterns: name by digit, from "1".
        note: what the last key did or why it did nothing; for the person.
    """

    def __init__(self, patterns: Mapping[str, str] | None = None) -> None:
        """Steer all vehicles, at rest.

        Args:
            patterns: which pattern each digit chooses, see :func:`digits`.
        """
        self.patterns = dict(patterns or {})
        self.target = Target.ALL
        self.note = ""
        self._counts = [0, 0, 0, 0]  # presses along each axis: sums of 0.01 would drift
        self._moving = False  # the target has been told a speed that is not zero

    @property
    def speeds(self) -> tuple[float, float, float, float]:
        """Forward, left, up in m/s (m/s^2), turn in rad/s: multiples of 0.01."""
        forward, left, up, turn = (count / STEPS for count in self._counts)
        return forward, left, up, turn

    def press(self, key: str) -> list[Message]:
        """Take a key, a character; return what is to be said at once. Speeds are told by :meth:`cycle`."""
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
        self.note = f"{key!r} is no key of this keyboard"
        return []

    def cycle(self) -> Steer | None:
        """Return the speeds to be told now, None if there is nothing to tell; 10 Hz."""
        moving, was_moving = any(self._counts), self._moving
        self._moving = moving
        return Steer(self.target, *self.speeds) if moving or was_moving else None

    def stop(self) -> Steer | None:
        """Set all speeds zero; return how to tell those who were steered, None if nobody was."""
        self._counts = [0, 0, 0, 0]
        return self.cycle()

    def _change(self, axis: int, sign: int) -> None:
        count, most = self._counts[axis] + sign, _MOST[axis]
        self.note = f"{AXES[axis]}: {most // STEPS} is the most" if abs(count) > most else ""
        self._counts[axis] = max(-most, min(most, count))

    def _command(self, text: str) -> list[Message]:
        self.note = f"{text} to {self._addressee()}"
        said: list[Message] = [Say(self.target, text)]
        if text == "OFFBOARD" and not any(self._counts):
            self.note += ", hovering"
            said.insert(0, Say(self.target, "HOVER"))
        return said

    def _hover(self) -> list[Message]:
        self._counts = [0, 0, 0, 0]
        self._moving = False
        self.note = f"HOVER to {self._addressee()}"
        # The zero comes last: a speed that was told before may arrive after the command, which has a topic of its own.
        return [Say(self.target, "HOVER"), Steer(self.target)]

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
        return [Say(self.target, name)]

    def _addressee(self) -> str:
        return "the leader" if self.target is Target.LEADER else "all"
