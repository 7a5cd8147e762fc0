"""Execution of the MAV_CMDs in COMMAND_LONG and COMMAND_INT, and their results.

The results are those of PX4 v1.14, including commands that get no acknowledgement because their module does not run in
PX4's simulator (camera and gimbal drivers, for example). Commands that PX4 accepts but that are not implemented here
are rejected as UNSUPPORTED; ``tests/test_command_acks.py`` lists them.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from pymavlink.dialects.v20 import common as mavlink

from xtdrone_autopilot import c_casts
from xtdrone_autopilot.commander.commander import CRITICAL, Result
from xtdrone_autopilot.mavlink.client_link import Link
from xtdrone_autopilot.mavlink.service_base import Vehicle
from xtdrone_autopilot.mavlink.wire.dialect import MESSAGE_ID
from xtdrone_autopilot.navigator.gimbal_manager import GimbalManager
from xtdrone_autopilot.navigator.plan import PlanItem
from xtdrone_autopilot.state import FAILURE_GARBAGE, FAILURE_OFF, FAILURE_OK, FAILURE_SLOW, FAILURE_STUCK, FAILURE_WRONG

if TYPE_CHECKING:
    from xtdrone_autopilot.mavlink.service_base import Vehicle

_SENSOR = frozenset({FAILURE_OK, FAILURE_OFF, FAILURE_STUCK, FAILURE_GARBAGE, FAILURE_WRONG, FAILURE_SLOW})
_SWITCH = frozenset({FAILURE_OK, FAILURE_OFF})
_MOTORS = 101

# FAILURE_UNIT to the field of the FAILURES record and the supported FAILURE_TYPEs; other units are not simulated
# (airspeed sensor, servos) or cannot fail
_UNITS: dict[int, tuple[str, frozenset[int]]] = {
    0: ("gyro", _SENSOR),
    1: ("accel", _SENSOR),
    2: ("mag", _SENSOR),
    3: ("baro", _SENSOR),
    4: ("gps", _SENSOR),
    5: ("optical_flow", _SENSOR),
    6: ("vio", _SENSOR),
    7: ("distance_sensor", _SENSOR),
    100: ("battery", _SWITCH),
    _MOTORS: ("motor", _SWITCH),
    104: ("rc_signal", _SWITCH),
}


def _inject(vehicle: Vehicle, unit: int, kind: int, instance: int) -> Result:
    """Inject a failure into a unit, or clear it.

    Args:
        vehicle: vehicle of the unit.
        unit: FAILURE_UNIT.
        kind: FAILURE_TYPE; 0 clears the failure.
        instance: number of the instance, from 1; 0: all. Only motors have more than one.

    Returns:
        ACCEPTED; DENIED while SYS_FAILURE_EN is 0; UNSUPPORTED for a unit, instance or type that is not simulated.
    """
    if not vehicle.commander.parameters.get("SYS_FAILURE_EN"):
        return Result.DENIED
    field, kinds = _UNITS.get(unit, ("", frozenset()))
    count = vehicle.autopilot.rotor_count(vehicle.index) if unit == _MOTORS else 1
    if kind not in kinds or not 0 <= instance <= count:
        return Result.UNSUPPORTED
    record = vehicle.autopilot.failures[vehicle.index]
    if unit != _MOTORS:
        record[field] = kind
    elif instance:
        record[field][instance - 1] = kind
    else:
        record[field][:count] = kind
    return Result.ACCEPTED


_NAN = math.nan
_INT32_UNSET = 0x7FFFFFFF  # x and y that are left out of COMMAND_INT
_NAN_AS_INT = 0x7FF80000  # x and y of a sender that has cast NaN to an integer
_LEAST_UNSET, _MOST_UNSET = 2147483520.0, 2147483904.0  # floats next to INT32_UNSET
_FORCE = 21196
_CHANGE_MODE_FLAG = 1  # MAV_DO_REPOSITION_FLAGS
_RESET_CALIBRATION = 3  # of PREFLIGHT_STORAGE
_BY_TEMPERATURE = 3  # PX4's PREFLIGHT_CALIBRATION_TEMPERATURE_CALIBRATION
_QUICK_ACCEL = 4  # param5 of PREFLIGHT_CALIBRATION
_GLOBAL = 0  # MAV_FRAME_GLOBAL: altitudes are AMSL
_ROI = (
    mavlink.MAV_CMD_NAV_ROI,
    mavlink.MAV_CMD_DO_SET_ROI_LOCATION,
    mavlink.MAV_CMD_DO_SET_ROI_WPNEXT_OFFSET,
    mavlink.MAV_CMD_DO_SET_ROI_NONE,
    mavlink.MAV_CMD_DO_SET_ROI,
)

# MAV_CMDs handled by modules that do not run in PX4's simulator: no acknowledgement
_SILENT_NAMES = """
    NAV_DELAY DO_DIGICAM_CONTROL DO_SET_CAM_TRIGG_DIST DO_GRIPPER DO_SET_CAM_TRIGG_INTERVAL DO_MOUNT_CONTROL_QUAT
    PREFLIGHT_SET_SENSOR_OFFSETS PREFLIGHT_UAVCAN OBLIQUE_SURVEY CONFIGURE_ACTUATOR START_RX_PAIR SET_CAMERA_MODE
    SET_CAMERA_ZOOM SET_CAMERA_FOCUS DO_TRIGGER_CONTROL CONTROL_HIGH_LATENCY DO_VTOL_TRANSITION
    PAYLOAD_PREPARE_DEPLOY PAYLOAD_CONTROL_DEPLOY DO_WINCH
"""
_SILENT = frozenset(getattr(mavlink, f"MAV_CMD_{name}") for name in _SILENT_NAMES.split())


@dataclass(frozen=True)
class Command:
    """A command with its parameters, in the form of COMMAND_LONG.

    Attributes:
        number: MAV_CMD.
        params: param1..param7; NaN for those left out of COMMAND_INT. Positions are in degrees and m AMSL.
    """

    number: int
    params: tuple[float, float, float, float, float, float, float]


class CommandError(ValueError):
    """A command with an invalid position: the floats of COMMAND_LONG and the integers of COMMAND_INT are mixed up."""


def from_command_long(number: int, params: tuple[float, float, float, float, float, float, float]) -> Command:
    """Return the command of a COMMAND_LONG.

    Raises:
        CommandError: param5 and param6 are COMMAND_INT's values for "left out".
    """
    if all(_LEAST_UNSET <= value <= _MOST_UNSET for value in params[4:6]):
        raise CommandError(f"command {number}: param5 and param6 are {params[4]:.0f}; NaN leaves them out")
    return Command(number, params)


def from_command_int(number: int, params: tuple[float, ...], x: int, y: int, z: float) -> Command:
    """Return the command of a COMMAND_INT, whose frame PX4 v1.14 does not look at.

    So x and y are in 1e-7 degrees and z is AMSL in every frame: ``MavlinkReceiver::handle_message_command_int`` copies
    them. MAVSDK relies on it: it sends altitudes AMSL with the frame GLOBAL_RELATIVE_ALT.

    Raises:
        CommandError: x and y have the bits of a NaN.
    """
    if x == y == _NAN_AS_INT:
        raise CommandError(f"command {number}: x and y have the bits of a NaN; {_INT32_UNSET} leaves them out")
    position = (_NAN, _NAN) if x == y == _INT32_UNSET else (x / 1e7, y / 1e7)
    return Command(number, (params[0], params[1], params[2], params[3], *position, z))


def _message_id(command: Command) -> int:
    """Return param1 as the id of a message: ``(uint16_t)roundf(param1)``."""
    return c_casts.to_uint16(c_casts.nearest(command.params[0]))


def _sensor_to_calibrate(p: list[int]) -> str:
    """Return the sensor that the parameters of PREFLIGHT_CALIBRATION name first, empty for none or another kind."""
    choices = (
        (p[0] == 1, "gyro"),
        (p[1] == 1, "mag"),
        (p[2] == 1, "baro"),
        (p[3] in (1, 2), ""),  # a radio's
        (p[4] == 1, "accel"),
        (p[4] == 2, "level"),
        (p[4] == _QUICK_ACCEL, ""),
        (p[5] in (1, 2), "airspeed"),
    )
    return next((sensor for asked, sensor in choices if asked), "")


class CommandHandler:
    """Executes the commands of one vehicle."""

    def __init__(self, vehicle: Vehicle) -> None:
        """Handle the commands of ``vehicle``."""
        self._vehicle = vehicle
        self._commander = commander = vehicle.commander
        self._handlers: dict[int, Callable[[Command, Link], Result | None]] = {
            mavlink.MAV_CMD_NAV_RETURN_TO_LAUNCH: lambda *_: commander.commands.return_to_launch(),
            mavlink.MAV_CMD_NAV_LAND: lambda *_: commander.commands.land(),
            mavlink.MAV_CMD_NAV_LAND_LOCAL: lambda *_: commander.commands.precision_land(),  # PX4 uses this number
            mavlink.MAV_CMD_NAV_TAKEOFF: self._takeoff,
            mavlink.MAV_CMD_DO_SET_MODE: self._set_mode,
            mavlink.MAV_CMD_DO_FLIGHTTERMINATION: lambda command, *_: commander.flight_termination(command.params[0]),
            mavlink.MAV_CMD_DO_CHANGE_SPEED: self._change_speed,
            mavlink.MAV_CMD_DO_SET_HOME: self._set_home,
            mavlink.MAV_CMD_DO_CHANGE_ALTITUDE: self._change_altitude,
            mavlink.MAV_CMD_DO_SET_ACTUATOR: self._set_actuators,
            mavlink.MAV_CMD_DO_MOUNT_CONFIGURE: lambda command, _: self._with_gimbal(lambda gimbal: Result.ACCEPTED),
            mavlink.MAV_CMD_DO_MOUNT_CONTROL: self._mount,
            mavlink.MAV_CMD_DO_GIMBAL_MANAGER_PITCHYAW: self._point_gimbal,
            mavlink.MAV_CMD_DO_GIMBAL_MANAGER_CONFIGURE: self._configure_gimbal,
            mavlink.MAV_CMD_DO_LAND_START: self._start_landing,
            mavlink.MAV_CMD_DO_REPOSITION: self._reposition,
            mavlink.MAV_CMD_DO_ORBIT: self._orbit,
            **dict.fromkeys(_ROI, self._set_roi),
            mavlink.MAV_CMD_MISSION_START: self._start_mission,
            mavlink.MAV_CMD_DO_GO_AROUND: lambda *_: Result.ACCEPTED,  # PX4 accepts it for all types
            mavlink.MAV_CMD_DO_AUTOTUNE_ENABLE: self._autotune,
            mavlink.MAV_CMD_FIXED_MAG_CAL_YAW: self._calibrate_heading,
            mavlink.MAV_CMD_COMPONENT_ARM_DISARM: self._arm_disarm,
            mavlink.MAV_CMD_PREFLIGHT_CALIBRATION: self._calibrate,
            mavlink.MAV_CMD_PREFLIGHT_STORAGE: self._storage,
            mavlink.MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN: self._reboot,
            mavlink.MAV_CMD_ACTUATOR_TEST: self._test_actuator,
            mavlink.MAV_CMD_RUN_PREARM_CHECKS: lambda *_: Result.ACCEPTED,  # the checks run continuously
            mavlink.MAV_CMD_INJECT_FAILURE: self._inject_failure,
            mavlink.MAV_CMD_GET_MESSAGE_INTERVAL: self._get_interval,
            mavlink.MAV_CMD_SET_MESSAGE_INTERVAL: self._set_interval,
            mavlink.MAV_CMD_REQUEST_MESSAGE: lambda command, link: self._send(link, _message_id(command)),
            **{
                number: self._sender_of(name)
                for number, name in (
                    (mavlink.MAV_CMD_GET_HOME_POSITION, "HOME_POSITION"),
                    (mavlink.MAV_CMD_REQUEST_PROTOCOL_VERSION, "PROTOCOL_VERSION"),
                    (mavlink.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES, "AUTOPILOT_VERSION"),
                    (mavlink.MAV_CMD_REQUEST_STORAGE_INFORMATION, "STORAGE_INFORMATION"),
                    (mavlink.MAV_CMD_REQUEST_FLIGHT_INFORMATION, "FLIGHT_INFORMATION"),
                )
            },
        }

    def run(self, command: Command, link: Link) -> Result | None:
        """Execute ``command`` received on ``link``; replies other than the acknowledgement are queued there.

        Returns:
            Result of the acknowledgement; None for no acknowledgement.
        """
        handler = self._handlers.get(command.number)
        if handler is not None:
            return handler(command, link)
        of_service = self._vehicle.on_command.get(command.number)
        if of_service is not None:
            return of_service(command.params, link)
        return None if command.number in _SILENT else Result.UNSUPPORTED

    # flight

    def _arm_disarm(self, command: Command, _link: Link) -> Result | None:
        action = c_casts.nearest(command.params[0]) & 0xFF  # to int8_t
        if action not in (0, 1):
            self._commander.say(CRITICAL, f"Unsupported ARM_DISARM param: {command.params[0]:.3f}")
            return None
        # PX4 v1.14 checks a vehicle that a client arms in any case; here force arms without checks, for tests
        # of vehicles that cannot fly
        return self._commander.arm_disarm(action == 1, c_casts.nearest(command.params[1]) == _FORCE)

    def _set_mode(self, command: Command, _link: Link) -> Result:
        base, main, sub = (c_casts.to_byte(value) for value in command.params[:3])
        return self._commander.set_mode(base, main << 16 | sub << 24)

    def _takeoff(self, command: Command, _link: Link) -> Result:
        _, _, _, yaw, latitude, longitude, altitude = command.params
        if latitude == longitude == 0.0:  # left out by many scripts; PX4 flies towards 0 N 0 E
            latitude = longitude = _NAN
            if altitude == 0.0:  # all are left out
                altitude = yaw = _NAN
        return self._commander.commands.takeoff(altitude, yaw, (latitude, longitude))

    def _change_speed(self, command: Command, _link: Link) -> Result:
        return self._commander.commands.change_speed(command.params[0], command.params[1])

    def _change_altitude(self, command: Command, _link: Link) -> Result:
        return self._commander.commands.change_altitude(command.params[0])

    def _reposition(self, command: Command, _link: Link) -> Result:
        if c_casts.to_unsigned(command.params[1]) != _CHANGE_MODE_FLAG:
            return Result.UNSUPPORTED
        speed, _, _, yaw, latitude, longitude, altitude = command.params
        return self._commander.commands.reposition((latitude, longitude, altitude), yaw, speed)

    def _orbit(self, command: Command, _link: Link) -> Result:
        radius, speed, yaw_behaviour, _, latitude, longitude, altitude = command.params
        return self._commander.commands.orbit(radius, speed, yaw_behaviour, (latitude, longitude, altitude))

    def _set_home(self, command: Command, _link: Link) -> Result:
        here, _, _, yaw, latitude, longitude, altitude = command.params
        if here > 0.5:
            return self._commander.commands.set_home(None)
        return self._commander.commands.set_home((latitude, longitude, altitude), math.radians(yaw))

    def _start_mission(self, command: Command, _link: Link) -> Result:
        return self._commander.commands.start_mission(command.params[0])  # PX4 ignores the last item, param2

    def _start_landing(self, command: Command, link: Link) -> Result:
        """Start the mission at its landing sequence; accepted also without one, as in PX4."""
        landing = self._commander.navigator.mission.landing_item()
        if landing is not None:
            self._start_mission(replace(command, params=(float(landing[1]), *command.params[1:])), link)
        return Result.ACCEPTED

    def _set_roi(self, command: Command, _link: Link) -> Result:
        number = mavlink.MAV_CMD_DO_SET_ROI if command.number == mavlink.MAV_CMD_NAV_ROI else command.number
        p = command.params
        mode = float(c_casts.to_byte(p[0]))
        self._commander.navigator.mission.set_roi(PlanItem(number, _GLOBAL, (mode, *p[1:4]), p[4], p[5], p[6]))
        return Result.ACCEPTED

    def _set_actuators(self, command: Command, _link: Link) -> Result:
        self._commander.navigator.payload.execute(command.number, command.params)
        return Result.ACCEPTED

    # gimbal; without one there is no acknowledgement, as from PX4 without the gimbal driver

    def _with_gimbal(self, act: Callable[[GimbalManager], Result]) -> Result | None:
        payload = self._commander.navigator.payload
        return None if payload.gimbal_attitude is None else act(payload.gimbal_manager)

    def _mount(self, command: Command, _link: Link) -> Result | None:
        params = [value if math.isfinite(value) else 0.0 for value in command.params]
        return self._with_gimbal(lambda gimbal: Result.ACCEPTED if gimbal.mount(params) else Result.UNSUPPORTED)

    def _point_gimbal(self, command: Command, link: Link) -> Result | None:
        def act(gimbal: GimbalManager) -> Result:
            if not gimbal.controlled_by(link.sender):
                return Result.DENIED
            gimbal.pitch_yaw(command.params)
            return Result.ACCEPTED

        return self._with_gimbal(act)

    def _configure_gimbal(self, command: Command, link: Link) -> Result | None:
        def act(gimbal: GimbalManager) -> Result:
            gimbal.configure(link.sender, command.params)
            return Result.ACCEPTED

        return self._with_gimbal(act)

    # before flight

    def _calibrate(self, command: Command, _link: Link) -> Result | None:
        """Start the calibration that the first parameter that asks for one names, in PX4's order.

        A radio's calibration is unsupported. That of motor controllers is denied, as PX4 does while a battery is
        connected. The quick one of the accelerometer (param5 4), for which PX4 sends no text, has no effect.
        """
        p = [c_casts.to_int(value) for value in command.params]
        calibration = self._commander.calibration
        if calibration.running:
            return calibration.answer(cancels=not any(p[:6]))
        if self._commander.armed:
            return Result.TEMPORARILY_REJECTED
        if p[0] != 1 and _BY_TEMPERATURE in (p[0], p[4], p[6]):
            return None  # of the events module, which does not run in PX4's simulator
        sensor = _sensor_to_calibrate(p)
        if sensor:
            calibration.start(sensor)
            return Result.ACCEPTED
        if p[3] in (1, 2):
            return Result.UNSUPPORTED
        if p[4] == _QUICK_ACCEL:
            return Result.ACCEPTED
        if p[6] == 1:
            self._commander.say(CRITICAL, "[cal] calibration failed: Disconnect battery and try again")
            return Result.DENIED
        return Result.ACCEPTED if p[3] == 0 else Result.UNSUPPORTED

    def _calibrate_heading(self, _command: Command, _link: Link) -> Result:
        """Accept a calibration of the magnetometer by a known heading; the simulated sensor needs none."""
        return Result.TEMPORARILY_REJECTED if self._is_busy else Result.ACCEPTED

    @property
    def _is_busy(self) -> bool:
        """Whether PX4 would reject work for its commander's thread: armed, or a calibration runs there."""
        return self._commander.armed or self._commander.calibration.running

    def _autotune(self, _command: Command, _link: Link) -> Result:
        """Set MC_AT_START, as PX4's receiver does; the autotune module, run only with MC_AT_EN, is not simulated."""
        self._commander.parameters.set("MC_AT_START", 1.0)
        return Result.IN_PROGRESS

    def _storage(self, command: Command, _link: Link) -> Result | None:
        """Load (0), save (1) or reset (2, 4) the parameters; other numbers get no acknowledgement, as from PX4."""
        if self._is_busy:
            return Result.TEMPORARILY_REJECTED
        parameters = self._commander.parameters
        action = c_casts.to_int(command.params[0])
        if action == 0:
            parameters.load()
            return Result.ACCEPTED
        if action in (2, 4):
            parameters.reset()
        elif action == _RESET_CALIBRATION:
            return Result.ACCEPTED  # the simulated sensors have none
        elif action != 1:
            return None
        return Result.ACCEPTED if parameters.save() else Result.FAILED

    def _reboot(self, command: Command, _link: Link) -> Result:
        """Reboot the autopilot (1). Shutdown (2) is denied because the vehicle could not be started again."""
        action = c_casts.to_int(command.params[0])
        if action == 0:  # no action on the autopilot
            return Result.ACCEPTED
        if action == 1 and not self._commander.armed:
            self._commander.rebooting = True
            return Result.ACCEPTED
        if action == 2 and not self._commander.armed:
            self._commander.say(CRITICAL, "Shutdown denied: it ends with the simulator")
        return Result.DENIED

    def _test_actuator(self, command: Command, _link: Link) -> Result | None:
        return self._commander.test_actuator(
            c_casts.to_int(command.params[4] + 0.5), command.params[0], command.params[1]
        )

    def _inject_failure(self, command: Command, _link: Link) -> Result:
        unit, kind, instance = (c_casts.to_int(value + 0.5) for value in command.params[:3])
        return _inject(self._vehicle, unit, kind, instance)

    # messages

    def _sender_of(self, name: str) -> Callable[[Command, Link], Result]:
        number = MESSAGE_ID[name]
        return lambda _, link: self._send(link, number)

    def _send(self, link: Link, number: int) -> Result:
        """Send message ``number`` once; DENIED if it is unknown or has no values, as in PX4."""
        reply = self._vehicle.on_request.get(number)
        if reply is not None:
            return Result.DENIED if reply(link) is False else Result.ACCEPTED
        now_us = self._vehicle.now_us
        link.telemetry.refresh(now_us)
        sent = link.streams.send_once(number, link.send_payload, lambda text: link.warn("packing", text, now_us))
        return Result.ACCEPTED if sent else Result.DENIED

    def _get_interval(self, command: Command, link: Link) -> Result:
        number = _message_id(command)
        interval = link.streams.interval(number)
        # 0: not available
        link.send_message(mavlink.MAVLink_message_interval_message(number, 0 if interval is None else interval))
        return Result.ACCEPTED

    def _set_interval(self, command: Command, link: Link) -> Result:
        number, interval = c_casts.nearest(command.params[0]), command.params[1]
        if math.isnan(interval):
            interval = 0.0  # the default rate
        elif math.isinf(interval):
            interval = -1.0  # off
        return Result.ACCEPTED if link.streams.set_interval(number, interval, self._vehicle.now_us) else Result.FAILED
