"""Flight modes: PX4's custom modes with MAVROS's names and the requirements of each mode.

After PX4 v1.14's ``px4_custom_mode.h`` and, for a multirotor, ``mode_requirements.cpp``.
"""

from __future__ import annotations

from dataclasses import dataclass

MAIN_AUTO = 4

# MAV_MODE_FLAG bits of base_mode
ARMED_FLAG = 128
CUSTOM_FLAG = 1
_MANUAL, _STABILISED, _GUIDED, _AUTO, _CUSTOM = 64, 16, 8, 4, CUSTOM_FLAG


@dataclass(frozen=True, eq=False)
class Mode:
    """A flight mode; modes are singletons and compared by identity.

    Attributes:
        name: MAVROS's name, such as AUTO.LOITER.
        label: PX4's name in its texts, such as AUTO_LOITER.
        state: PX4's navigation state.
        main: PX4 main mode.
        sub: PX4 sub mode of AUTO modes and ORBIT; 0 for others.
        flags: base_mode without the armed bit.
        needs: requirements of the mode: "attitude", "altitude", "position" (accurate horizontal estimate),
            "relaxed_position" (any horizontal estimate), "global_position", "home", "mission", "offboard".
        sticks: whether the pilot flies by stick; such a mode requires manual control.
        prevents_arming: whether arming is rejected in this mode; disarming leaves it.
        attitude_control: whether the attitude is controlled, so that the failure detector's limits apply.
    """

    name: str
    label: str
    state: int
    main: int
    sub: int
    flags: int
    needs: frozenset[str]
    sticks: bool = False
    prevents_arming: bool = False
    attitude_control: bool = True

    @property
    def custom_mode(self) -> int:
        """HEARTBEAT.custom_mode of the mode."""
        return self.main << 16 | self.sub << 24

    @property
    def needs_position(self) -> bool:
        """Whether the mode needs a horizontal estimate, which OFFBOARD does for most setpoints."""
        return not self.needs.isdisjoint(("position", "relaxed_position", "offboard"))

    @property
    def auto(self) -> bool:
        """Whether the navigator flies the mode."""
        return self is ORBIT or (self.main == MAIN_AUTO and self is not DESCEND)


_STICKS = _CUSTOM | _STABILISED | _MANUAL
_PILOT = _CUSTOM | _STABILISED | _GUIDED | _AUTO
_ATTITUDE = frozenset({"attitude"})
_HEIGHT = _ATTITUDE | {"altitude"}
_ABOUT = _HEIGHT | {"relaxed_position"}
_EXACT = _HEIGHT | {"position"}
_GLOBAL = _EXACT | {"global_position"}

MANUAL = Mode("MANUAL", "MANUAL", 0, 1, 0, _STICKS, _ATTITUDE, sticks=True)
ALTCTL = Mode("ALTCTL", "ALTCTL", 1, 2, 0, _STICKS, _HEIGHT, sticks=True)
POSCTL = Mode("POSCTL", "POSCTL", 2, 3, 0, _STICKS, _ABOUT, sticks=True)
AUTO_MISSION = Mode("AUTO.MISSION", "AUTO_MISSION", 3, MAIN_AUTO, 4, _PILOT, _GLOBAL | {"mission"})
AUTO_LOITER = Mode("AUTO.LOITER", "AUTO_LOITER", 4, MAIN_AUTO, 3, _PILOT, _GLOBAL)
AUTO_RTL = Mode("AUTO.RTL", "AUTO_RTL", 5, MAIN_AUTO, 5, _PILOT, _GLOBAL | {"home"}, prevents_arming=True)
ACRO = Mode("ACRO", "ACRO", 10, 5, 0, _CUSTOM | _MANUAL, frozenset(), sticks=True, attitude_control=False)
# PX4 reports its DESCEND state as AUTO.LAND, and TERMINATION as MANUAL
DESCEND = Mode("AUTO.LAND", "DESCEND", 12, MAIN_AUTO, 6, _PILOT, _ATTITUDE, prevents_arming=True)
TERMINATION = Mode(
    "MANUAL", "TERMINATION", 13, 1, 0, _CUSTOM | _MANUAL, frozenset(), prevents_arming=True, attitude_control=False
)
OFFBOARD = Mode("OFFBOARD", "OFFBOARD", 14, 6, 0, _CUSTOM | _STABILISED, _ATTITUDE | {"offboard"})
STABILIZED = Mode("STABILIZED", "STAB", 15, 7, 0, _STICKS, _ATTITUDE, sticks=True)
AUTO_TAKEOFF = Mode("AUTO.TAKEOFF", "AUTO_TAKEOFF", 17, MAIN_AUTO, 2, _PILOT, _EXACT)
AUTO_LAND = Mode("AUTO.LAND", "AUTO_LAND", 18, MAIN_AUTO, 6, _PILOT, _ABOUT, prevents_arming=True)
AUTO_FOLLOW_TARGET = Mode(
    "AUTO.FOLLOW_TARGET", "AUTO_FOLLOW_TARGET", 19, MAIN_AUTO, 8, _CUSTOM | _STABILISED, _EXACT, prevents_arming=True
)
ORBIT = Mode("ORBIT", "ORBIT", 21, 3, 1, _CUSTOM | _STABILISED, _EXACT)
AUTO_PRECLAND = Mode("AUTO.PRECLAND", "AUTO_PRECLAND", 20, MAIN_AUTO, 9, _PILOT, _EXACT, prevents_arming=True)

# modes that a client can select
SUPPORTED = (
    *(MANUAL, ALTCTL, POSCTL, ACRO, OFFBOARD, STABILIZED),
    *(AUTO_TAKEOFF, AUTO_LOITER, AUTO_MISSION, AUTO_RTL, AUTO_LAND, AUTO_FOLLOW_TARGET, AUTO_PRECLAND),
)
ALL = (*SUPPORTED, ORBIT, DESCEND, TERMINATION)
_BY_CUSTOM_MODE = {mode.custom_mode: mode for mode in SUPPORTED}
_BY_STATE = {mode.state: mode for mode in SUPPORTED}
# navigation state to PX4's mode number in COM_FLTMODE1..6 and in events (navigation_mode_t)
_NUMBERS = {0: 0, 1: 1, 2: 2, 3: 3, 4: 4, 5: 5, 10: 6, 14: 7, 15: 8, 17: 10, 18: 11, 19: 12, 20: 13, 21: 14}
_BY_NUMBER = {number: _BY_STATE[state] for state, number in _NUMBERS.items() if state in _BY_STATE}
UNKNOWN_NUMBER = 255


def from_custom_mode(custom_mode: int) -> Mode | None:
    """Return the mode of HEARTBEAT.custom_mode, or None; AUTO without a sub mode is AUTO.MISSION, as in PX4."""
    if custom_mode == MAIN_AUTO << 16:
        return AUTO_MISSION
    return _BY_CUSTOM_MODE.get(custom_mode)


def from_base_mode(base_mode: int) -> Mode | None:
    """Return the mode that PX4 selects for MAV_MODE_FLAG bits without the custom bit, or None."""
    if base_mode & _AUTO:
        return AUTO_MISSION
    if not base_mode & _MANUAL:
        return None
    if base_mode & _GUIDED:
        return POSCTL
    return STABILIZED if base_mode & _STABILISED else MANUAL


def from_number(number: int) -> Mode | None:
    """Return the mode for a value of COM_FLTMODE1..6, or None."""
    return _BY_NUMBER.get(number)


def number_of(mode: Mode) -> int:
    """Return PX4's navigation_mode_t of ``mode``, used as an event argument."""
    return _NUMBERS.get(mode.state, UNKNOWN_NUMBER)


PX4_MODES = {mode.name: mode.custom_mode for mode in SUPPORTED} | {
    "RATTITUDE": 8 << 16,
    "AUTO.READY": MAIN_AUTO << 16 | 1 << 24,
    "AUTO.RTGS": MAIN_AUTO << 16 | 7 << 24,
}
"""MAVROS mode name to custom mode; the last three are accepted as names only."""


_NAMES = {number: name for name, number in PX4_MODES.items()}


class ModeError(ValueError):
    """An unknown flight mode."""


def mode_number(name: str) -> int:
    """Return the custom mode for a mode name or a decimal number; MAVROS accepts both.

    Raises:
        ModeError: neither a mode name nor a number in 0..2^32-1.
    """
    if name in PX4_MODES:
        return PX4_MODES[name]
    if name.isdecimal() and int(name) < 1 << 32:
        return int(name)
    raise ModeError(f"mode {name!r} is not known; allowed are {', '.join(sorted(PX4_MODES))} or a custom mode's number")


def mode_name(base_mode: int, custom_mode: int) -> str:
    """Return the mode name of a heartbeat; ``CMODE(n)`` or ``MODE(0xbb)`` for an unknown mode."""
    if not base_mode & CUSTOM_FLAG:
        return f"MODE(0x{base_mode:02X})"
    return _NAMES.get(custom_mode, f"CMODE({custom_mode})")
