"""One page's keyboard and gamepad: the keyboard program's rules for a page that may disconnect."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

from xtdrone_interaction.keyboard.key_bindings import MAX_SPEED, MAX_TURN, Command, Message, Pilot, Setpoint, Target

SILENCE = 1.0  # s without a message from the page after which the vehicles are stopped
_KEYS = frozenset("wxad,ijltyvnrbskg0123456789")
_LIMITS = (MAX_SPEED, MAX_SPEED, MAX_SPEED, MAX_TURN)

Send = Callable[[str, Message], None]
"""Called with the name of a vehicle, or ``leader``, and the message."""


class PagePilot:
    """Keys and sticks of a page, as messages for vehicles or the leader.

    The vehicles are stopped when the page has sent nothing for a second, when it closes, and when it selects other
    ones.
    """

    def __init__(self, vehicles: Sequence[str], leader: bool, patterns: Mapping[str, str], send: Send) -> None:
        """Start with zero speeds.

        Args:
            vehicles: names of those that the keys fly.
            leader: fly the leader first, not the vehicles; the key ``g`` changes that.
            patterns: of the leader, by digit.
            send: publishes a message.
        """
        self._vehicles = tuple(vehicles)
        self._pilot = Pilot(patterns)
        self._pilot.target = Target.LEADER if leader else Target.ALL
        self._send = send
        self._heard = 0.0

    @property
    def targets(self) -> frozenset[str]:
        """Receivers of the keys' commands now: the vehicles' names, or ``leader``."""
        return frozenset(("leader",) if self._pilot.target is Target.LEADER else self._vehicles)

    @property
    def state(self) -> dict[str, object]:
        """Target, speeds (m/s, rad/s) and the last key's effect, for the page."""
        return {
            "leader": self._pilot.target is Target.LEADER,
            "speeds": list(self._pilot.speeds),
            "note": self._pilot.note,
            "patterns": self._pilot.patterns,
        }

    def press(self, key: str, now: float) -> None:
        """Process a key of multirotor_keyboard_control.

        Raises:
            ValueError: it is none.
        """
        if key not in _KEYS or len(key) != 1:
            raise ValueError(f"key: {str(key)[:20]!r} is not allowed, one of {' '.join(sorted(_KEYS))}")
        self._heard = now
        self._publish(self._pilot.press(key))

    def steer(self, speeds: object, now: float) -> None:
        """Set the speeds forward, left, up (m/s) and turn (rad/s), as sticks do.

        Raises:
            ValueError: they are not four numbers within the limits.
        """
        good = isinstance(speeds, (list, tuple)) and len(speeds) == len(_LIMITS)
        if not good or not all(
            type(value) in (int, float) and -most <= value <= most
            for value, most in zip(speeds, _LIMITS, strict=True)  # type: ignore[call-overload]
        ):
            allowed = (
                f"forward, left, up from -{MAX_SPEED} to {MAX_SPEED} m/s, turn from -{MAX_TURN} to {MAX_TURN} rad/s"
            )
            raise ValueError(f"speeds: {str(speeds)[:80]} is not allowed, {allowed}")
        self._heard = now
        self._pilot.steer(*speeds)  # type: ignore[misc]

    def alive(self, now: float) -> None:
        """Register that the page is still connected."""
        self._heard = now

    def cycle(self, now: float) -> None:
        """Publish the setpoint; to be called at 10 Hz."""
        if now - self._heard > SILENCE and any(self._pilot.speeds):
            self._publish([self._pilot.stop()])
            self._pilot.note = f"stopped: the page was silent for {SILENCE:g} s"
            return
        self._publish([self._pilot.cycle()])

    def end(self) -> None:
        """Stop the vehicles for good."""
        self._publish([self._pilot.stop()])

    def _publish(self, messages: Sequence[Message | None]) -> None:
        for message in messages:
            if isinstance(message, (Command, Setpoint)):
                for name in ("leader",) if message.target is Target.LEADER else self._vehicles:
                    self._send(name, message)
