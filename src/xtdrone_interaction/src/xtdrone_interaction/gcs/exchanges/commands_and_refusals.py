"""Exchanges that command a vehicle to arm, take off, go to a position, hold, return and land.

PX4 is commanded as by QGroundControl: the altitude of a takeoff counts from sea level, and arming follows.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from pymavlink.dialects.v20 import common as mavlink

from xtdrone_common.geodesy import projection

from ..vehicle_state import MODES, name_constant
from .exchange import AUTOPILOT, Exchange, Heartbeat, RefusalError, fetch_message
from .parameters import fetch as fetch_parameters

_FORCE = 21196.0
_CHANGE_MODE = 1.0  # MAV_DO_REPOSITION_FLAGS_CHANGE_MODE
_ATTEMPTS = 100  # of a command without a final acknowledgement
_REASON_TIMEOUTS = 2  # timeouts to wait for the reason of a refusal
_WARNING = 4  # MAV_SEVERITY; less severe texts do not explain a refusal
_NAN = math.nan
_ALIASES = {
    "HOLD": "AUTO.LOITER",
    "RETURN": "AUTO.RTL",
    "POSITION": "POSCTL",
    "ALTITUDE": "ALTCTL",
    "STABILIZE": "STABILIZED",
}  # names of PX4's modes in QGroundControl


@dataclass(frozen=True)
class Target:
    """A position to go to, local or global.

    Attributes:
        local: position in the local frame, ENU, m. In the simulator all vehicles share its origin: it is the map frame.
        place: latitude and longitude, degrees.
        altitude: of ``place``, m.
        over_home: whether ``altitude`` counts from home rather than from sea level.
        speed: ground speed, m/s; NaN for the vehicle's default.
    """

    local: tuple[float, float, float] | None = None
    place: tuple[float, float] | None = None
    altitude: float = _NAN
    over_home: bool = False
    speed: float = _NAN

    def raised(self, height: float) -> Target:
        """Return the position ``height`` m above."""
        local = None if self.local is None else (*self.local[:2], self.local[2] + height)
        return replace(self, local=local, altitude=self.altitude + height)


def command(heartbeat: Heartbeat, number: int, params: Sequence[float], what: str) -> Exchange[None]:
    """Send a COMMAND_LONG.

    Args:
        heartbeat: of the vehicle.
        number: MAV_CMD.
        params: param1 to at most param7; the rest are 0.
        what: name of the command in error messages.

    Raises:
        RefusalError: the vehicle rejects it; with the status texts about it.
    """
    values = [*params, *[0.0] * (7 - len(params))]

    def message(attempt: int) -> Any:
        return mavlink.MAVLink_command_long_message(heartbeat.system, AUTOPILOT, number, min(attempt, 255), *values)

    yield from _command_until_done(number, message, what)


def _command_until_done(number: int, message: Any, what: str) -> Exchange[None]:
    """Send a command, ``message(attempt)``, until it is accepted.

    Raises:
        RefusalError: it is rejected, or has no final acknowledgement.
    """
    texts: dict[str, None] = {}
    outgoing = [message(0)]
    attempt = 0
    while True:
        answer = yield outgoing
        outgoing = []
        if answer is None:
            attempt += 1
            if attempt > _ATTEMPTS:
                raise RefusalError(f"{what}: the vehicle sends no final acknowledgement", True)
            outgoing = [message(attempt)]
            continue
        _collect_text(answer, texts)
        if type(answer).__name__ != "COMMAND_ACK" or answer.command != number:
            continue
        if answer.result == mavlink.MAV_RESULT_ACCEPTED:
            return
        if answer.result != mavlink.MAV_RESULT_IN_PROGRESS:
            break
    word = name_constant("MAV_RESULT", answer.result).upper()
    for _ in range(_REASON_TIMEOUTS):  # a status text may explain it
        while answer is not None:
            answer = yield []
            _collect_text(answer, texts)
        answer = yield []
        _collect_text(answer, texts)
    said = f" ({'; '.join(texts)})" if texts else ""
    raise RefusalError(f"{what}: the vehicle answers {word}{said}", True)


def _collect_text(answer: Any, texts: dict[str, None]) -> None:
    if getattr(answer, "id", None) == 0 and getattr(answer, "severity", _WARNING + 1) <= _WARNING:
        texts[str(answer.text).rstrip("\0\t ")] = None


# arming and modes


def arm(heartbeat: Heartbeat, armed: bool = True, force: bool = False) -> Exchange[None]:
    """Arm or disarm a vehicle.

    Args:
        heartbeat: of the vehicle.
        armed: False to disarm.
        force: arm despite failed checks; disarm in flight.

    Raises:
        RefusalError: the vehicle rejects it.
    """
    params = (float(armed), _FORCE if force else 0.0)
    yield from command(heartbeat, mavlink.MAV_CMD_COMPONENT_ARM_DISARM, params, "arm" if armed else "disarm")


def set_mode(heartbeat: Heartbeat, name: str) -> Exchange[None]:
    """Set the mode of a vehicle.

    Args:
        heartbeat: Heartbeat of the vehicle.
        name: Name of the mode, in any case; for AUTO modes the part after the dot suffices.

    Raises:
        RefusalError: unknown mode, or the vehicle rejects it.
    """
    numbers = {mode: number for number, mode in MODES.items()}
    wanted = _ALIASES.get(name.upper(), name.upper())
    number = numbers.get(wanted, numbers.get(f"AUTO.{wanted}"))
    if number is None:
        raise RefusalError(f"mode: {name!r} is not allowed, one of the vehicle's: {', '.join(sorted(numbers))}", True)
    params = (float(mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED), float(number >> 16 & 0xFF), float(number >> 24))
    yield from command(heartbeat, mavlink.MAV_CMD_DO_SET_MODE, params, f"mode {name}")


def hold(heartbeat: Heartbeat) -> Exchange[None]:
    """Command a vehicle to hold its position.

    Raises:
        RefusalError: the vehicle rejects it.
    """
    yield from set_mode(heartbeat, "HOLD")


def rtl(heartbeat: Heartbeat) -> Exchange[None]:
    """Command a vehicle to return to its home position.

    Raises:
        RefusalError: the vehicle rejects it.
    """
    yield from command(heartbeat, mavlink.MAV_CMD_NAV_RETURN_TO_LAUNCH, (), "rtl")


def land(heartbeat: Heartbeat) -> Exchange[None]:
    """Command a vehicle to land at its position.

    Raises:
        RefusalError: the vehicle rejects it.
    """
    yield from command(heartbeat, mavlink.MAV_CMD_NAV_LAND, (), "land")


# flight


def take_off(heartbeat: Heartbeat, height: float) -> Exchange[float]:
    """Command a vehicle on the ground to arm and climb.

    Args:
        heartbeat: of the vehicle.
        height: m above its position.

    Returns:
        The height that it climbs to, m: at least MIS_TAKEOFF_ALT; PX4 accepts NAV_MC_ALT_RAD (0.8 m) below it
        as reached and holds there.

    Raises:
        RefusalError: the vehicle is flying, has no position, or rejects it.
    """
    landed = yield from fetch_message(heartbeat.system, "EXTENDED_SYS_STATE")
    if landed is not None and landed.landed_state in (2, 3, 4):  # MAV_LANDED_STATE
        raise RefusalError("takeoff: the vehicle is in the air", True)
    here = yield from fetch_message(heartbeat.system, "GLOBAL_POSITION_INT")
    if here is None:
        raise RefusalError("takeoff: the vehicle has no position estimate", True)
    least, _ = (yield from fetch_parameters(heartbeat, ["MIS_TAKEOFF_ALT"]))["MIS_TAKEOFF_ALT"]
    height = max(height, least)
    altitude = here.alt * 1e-3 + height
    params = (-1.0, 0.0, 0.0, _NAN, _NAN, _NAN, altitude)
    yield from command(heartbeat, mavlink.MAV_CMD_NAV_TAKEOFF, params, "takeoff")
    yield from arm(heartbeat)
    return height


def go_to(heartbeat: Heartbeat, target: Target) -> Exchange[None]:
    """Command a flying vehicle to go to a position and hold there.

    Raises:
        RefusalError: the vehicle stands disarmed, which PX4 accepts without flying, lacks the target's reference, or
            rejects it.
    """
    if not heartbeat.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED:
        landed = yield from fetch_message(heartbeat.system, "EXTENDED_SYS_STATE")
        if landed is not None and landed.landed_state == mavlink.MAV_LANDED_STATE_ON_GROUND:
            raise RefusalError("goto: the vehicle is on the ground and disarmed", True)
    latitude, longitude, altitude = yield from _global_position(heartbeat, target)
    speed = -1.0 if math.isnan(target.speed) else target.speed
    number = mavlink.MAV_CMD_DO_REPOSITION
    place = round(latitude * 1e7), round(longitude * 1e7), altitude
    message = mavlink.MAVLink_command_int_message(
        heartbeat.system, AUTOPILOT, mavlink.MAV_FRAME_GLOBAL, number, 0, 0, speed, _CHANGE_MODE, 0.0, _NAN, *place
    )
    yield from _command_until_done(number, lambda _: message, "goto")


def _global_position(heartbeat: Heartbeat, target: Target) -> Exchange[tuple[float, float, float]]:
    """Convert a target to latitude and longitude, degrees, and altitude, m AMSL.

    Raises:
        RefusalError: the vehicle has no local origin, or no home position.
    """
    if target.local is not None:
        origin = yield from fetch_message(heartbeat.system, "GPS_GLOBAL_ORIGIN")
        if origin is None:
            raise RefusalError("goto: the vehicle's local frame has no global origin", True)
        east, north, up = target.local
        place = projection.reproject(north, east, origin.latitude * 1e-7, origin.longitude * 1e-7)
        return *place, origin.altitude * 1e-3 + up
    if target.place is None:
        raise ValueError("target: neither a local nor a global position")
    altitude = target.altitude
    if target.over_home:
        home = yield from fetch_message(heartbeat.system, "HOME_POSITION")
        if home is None:
            raise RefusalError("goto: the vehicle has no home", True)
        altitude += home.altitude * 1e-3
    return *target.place, altitude
