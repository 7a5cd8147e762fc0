"""Flight-mode names of MAVROS for PX4's custom modes (PX4 ``px4_custom_mode.h``; MAVROS wiki, CustomModes)."""

from __future__ import annotations

_MAIN = {"MANUAL": 1, "ALTCTL": 2, "POSCTL": 3, "ACRO": 5, "OFFBOARD": 6, "STABILIZED": 7, "RATTITUDE": 8}
_AUTO = {
    "AUTO.READY": 1,
    "AUTO.TAKEOFF": 2,
    "AUTO.LOITER": 3,
    "AUTO.MISSION": 4,
    "AUTO.RTL": 5,
    "AUTO.LAND": 6,
    "AUTO.RTGS": 7,
    "AUTO.FOLLOW_TARGET": 8,
    "AUTO.PRECLAND": 9,
}
_MAIN_AUTO = 4
_CUSTOM_MODE_ENABLED = 1

MODES: dict[str, int] = {name: main << 16 for name, main in _MAIN.items()} | {
    name: _MAIN_AUTO << 16 | sub << 24 for name, sub in _AUTO.items()
}
_NAMES = {number: name for name, number in MODES.items()}


class ModeError(ValueError):
    """A flight mode that does not exist."""


def mode_number(name: str) -> int:
    """Return the custom mode of ``name``, or of a plain decimal number, as MAVROS accepts both.

    Raises:
        ModeError: neither a mode's name nor a number in 0..2^32-1.
    """
    if name in MODES:
        return MODES[name]
    if name.isdecimal() and int(name) < 1 << 32:
        return int(name)
    raise ModeError(f"mode {name!r} is not known; allowed are {', '.join(sorted(MODES))} or a custom mode's number")


def mode_name(base_mode: int, custom_mode: int) -> str:
    """Return the name for a heartbeat's modes; ``CMODE(n)`` or ``MODE(0xbb)`` when there is none."""
    if not base_mode & _CUSTOM_MODE_ENABLED:
        return f"MODE(0x{base_mode:02X})"
    return _NAMES.get(custom_mode, f"CMODE({custom_mode})")
