"""Flight-mode names of MAVROS for PX4's custom modes (PX4 ``px4_custom_mode.h``; MAVROS wiki, CustomModes)."""

from __future__ import annotations

from xtdrone_control.modes import CUSTOM_FLAG, PX4_MODES

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
