"""MAV_CMD: what COMMAND_LONG and COMMAND_INT ask for, and the answer.

The results are those of a PX4 v1.14 for what is done here; a command that PX4 accepts and that nothing here would obey
(regions of interest, gimbals, cameras, orbit) is answered UNSUPPORTED.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from pymavlink.dialects.v20 import common as mavlink

from xtdrone_control.autopilot import modes
from xtdrone_control.autopilot.commander import CRITICAL, Commander, Result
from xtdrone_control.autopilot.parameters import ParameterError

from .dialect import MESSAGE_ID
from .link import Link

_NAN = math.nan
_INT32_UNSET = 0x7FFFFFFF  # COMMAND_INT's x and y when they are not given
_FORCE = 21196.0
_FORCE_ARM = 2989.0
_CHANGE_MODE_FLAG = 1  # MAV_DO_REPOSITION_FLAGS
_RELATIVE_FRAMES = (3, 6)  # MAV_FRAME_GLOBAL_RELATIVE_ALT(_INT)
_GLOBAL_FRAMES = (0, 5, *_RELATIVE_FRAMES)
_PX4_VERSION = 0x010E03FF  # 1.14.3 release: whose behaviour, names and parameters these are
_CAPABILITIES = (
    mavlink.MAV_PROTOCOL_CAPABILITY_PARAM_FLOAT
    | mavlink.MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_BYTEWISE
    | mavlink.MAV_PROTOCOL_CAPABILITY_MISSION_INT
    | mavlink.MAV_PROTOCOL_CAPABILITY_COMMAND_INT
    | mavlink.MAV_PROTOCOL_CAPABILITY_SET_ATTITUDE_TARGET
    | mavlink.MAV_PROTOCOL_CAPABILITY_SET_POSITION_TARGET_LOCAL_NED
    | mavlink.MAV_PROTOCOL_CAPABILITY_SET_POSITION_TARGET_GLOBAL_INT
    | mavlink.MAV_PROTOCOL_CAPABILITY_MAVLINK2
)


@dataclass(frozen=True)
class Command:
    """A command with its parameters, as COMMAND_LONG has them.

    Attributes:
        number: MAV_CMD.
        params: param1..param7; NaN where COMMAND_INT leaves one out.
        frame: MAV_FRAME of the place in param5..7.
    """

    number: int
    params: tuple[float, float, float, float, float, float, float]
    frame: int = 0


def from_command_int(number: int, frame: int, params: tuple[float, ...], x: int, y: int, z: float) -> Command:
    """Return COMMAND_INT's command; x and y are 1e-7 degrees in global frames."""
    scale = 1e-7 if frame in _GLOBAL_FRAMES else 1.0
    place = [_NAN if value == _INT32_UNSET else value * scale for value in (x, y)]
    return Command(number, (params[0], params[1], params[2], params[3], place[0], place[1], z), frame)


def _whole(value: float) -> int:
    """Return ``value`` as an integer, -1 when it is not a whole number of 0..2^31-1."""
    return int(value) if 0.0 <= value < 2147483648.0 and value == int(value) else -1


class CommandHandler:
    """Obeys the commands of one vehicle."""

    def __init__(self, commander: Commander) -> None:
        """Take the vehicle's commander."""
        self._commander = commander
        self._handlers: dict[int, Callable[[Command, Link, int], Result]] = {
            mavlink.MAV_CMD_NAV_RETURN_TO_LAUNCH: lambda *_: commander.return_to_launch(),
            mavlink.MAV_CMD_NAV_LAND: lambda *_: commander.land(),
            mavlink.MAV_CMD_NAV_TAKEOFF: self._takeoff,
            mavlink.MAV_CMD_DO_SET_MODE: self._set_mode,
            mavlink.MAV_CMD_DO_CHANGE_SPEED: self._change_speed,
            mavlink.MAV_CMD_DO_SET_HOME: self._set_home,
            mavlink.MAV_CMD_DO_CHANGE_ALTITUDE: self._change_altitude,
            mavlink.MAV_CMD_DO_REPOSITION: self._reposition,
            mavlink.MAV_CMD_PREFLIGHT_STORAGE: self._storage,
            mavlink.MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN: self._reboot,
            mavlink.MAV_CMD_MISSION_START: self._start_mission,
            mavlink.MAV_CMD_COMPONENT_ARM_DISARM: self._arm_disarm,
            mavlink.MAV_CMD_RUN_PREARM_CHECKS: lambda *_: Result.ACCEPTED,  # they run all the time
            mavlink.MAV_CMD_GET_HOME_POSITION: self._get_home,
            mavlink.MAV_CMD_GET_MESSAGE_INTERVAL: self._get_interval,
            mavlink.MAV_CMD_SET_MESSAGE_INTERVAL: self._set_interval,
            mavlink.MAV_CMD_REQUEST_MESSAGE: self._request_message,
            mavlink.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES: self._capabilities,
        }

    def run(self, command: Command, link: Link, now_us: int) -> Result:
        """Obey ``command`` that came over ``link``; answers other than the acknowledgement are queued there."""
        handler = self._handlers.get(command.number)
        return Result.UNSUPPORTED if handler is None else handler(command, link, now_us)

    # flight

    def _arm_disarm(self, command: Command, _link: Link, _now_us: int) -> Result:
        arm = command.params[0]
        if arm not in (0.0, 1.0):
            return Result.DENIED
        return self._commander.arm_disarm(arm == 1.0, command.params[1] in (_FORCE, _FORCE_ARM))

    def _set_mode(self, command: Command, _link: Link, _now_us: int) -> Result:
        base, main, sub = (_whole(value) for value in command.params[:3])
        if base < 0 or not 0 <= main <= 255 or not 0 <= sub <= 255:
            return Result.DENIED
        return self._commander.set_mode(base, main << 16 | sub << 24)

    def _altitude(self, command: Command) -> float:
        """Return param7 in m AMSL; NaN when it is relative to a home that is not there."""
        altitude = command.params[6]
        if command.frame not in _RELATIVE_FRAMES:
            return altitude
        home = self._commander.home
        return _NAN if home is None else home.altitude + altitude

    def _takeoff(self, command: Command, _link: Link, _now_us: int) -> Result:
        # without a place PX4 takes the altitude for not given either: COMMAND_LONG of zeros means "just take off"
        given = any(command.params[4:7])
        if not given:
            return self._commander.takeoff(_NAN, _NAN)
        return self._commander.takeoff(self._altitude(command), math.radians(command.params[3]))

    def _change_speed(self, command: Command, _link: Link, _now_us: int) -> Result:
        return self._commander.change_speed(_whole(command.params[0]), command.params[1])

    def _change_altitude(self, command: Command, _link: Link, _now_us: int) -> Result:
        altitude, frame = command.params[0], _whole(command.params[1])
        home = self._commander.home
        if frame in _RELATIVE_FRAMES:
            altitude += _NAN if home is None else home.altitude
        return self._commander.change_altitude(altitude)

    def _reposition(self, command: Command, _link: Link, _now_us: int) -> Result:
        if not _whole(command.params[1]) & _CHANGE_MODE_FLAG or command.params[1] < 0:
            return Result.UNSUPPORTED
        place = (command.params[4], command.params[5], self._altitude(command))
        return self._commander.reposition(place, math.radians(command.params[3]), command.params[0])

    def _set_home(self, command: Command, _link: Link, _now_us: int) -> Result:
        if command.params[0] == 1.0:
            return self._commander.set_home(None)
        return self._commander.set_home((command.params[4], command.params[5], self._altitude(command)))

    def _start_mission(self, command: Command, _link: Link, _now_us: int) -> Result:
        obstacle = self._commander.navigator.mission_obstacle()
        if obstacle:
            self._commander.say(CRITICAL, obstacle)
            return Result.DENIED
        first = command.params[0]  # the last item, param2, means nothing to PX4
        if not -1.0 <= first < len(self._commander.navigator.plans.mission):
            return Result.DENIED
        if first >= 0.0:
            self._commander.navigator.set_current(int(first))
        result = self._commander.request(modes.AUTO_MISSION)
        return result if result is not Result.ACCEPTED else self._commander.arm_disarm(True)

    # housekeeping

    def _storage(self, command: Command, _link: Link, _now_us: int) -> Result:
        action = _whole(command.params[0])
        if action in (0, 1):
            return Result.ACCEPTED  # parameters need no saving: they live as long as the simulator
        if action != 2:
            return Result.DENIED
        try:
            self._commander.parameters.reset()
        except ParameterError:
            return Result.FAILED
        return Result.ACCEPTED

    def _reboot(self, _command: Command, _link: Link, _now_us: int) -> Result:
        self._commander.say(CRITICAL, "Reboot denied: restart the simulator")
        return Result.DENIED

    # messages

    def _send(self, link: Link, number: int, now_us: int) -> Result:
        link.telemetry.refresh(now_us)
        found = link.streams.values(number, lambda text: link.warn("packing", text, now_us))
        if found is None:
            return Result.DENIED
        link.send_values(*found, now_us)
        return Result.ACCEPTED

    def _get_home(self, _command: Command, link: Link, now_us: int) -> Result:
        return self._send(link, MESSAGE_ID["HOME_POSITION"], now_us)

    def _request_message(self, command: Command, link: Link, now_us: int) -> Result:
        number = _whole(command.params[0])
        if number == mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION:
            return self._capabilities(command, link, now_us)
        return self._send(link, number, now_us)

    def _get_interval(self, command: Command, link: Link, _now_us: int) -> Result:
        number = _whole(command.params[0])
        if not 0 <= number <= 0xFFFF:
            return Result.DENIED
        interval = link.streams.interval(number)
        # 0: not available
        link.send_message(mavlink.MAVLink_message_interval_message(number, 0 if interval is None else interval))
        return Result.ACCEPTED

    def _set_interval(self, command: Command, link: Link, now_us: int) -> Result:
        number, interval = _whole(command.params[0]), command.params[1]
        if not math.isfinite(interval):
            return Result.DENIED
        return Result.ACCEPTED if link.streams.set_interval(number, interval, now_us) else Result.FAILED

    def _capabilities(self, _command: Command, link: Link, _now_us: int) -> Result:
        nothing = [0] * 8
        link.send_message(
            mavlink.MAVLink_autopilot_version_message(
                _CAPABILITIES, _PX4_VERSION, _PX4_VERSION, 0, 0, nothing, nothing, nothing, 0, 0, link.system_id
            )
        )
        return Result.ACCEPTED
