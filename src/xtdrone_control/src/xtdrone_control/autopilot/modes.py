"""Flight modes: PX4's custom modes by MAVROS's names (PX4 ``px4_custom_mode.h``)."""

from __future__ import annotations

from dataclasses import dataclass

MAIN_AUTO = 4

# MAV_MODE_FLAG bits of base_mode
ARMED_FLAG = 128
_MANUAL, _STABILISED, _GUIDED, _AUTO, _CUSTOM = 64, 16, 8, 4, 1


@dataclass(frozen=True)
class Mode:
    """A flight mode.

    Attributes:
        name: MAVROS's name, as AUTO.LOITER.
        main: PX4 main mode.
        sub: PX4 sub mode, 0 outside the AUTO modes.
        flags: base_mode without the armed bit.
        needs_position: whether it flies by the horizontal estimate.
    """

    name: str
    main: int
    sub: int
    flags: int
    needs_position: bool

    @property
    def custom_mode(self) -> int:
        """Number in the heartbeat's custom_mode."""
        return self.main << 16 | self.sub << 24


_STICKS = _CUSTOM | _STABILISED | _MANUAL
_PILOT = _CUSTOM | _STABILISED | _GUIDED | _AUTO

MANUAL = Mode("MANUAL", 1, 0, _CUSTOM | _MANUAL, False)
ALTCTL = Mode("ALTCTL", 2, 0, _STICKS, False)
POSCTL = Mode("POSCTL", 3, 0, _STICKS, True)
ACRO = Mode("ACRO", 5, 0, _CUSTOM | _MANUAL, False)
OFFBOARD = Mode("OFFBOARD", 6, 0, _CUSTOM | _STABILISED, True)
STABILIZED = Mode("STABILIZED", 7, 0, _STICKS, False)
AUTO_TAKEOFF = Mode("AUTO.TAKEOFF", MAIN_AUTO, 2, _PILOT, True)
AUTO_LOITER = Mode("AUTO.LOITER", MAIN_AUTO, 3, _PILOT, True)
AUTO_MISSION = Mode("AUTO.MISSION", MAIN_AUTO, 4, _PILOT, True)
AUTO_RTL = Mode("AUTO.RTL", MAIN_AUTO, 5, _PILOT, True)
AUTO_LAND = Mode("AUTO.LAND", MAIN_AUTO, 6, _PILOT, True)
AUTO_PRECLAND = Mode("AUTO.PRECLAND", MAIN_AUTO, 9, _PILOT, True)
DESCEND = Mode("AUTO.LAND", MAIN_AUTO, 6, _PILOT, False)  # PX4 reports its DESCEND state as AUTO.LAND

# modes that a client may ask for and that are flown
SUPPORTED = (POSCTL, OFFBOARD, AUTO_TAKEOFF, AUTO_LOITER, AUTO_MISSION, AUTO_RTL, AUTO_LAND, AUTO_PRECLAND)
_KNOWN = (*SUPPORTED, MANUAL, ALTCTL, ACRO, STABILIZED)
_BY_CUSTOM_MODE = {mode.custom_mode: mode for mode in _KNOWN}


def from_custom_mode(custom_mode: int) -> Mode | None:
    """Return the mode with that number, or None."""
    return _BY_CUSTOM_MODE.get(custom_mode)
