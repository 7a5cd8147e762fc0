"""What a ground station says to have a vehicle arm, take off, fly somewhere, hold, return and land: exchanges.

PX4 and ArduPilot are spoken to as QGroundControl does: PX4 takes the takeoff's altitude over sea level and is armed
after it; ArduPilot takes it over home, in GUIDED and armed. Other autopilots are taken for one like PX4.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from pymavlink.dialects.v20 import common as mavlink

from xtdrone_control.geodesy import geo

from .exchanges import Beat, Exchange, RefusalError, request
from .parameters import fetch
from .state import modes_of

_AUTOPILOT = mavlink.MAV_COMP_ID_AUTOPILOT1
_FORCE = 21196.0
_CHANGE_MODE = 1.0  # MAV_DO_REPOSITION_FLAGS_CHANGE_MODE
_ATTEMPTS = 100  # of a command whose end is not told
_LISTENED = 2  # time-outs in which a vehicle may say why it refuses
_WARNING = 4  # MAV_SEVERITY; what is less grave explains no refusal
_NAN = math.nan
_ALIASES = {
    "HOLD": "AUTO.LOITER",
    "RETURN": "AUTO.RTL",
    "POSITION": "POSCTL",
    "ALTITUDE": "ALTCTL",
    "STABILIZE": "STABILIZED",
}  # of PX4's modes
_HOLDS = ("BRAKE", "HOLD", "LOITER")  # ArduPilot's modes that stay where they are, the best first


@dataclass(frozen=True)
class Target:
    """A place to fly to: in the vehicle's local frame, or on the globe.

    Attributes:
        local: east, north, up from the local frame's origin, m. With a datum that all vehicles share, as the simulator
            has it, that is the map frame.
        place: latitude, longitude, degrees.
        altitude: m, with ``place``.
        over_home: whether the altitude counts from home, not from sea level.
        speed: m/s over ground; NaN: the vehicle's own.
    """

    local: tuple[float, float, float] | None = None
    place: tuple[float, float] | None = None
    altitude: float = _NAN
    over_home: bool = False
    speed: float = _NAN

    def raised(self, height: float) -> Target:
        """Return the place ``height`` m above."""
        local = None if self.local is None else (*self.local[:2], self.local[2] + height)
        return replace(self, local=local, altitude=self.altitude + height)


def command(beat: Beat, number: int, params: Sequence[float], what: str) -> Exchange[None]:
    """Return a COMMAND_LONG.

    Args:
        beat: of the vehicle.
        number: MAV_CMD.
        params: param1 and further ones; those left out are 0.
        what: what it is called when it is refused.

    Raises:
        RefusalError: the vehicle does not accept it; with what it has said of it.
    """
    values = [*params, *[0.0] * (7 - len(params))]

    def message(attempt: int) -> Any:
        return mavlink.MAVLink_command_long_message(beat.system, _AUTOPILOT, number, min(attempt, 255), *values)

    yield from _obeyed(number, message, what)


def _obeyed(number: int, message: Any, what: str) -> Exchange[None]:
    """Send a command, ``message(attempt)``, until its end is told.

    Raises:
        RefusalError: it is refused.
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
                raise RefusalError(f"{what}: the vehicle does not tell how it ends", True)
            outgoing = [message(attempt)]
            continue
        _note(answer, texts)
        if type(answer).__name__ != "COMMAND_ACK" or answer.command != number:
            continue
        if answer.result == mavlink.MAV_RESULT_ACCEPTED:
            return
        if answer.result != mavlink.MAV_RESULT_IN_PROGRESS:
            break
    result = mavlink.enums["MAV_RESULT"].get(answer.result)
    word = f"result {answer.result}" if result is None else result.name.removeprefix("MAV_RESULT_")
    for _ in range(_LISTENED):  # it may say why
        while answer is not None:
            answer = yield []
            _note(answer, texts)
        answer = yield []
        _note(answer, texts)
    said = f" ({'; '.join(texts)})" if texts else ""
    raise RefusalError(f"{what}: the vehicle says {word}{said}", True)


def _note(answer: Any, texts: dict[str, None]) -> None:
    if getattr(answer, "id", None) == 0 and getattr(answer, "severity", _WARNING + 1) <= _WARNING:
        texts[str(answer.text).rstrip("\0\t ")] = None


# ---- arming and modes


def arm(beat: Beat, armed: bool = True, force: bool = False) -> Exchange[None]:
    """Arm or disarm a vehicle.

    Args:
        beat: of the vehicle.
        armed: whether it is to be armed.
        force: also where its checks speak against it, and disarm in flight.

    Raises:
        RefusalError: it refuses.
    """
    params = (float(armed), _FORCE if force else 0.0)
    yield from command(beat, mavlink.MAV_CMD_COMPONENT_ARM_DISARM, params, "arm" if armed else "disarm")


def mode_number(beat: Beat, name: str) -> int:
    """Return the ``custom_mode`` of a vehicle's mode.

    Args:
        beat: of the vehicle.
        name: of the mode, in any case; of PX4's AUTO modes the part behind the dot is enough.

    Raises:
        RefusalError: it has none of that name.
    """
    known = {mode: number for number, mode in modes_of(beat.autopilot, beat.kind).items()}
    wanted = name.upper()
    if beat.autopilot == mavlink.MAV_AUTOPILOT_PX4:
        wanted = _ALIASES.get(wanted, wanted)
    for candidate in (wanted, f"AUTO.{wanted}"):
        if candidate in known:
            return known[candidate]
    allowed = ", ".join(sorted(known)) or "none, its autopilot is neither PX4 nor ArduPilot"
    raise RefusalError(f"mode: {name!r} is not allowed, one of the vehicle's: {allowed}", True)


def set_mode(beat: Beat, name: str) -> Exchange[None]:
    """Have a vehicle fly in a mode; see ``mode_number``.

    Raises:
        RefusalError: it has no such mode, or refuses it.
    """
    number = mode_number(beat, name)
    custom = [float(number)]
    if beat.autopilot == mavlink.MAV_AUTOPILOT_PX4:
        custom = [float(number >> 16 & 0xFF), float(number >> 24)]
    params = [float(mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED), *custom]
    yield from command(beat, mavlink.MAV_CMD_DO_SET_MODE, params, f"mode {name}")


def hold(beat: Beat) -> Exchange[None]:
    """Have a vehicle stay where it is.

    Raises:
        RefusalError: it refuses.
    """
    known = modes_of(beat.autopilot, beat.kind).values()
    ardupilot = beat.autopilot == mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA
    name = next((mode for mode in _HOLDS if mode in known), "LOITER") if ardupilot else "HOLD"
    yield from set_mode(beat, name)


def rtl(beat: Beat) -> Exchange[None]:
    """Have a vehicle return to its home.

    Raises:
        RefusalError: it refuses.
    """
    yield from command(beat, mavlink.MAV_CMD_NAV_RETURN_TO_LAUNCH, (), "rtl")


def land(beat: Beat) -> Exchange[None]:
    """Have a vehicle land where it is.

    Raises:
        RefusalError: it refuses.
    """
    yield from command(beat, mavlink.MAV_CMD_NAV_LAND, (), "land")


# ---- flying


def take_off(beat: Beat, height: float) -> Exchange[float]:
    """Have a vehicle that is on the ground arm and climb.

    Args:
        beat: of the vehicle.
        height: m over where it is.

    Returns:
        Where it climbs to, m: a PX4 does not climb less than MIS_TAKEOFF_ALT. It takes its height for reached
        NAV_MC_ALT_RAD (0.8 m) before it, and holds where it has come to rest then.

    Raises:
        RefusalError: it flies, does not know where it is, or refuses.
    """
    landed = yield from request(beat.system, "EXTENDED_SYS_STATE")
    if landed is not None and landed.landed_state in (2, 3, 4):  # MAV_LANDED_STATE
        raise RefusalError("takeoff: the vehicle is in the air", True)
    take_off_command = mavlink.MAV_CMD_NAV_TAKEOFF
    if beat.autopilot == mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA:
        yield from set_mode(beat, "GUIDED")
        yield from arm(beat)
        yield from command(beat, take_off_command, (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, height), "takeoff")
        return height
    here = yield from request(beat.system, "GLOBAL_POSITION_INT")
    if here is None:
        raise RefusalError("takeoff: the vehicle does not know where it is", True)
    if beat.autopilot == mavlink.MAV_AUTOPILOT_PX4:
        least, _ = (yield from fetch(beat, ["MIS_TAKEOFF_ALT"]))["MIS_TAKEOFF_ALT"]
        height = max(height, least)
    altitude = here.alt * 1e-3 + height
    yield from command(beat, take_off_command, (-1.0, 0.0, 0.0, _NAN, _NAN, _NAN, altitude), "takeoff")
    yield from arm(beat)
    return height


def go_to(beat: Beat, target: Target) -> Exchange[None]:
    """Have a flying vehicle go to a place and stay there.

    Raises:
        RefusalError: it does not know where that is, or refuses.
    """
    latitude, longitude, altitude = yield from _on_the_globe(beat, target)
    speed = -1.0 if math.isnan(target.speed) else target.speed
    number = mavlink.MAV_CMD_DO_REPOSITION
    place = round(latitude * 1e7), round(longitude * 1e7), altitude
    message = mavlink.MAVLink_command_int_message(
        beat.system, _AUTOPILOT, mavlink.MAV_FRAME_GLOBAL, number, 0, 0, speed, _CHANGE_MODE, 0.0, _NAN, *place
    )
    yield from _obeyed(number, lambda _: message, "goto")


def _on_the_globe(beat: Beat, target: Target) -> Exchange[tuple[float, float, float]]:
    """Return latitude, longitude, degrees, and altitude, m AMSL, of a target.

    Raises:
        RefusalError: the vehicle lacks what it counts from.
    """
    if target.local is not None:
        origin = yield from request(beat.system, "GPS_GLOBAL_ORIGIN")
        if origin is None:
            raise RefusalError("goto: the vehicle's local frame has no place on the globe", True)
        east, north, up = target.local
        place = geo.reproject(north, east, origin.latitude * 1e-7, origin.longitude * 1e-7)
        return *place, origin.altitude * 1e-3 + up
    if target.place is None:
        raise ValueError("target: neither a local place nor one on the globe")
    altitude = target.altitude
    if target.over_home:
        home = yield from request(beat.system, "HOME_POSITION")
        if home is None:
            raise RefusalError("goto: the vehicle has no home", True)
        altitude += home.altitude * 1e-3
    return *target.place, altitude
