"""Arming, flight modes, failsafes and home position of one vehicle, modelled on PX4 v1.14's commander.

All times are simulated. ``update`` runs at about 10 Hz; commands and setpoints take effect immediately. Messages for
the operator queue in ``texts`` and ``events`` until a link sends them.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

from xtdrone_autopilot.c_casts import low_32
from xtdrone_autopilot.commander.failsafe import Action, Failsafe, Flags, Outcome, can_run
from xtdrone_autopilot.commander.flight_commands import FlightCommands, Result
from xtdrone_autopilot.commander.health_and_arming_checks.arming_checks import ArmingChecks
from xtdrone_autopilot.commander.health_and_arming_checks.battery_estimate import BatteryEstimate
from xtdrone_autopilot.commander.health_and_arming_checks.health import Health
from xtdrone_autopilot.commander.home_position import HomePosition
from xtdrone_autopilot.commander.manual_control import ManualControl, Request, Sticks
from xtdrone_autopilot.commander.manual_flight import MANUAL_THRUST, ManualFlight
from xtdrone_autopilot.commander.motors import ArmReason, MotorSwitch
from xtdrone_autopilot.commander.offboard_setpoint import OffboardSetpoint
from xtdrone_autopilot.commander.sensor_calibration import SensorCalibration
from xtdrone_autopilot.events import events
from xtdrone_autopilot.events.announcements import CRITICAL, INFO, WARNING, Announcements
from xtdrone_autopilot.events.events import Event
from xtdrone_autopilot.navigator import rtl
from xtdrone_autopilot.navigator.navigator import Home, Navigator
from xtdrone_autopilot.parameters.parameters import Parameters
from xtdrone_autopilot.state import FAILURE_OFF, TASK_DESCEND, TASK_IDLE
from xtdrone_autopilot.vehicle_view import VehicleView
from xtdrone_common import modes
from xtdrone_common.fleet import Vehicle
from xtdrone_common.modes import Mode

if TYPE_CHECKING:
    from xtdrone_autopilot.autopilot import Autopilot
    from xtdrone_autopilot.logger.mavlink_log_pieces import LogStream

__all__ = ["CRITICAL", "INFO", "WARNING", "ArmReason", "Commander", "Result"]

_NEVER_US = -(1 << 60)
_REJECTION_INTERVAL_US = 1_000_000
_GRACE_US = 5_000_000  # after disarming in flight, during which arming skips the checks
_CHECK_INTERVAL_US = 1_000_000
_OVERRIDE_AUTO, _OVERRIDE_OFFBOARD = 1, 2  # COM_RC_OVERRIDE
_LOW_32 = 0xFFFFFFFF
_THROTTLE_HIGH, _THROTTLE_LOW = 0.2, -0.8  # stick positions above which arming is denied, by kind of mode
_CALIBRATING, _STANDBY, _ACTIVE, _CRITICAL_STATE, _TERMINATED, _UNINIT = 2, 3, 4, 5, 8, 0  # MAV_STATE
_GEAR_HEIGHT = 2.0  # m above home
_MAVLINK_MOTORS, _MAVLINK_SERVOS = range(1, 13), range(33, 41)  # ACTUATOR_OUTPUT_FUNCTION
_PX4_FUNCTIONS, _PX4_FIRST_MOTOR = 1000, 101  # offset of PX4's output functions, and the first motor's
_ON_GROUND, _IN_AIR, _TAKEOFF, _LANDING = 1, 2, 3, 4  # MAV_LANDED_STATE

CommandListener = Callable[[int, Sequence[float], tuple[int, int], int | None], None]


_BY_PILOT = (ArmReason.STICK, ArmReason.SWITCH, ArmReason.BUTTON)
_REASONS = {"stick": ArmReason.STICK, "switch": ArmReason.SWITCH, "button": ArmReason.BUTTON}


class Commander:
    """State machine of one vehicle.

    Attributes:
        vehicle: the vehicle's name, type and ids.
        parameters: the vehicle's parameters.
        view: access to the vehicle's autopilot records.
        navigator: AUTO modes.
        health: health monitoring.
        manual: manual control input.
        offboard: setpoints of OFFBOARD.
        commands: flight commands: takeoff, landing, return and others.
        calibration: calibration of the sensors; a vehicle cannot be armed while one runs.
        on_command: listener of received MAV_CMDs, used by the logger; None for no listener. Arguments: number,
            parameters 1 to 7, sender (system, component), MAV_RESULT or None for a command without an acknowledgement.
        open_log_stream: begins a stream of the vehicle's log and returns it, None while another one is open; the
            attribute is None if no logger is running.
        rebooting: a reboot was requested; the owner of the commander performs it.
        gear_up: whether a retractable landing gear should be up.
        armed: whether the vehicle is armed; its motors run unless killed or terminated.
    """

    def __init__(self, vehicle: Vehicle, autopilot: Autopilot, parameters: Parameters, index: int) -> None:
        """Start disarmed in AUTO.LOITER.

        Args:
            vehicle: the vehicle's name, type and ids.
            autopilot: owner of the records.
            parameters: the vehicle's parameters; written into the autopilot's parameter record.
            index: row of the vehicle in the records.
        """
        self.vehicle = vehicle
        self.parameters = parameters
        self.view = VehicleView(autopilot, index)
        self._receiver_failure = self.view.cell("failures", "rc_signal")
        self._obstacle_hold = self.view.cell("control", "obstacles", "hold")
        get = parameters.get
        self._announcements = Announcements(self.view)
        parameters.on_limit = self._tell_limit
        self.calibration = SensorCalibration(self.view, self._announcements)
        self.navigator = Navigator(self.view, parameters, self._announcements)
        self._home = HomePosition(self.view, self.navigator, get)
        self.commands = FlightCommands(self, self._home, self._announcements)
        self.navigator.mission.set_home = self.commands.set_home
        self.manual = ManualControl(get)
        self.offboard = OffboardSetpoint(self.view, self._follows_setpoints, lambda: get("COM_OF_LOSS_T"))
        self.health = Health(self.view, get, self.navigator, self.offboard, self.manual, self._announcements)
        self._manual_flight = ManualFlight(self.view, get)
        self._failsafe = Failsafe(get, modes.AUTO_LOITER, lambda: parameters.changes)
        self._checks = ArmingChecks(self.view, get)
        self._reported: tuple[Flags, Mode, bool] | None = None
        self._checked_us = _NEVER_US
        self.on_command: CommandListener | None = None
        self.open_log_stream: Callable[[], LogStream | None] | None = None
        self.rebooting = False
        self.armed = False
        self.gear_up = False
        self._mode = modes.AUTO_LOITER  # requested
        self._mode_after_disarming = modes.AUTO_LOITER
        self._mode_chosen = False  # whether any mode has been requested yet
        self._active_mode = modes.AUTO_LOITER
        self._cascade_mode: Mode | None = None  # mode started in the control cascade; None while disarmed
        self._motors = MotorSwitch(self.view)
        self._armed_us = 0
        self._disarmed_us = _NEVER_US
        self._took_off = False
        self._takeoff_us: int | None = None  # of the first takeoff since the arming
        self._was_landed = True
        self._landed_us = 0
        self._last_rejection_us = _NEVER_US
        parameters.write_to(autopilot.params[index])

    # state for telemetry

    @property
    def texts(self) -> deque[tuple[int, str]]:
        """Unsent texts as (MAV_SEVERITY, text); beyond 64 the oldest are dropped."""
        return self._announcements.texts

    @property
    def on_text(self) -> Callable[[int, str], None] | None:
        """Listener called with the severity and text of every message, used by the logger."""
        return self._announcements.on_text

    @on_text.setter
    def on_text(self, listener: Callable[[int, str], None] | None) -> None:
        self._announcements.on_text = listener

    @property
    def events(self) -> deque[Event]:
        """Unsent events; beyond 64 the oldest are dropped."""
        return self._announcements.events

    @property
    def mode(self) -> Mode:
        """Active mode: the failsafe's while a failsafe acts, otherwise the requested one."""
        return self._active_mode

    @property
    def failsafe(self) -> bool:
        """Whether a failsafe overrides the requested mode."""
        return self._failsafe.outcome.active

    @property
    def failsafe_outcome(self) -> Outcome:
        """Action of the failsafes and its cause."""
        return self._failsafe.outcome

    @property
    def battery(self) -> BatteryEstimate:
        """Battery estimate."""
        return self.health.battery

    @property
    def requested_mode(self) -> Mode:
        """Requested mode, even while a failsafe overrides it."""
        return self._mode

    @property
    def home(self) -> Home | None:
        """Home position, None until it is set."""
        return self.navigator.home

    @property
    def base_mode(self) -> int:
        """HEARTBEAT.base_mode."""
        return self._active_mode.flags | (modes.ARMED_FLAG if self.armed else 0)

    @property
    def custom_mode(self) -> int:
        """HEARTBEAT.custom_mode."""
        return self._active_mode.custom_mode

    @property
    def system_status(self) -> int:
        """HEARTBEAT.system_status: a MAV_STATE."""
        if not self.view.initialised:
            return _UNINIT
        if self._motors.stopped or self._active_mode is modes.TERMINATION:
            return _TERMINATED
        if not self.armed:
            return _CALIBRATING if self.calibration.running else _STANDBY
        return _CRITICAL_STATE if self.failsafe else _ACTIVE

    @property
    def landed_state(self) -> int:
        """EXTENDED_SYS_STATE.landed_state: a MAV_LANDED_STATE."""
        if self.view.landed:
            return _ON_GROUND
        if self.navigator.landing or self._active_mode is modes.DESCEND:
            return _LANDING
        return _TAKEOFF if self.navigator.taking_off else _IN_AIR

    @property
    def armed_since_us(self) -> int:
        """Simulated time of the arming, microseconds; 0 while disarmed."""
        return self._armed_us if self.armed else 0

    @property
    def ready_to_arm(self) -> bool:
        """Whether arming would be accepted in the current mode."""
        return not self.armed and not self.calibration.running and not self.arming_denial()

    def say(self, severity: int, text: str) -> None:
        """Queue a text for the operator (``severity``: MAV_SEVERITY)."""
        self._announcements.say(severity, text)

    def tell(self, severity: int, text: str, name: str, *values: float, level: int | None = None) -> None:
        """Queue a text for the operator and its equivalent event; see ``Announcements.tell``."""
        self._announcements.tell(severity, text, name, *values, level=level)

    def warn(self, text: str) -> None:
        """Queue a warning, at most one a second."""
        self._announcements.warn(text)

    def _tell_limit(self, text: str, event: str, value: float) -> None:
        self.tell(CRITICAL, text, event, value, level=WARNING)

    # arming

    def arm_disarm(self, arm: bool, force: bool = False) -> Result:
        """Arm or disarm by command; ``force`` skips the checks, even in flight."""
        done = self.arm(ArmReason.COMMAND, force) if arm else self._disarm_unless_flying(ArmReason.COMMAND, force)
        return Result.ACCEPTED if done else Result.TEMPORARILY_REJECTED

    def arming_denial(self) -> str:
        """Return the reason why arming in the current mode would be denied, or an empty string."""
        flags = self.health.evaluate(self._mode, self.armed)
        return self._checks.report(flags, self._mode, self.armed).reason(self._mode)

    def mode_denial(self, mode: Mode) -> str:
        """Return the reason why ``mode`` cannot be flown now, or an empty string."""
        flags = self.health.evaluate(mode, self.armed)
        return self._checks.report(flags, mode, self.armed).reason(mode)

    def arm(self, reason: ArmReason, force: bool = False) -> bool:
        """Arm if the checks allow it; return whether the vehicle is armed."""
        if self.armed:
            return True
        if self._motors.terminated:
            self.say(CRITICAL, "Arming denied: flight was terminated, reboot the autopilot")
            return False
        if not self.view.initialised:
            self._report_arming_rejection()
            return False
        if self.calibration.running:  # PX4's arming state is INIT, also for a forced arming
            self.say(CRITICAL, "Transition denied: Init to Armed")
            return False
        in_grace = self.view.time_us - self._disarmed_us < _GRACE_US and not self.view.landed
        if not force and not in_grace and self._arming_rejected(reason):
            return False
        self.armed = True
        self._armed_us = self.view.time_us
        self._took_off = not self.view.landed
        self._was_landed = self.view.landed
        if reason is ArmReason.COMMAND:
            self._home.set_if_enabled()
        self._motors.apply(self.armed)
        number, words = reason.value
        self._announcements.tell(INFO, f"Armed by {words}", "commander_armed_by", number)
        self._update_mode(changed=True)
        return True

    def _arming_rejected(self, reason: ArmReason) -> bool:
        sticks = self.manual.sticks
        if self._mode.sticks and sticks is not None:
            if self._mode in MANUAL_THRUST:
                if sticks.z > _THROTTLE_LOW:
                    self._announcements.tell(
                        CRITICAL, "Arming denied: high throttle", "commander_arm_denied_throttle_high"
                    )
                    return True
            elif sticks.z > _THROTTLE_HIGH:
                text = "Arming denied: throttle above center"
                self._announcements.tell(CRITICAL, text, "commander_arm_denied_throttle_center")
                return True
        elif reason in _BY_PILOT:
            text = "Arming denied: switch to manual mode first"
            self._announcements.tell(CRITICAL, text, "commander_arm_denied_not_manual")
            return True
        if self.arming_denial():
            self._report_arming_rejection()
            return True
        return False

    def _report_arming_rejection(self) -> None:
        """Emit the failing checks as events only, as PX4 does."""
        flags = self.health.evaluate(self._mode, self.armed)
        report = self._checks.report(flags, self._mode, self.armed)
        self._announcements.emit(self._checks.events(report, self.view.time_us, force=True))

    def _disarm_unless_flying(self, reason: ArmReason, force: bool = False) -> bool:
        if not self.armed:
            return True
        on_ground = self.view.landed or bool(self.view.control["landing"]["maybe_landed"])
        by_pilot = self._active_mode in MANUAL_THRUST and reason in _BY_PILOT
        if not on_ground and not by_pilot and not force:
            if reason is not ArmReason.STICK:
                text = "Disarming denied! Not landed"
                self._announcements.tell(CRITICAL, text, "commander_disarming_denied_not_landed")
            return False
        self._disarm(reason)
        return True

    def _disarm(self, reason: ArmReason) -> None:
        self.armed = False
        self._count_flight()
        self._disarmed_us = self.view.time_us
        self._motors.apply(self.armed)
        self.navigator.end_flight()
        self._cascade_mode = None
        self.view.start_task(TASK_IDLE)
        number, words = reason.value
        self._announcements.tell(INFO, f"Disarmed by {words}", "commander_disarmed_by", number)
        self._mode = self._mode_after_disarming
        self._update_mode()

    def _count_flight(self) -> None:
        """Add the flight and its time to the parameters that count them, as PX4's commander and land detector do."""
        parameters, get = self.parameters, self.parameters.get
        parameters.set("COM_FLIGHT_UUID", low_32(int(get("COM_FLIGHT_UUID")) + 1))
        if self._takeoff_us is not None:
            total = (int(get("LND_FLIGHT_T_HI")) << 32) | (int(get("LND_FLIGHT_T_LO")) & _LOW_32)
            total += self.view.time_us - self._takeoff_us
            parameters.set("LND_FLIGHT_T_HI", low_32(total >> 32))
            parameters.set("LND_FLIGHT_T_LO", low_32(total))
            self._takeoff_us = None
        parameters.save()

    # kill and termination

    def kill(self, stop: bool) -> None:
        """Stop the motors immediately, or release them; a killed vehicle disarms after COM_KILL_DISARM."""
        if stop is self._motors.killed:
            return
        self._motors.killed = stop
        if stop:
            severity = INFO if self.view.landed else CRITICAL
            self._announcements.tell(severity, "Kill engaged", "commander_kill_sw_engaged")
        else:
            self._announcements.tell(INFO, "Kill disengaged", "commander_kill_sw_disengaged")
        self._motors.apply(self.armed)

    def flight_termination(self, level: float) -> Result:
        """Execute MAV_CMD_DO_FLIGHTTERMINATION: 0 releases the motors, 1 stops them for good, 2 as a test."""
        if level > 1.5:
            self._motors.locked = True
        elif level > 0.5:
            self._motors.terminated = True
        else:
            self._motors.locked = self._motors.terminated = False
        self._motors.apply(self.armed)
        return Result.ACCEPTED

    def test_actuator(self, function: int, value: float, seconds: float) -> Result | None:
        """Execute MAV_CMD_ACTUATOR_TEST, with the results of PX4 v1.14's ``Commander::handleCommandActuatorTest``.

        Args:
            function: MAVLink's ACTUATOR_OUTPUT_FUNCTION, or 1000 plus PX4's own number.
            value: command, 0..1 for motors; NaN stops the motor.
            seconds: duration, at most 3 s; 0 or less releases the motor.

        Returns:
            ACCEPTED, also for servos and motors that the vehicle does not have; None (no acknowledgement) for other
            functions.
        """
        if self.armed or int(self.parameters.get("COM_MOT_TEST_EN")) != 1:
            return Result.DENIED
        if function in _MAVLINK_MOTORS:
            self._motors.test(function - _MAVLINK_MOTORS.start, value, seconds)
        elif function >= _PX4_FUNCTIONS:
            self._motors.test(function - _PX4_FUNCTIONS - _PX4_FIRST_MOTOR, value, seconds)
        elif function not in _MAVLINK_SERVOS:
            return None
        return Result.ACCEPTED

    def _disarm_after_kill(self) -> bool:
        """Disarm once the motors have been stopped for COM_KILL_DISARM; return whether that happened now."""
        reason = self._motors.disarming(self.parameters.get("COM_KILL_DISARM"))
        if reason is not None:
            self._disarm(reason)
        return reason is not None

    # modes

    def set_mode(self, base_mode: int, custom_mode: int) -> Result:
        """Switch to the mode of PX4's ``custom_mode``, or of ``base_mode`` when its custom-mode flag is not set."""
        main = custom_mode >> 16 & 0xFF
        if not base_mode & modes.CUSTOM_FLAG:
            mode = modes.from_base_mode(base_mode)
        else:  # sub modes exist in AUTO only: PX4 v1.14 takes POSCTL for ORBIT's number
            mode = modes.from_custom_mode(custom_mode if main == modes.MAIN_AUTO else main << 16)
            if mode is None and main == modes.MAIN_AUTO:
                text, name = "Unsupported auto mode", "commander_unsupported_auto_mode"
                self._announcements.tell(CRITICAL, text, name, level=events.ERROR)
                return Result.TEMPORARILY_REJECTED
        if mode is not None:
            return self.request(mode)
        return Result.ACCEPTED  # PX4 accepts a mode that it does not know, and ignores it

    def request(self, mode: Mode) -> Result:
        """Switch to a mode; an armed vehicle rejects a mode that it cannot fly."""
        if self.armed and not self._can_choose(mode):
            if self.view.time_us - self._last_rejection_us > _REJECTION_INTERVAL_US:
                self._last_rejection_us = self.view.time_us
                self._announcements.mode_refused(mode)
            return Result.TEMPORARILY_REJECTED
        self._mode_chosen = True
        self._set_intended_mode(mode)
        self._update_mode(changed=True)
        return Result.ACCEPTED

    def _can_choose(self, mode: Mode) -> bool:
        if self._active_mode is modes.TERMINATION:
            return False
        flags = self.health.evaluate(mode, self.armed)
        if mode.sticks and flags.manual_lost:
            return False
        if can_run(mode, flags):
            return True
        falls_back = mode is modes.POSCTL and int(self.parameters.get("COM_POSCTL_NAVL")) == 0
        return falls_back and can_run(modes.ALTCTL, flags)

    def _set_intended_mode(self, mode: Mode) -> None:
        self._mode = mode
        if not mode.prevents_arming:
            self._mode_after_disarming = mode

    def _update_mode(self, *, changed: bool = False, sticks: bool = False, flags: Flags | None = None) -> None:
        """Run the failsafes on the requested mode and fly the resulting mode.

        Args:
            changed: a mode was requested.
            sticks: the pilot takes over with the sticks.
            flags: health flags; None evaluates them now.
        """
        if flags is None:
            flags = self.health.evaluate(self._mode, self.armed)
        before, mode_before = self._failsafe.outcome, self._active_mode
        outcome = self._failsafe.update(
            self.view.time_us, self.armed, self._mode, flags, changed=changed, sticks=sticks
        )
        if outcome is before:
            return
        if outcome.intended is not self._mode:
            self._set_intended_mode(outcome.intended)
        if outcome.notify:
            self._announcements.failsafe(outcome)
        if outcome.takeover and not before.takeover:
            self._announcements.tell(INFO, "Pilot took over using sticks", "failsafe_rc_override")
        self._active_mode = outcome.mode
        self._perform_action(outcome, before)
        returns = self._active_mode is not mode_before and self._active_mode is modes.AUTO_RTL
        if returns and self.parameters.get("RTL_TYPE") not in rtl.BY_MISSION:
            self._announcements.tell(INFO, "RTL HOME activated", "navigator_rtl_home_activated")
        reactivated = changed and not outcome.active
        must_stop = outcome.active and not before.active and self._active_mode is modes.AUTO_LOITER
        if self.armed and (reactivated or must_stop or self._active_mode is not self._cascade_mode):
            self._start_mode(self._active_mode)

    def _perform_action(self, outcome: Outcome, before: Outcome) -> None:
        """Stop the motors for an action that is not a flight mode."""
        if outcome.action is before.action:
            return
        if outcome.action is Action.TERMINATE:
            self._motors.terminated = True
            self._motors.apply(self.armed)
        elif outcome.action is Action.DISARM and self.armed:
            self._disarm(ArmReason.FAILSAFE)

    def _start_mode(self, mode: Mode) -> None:
        """Start ``mode`` in the control cascade of an armed vehicle."""
        self._cascade_mode = mode
        if mode.auto:
            self.navigator.activate(mode)
        else:
            self.navigator.deactivate()
            self._start_mode_task(mode)

    def _start_mode_task(self, mode: Mode) -> None:
        if mode is modes.OFFBOARD:
            self.offboard.write()
        elif mode is modes.TERMINATION:
            self.view.start_task(TASK_IDLE)
        elif mode.sticks:
            self._steer(restart=True)
        else:
            self.view.start_task(TASK_DESCEND)

    # manual control

    def manual_control(self, x: float, y: float, z: float, yaw: float) -> None:
        """Process joystick input, each axis -1..1: forward, right, up (0 is centred), clockwise.

        Raises:
            SetpointError: a value is not finite.
        """
        self.manual.joystick(Sticks(x, y, z, yaw), self.view.time_us)
        self._apply_sticks()

    def radio_control(self, channels: Sequence[int]) -> None:
        """Process RC channels, pulse widths in us; see ``ManualControl.radio``."""
        self.manual.radio(channels, self.view.time_us)
        self._apply_sticks()

    def _apply_sticks(self) -> None:
        if self.armed and self._active_mode.sticks:
            self._steer()

    def _steer(self, *, restart: bool = False) -> None:
        self._manual_flight.steer(
            self._active_mode, self.manual.sticks, self.health.flags.relaxed_position_invalid, restart=restart
        )

    def _handle_pilot_requests(self) -> None:
        """Execute the pilot's requests by stick gesture or switch."""
        self.manual.receiver_works = self._receiver_failure[0] != FAILURE_OFF
        for request in self.manual.update(self.view.time_us):
            self._handle_request(request)

    def _handle_request(self, request: Request) -> None:
        if request.action in ("kill", "unkill"):
            self.kill(request.action == "kill")
            return
        if request.action == "mode":
            mode = modes.from_number(request.mode)
            if mode is not None:
                self.request(mode)
            return
        reason = _REASONS[request.origin]
        if request.action == "arm" or (request.action == "toggle" and not self.armed):
            self.arm(reason)
        else:
            self._disarm_unless_flying(reason)

    def _check_stick_override(self) -> bool:
        """End AUTO or OFFBOARD flight when the pilot moves a stick; return whether that should end a failsafe."""
        if self.manual.sticks is None:
            return False
        if not self.armed:
            # the first manual input selects a manual mode unless a mode has been requested before
            if not self._mode_chosen and not (self.manual.by_radio and int(self.parameters.get("RC_MAP_FLTMODE"))):
                self._mode_chosen = True
                self._set_intended_mode(modes.POSCTL)
            return False
        if (
            self.view.landed
            or self._active_mode.sticks
            or self._active_mode is modes.TERMINATION
            or not self.manual.moving
        ):
            return False
        bit = _OVERRIDE_OFFBOARD if self._active_mode is modes.OFFBOARD else _OVERRIDE_AUTO
        if not int(self.parameters.get("COM_RC_OVERRIDE")) & bit:
            return False
        if self.failsafe:
            return True
        if self._can_choose(modes.POSCTL):
            self._set_intended_mode(modes.POSCTL)
            self._announcements.tell(INFO, "Pilot took over using sticks", "commander_rc_override")
        return False

    def _follows_setpoints(self) -> bool:
        return self.armed and self._active_mode is modes.OFFBOARD

    def gcs_heartbeat(self) -> None:
        """Record a heartbeat from a ground station."""
        self.health.gcs_heartbeat()

    # periodic update

    def update(self) -> None:
        """Update manual control, land detection, failsafes and the active mode; call at about 10 Hz."""
        view = self.view
        self._handle_pilot_requests()
        flags = self.health.update(self._mode, self._active_mode, self.armed)
        self._home.update(self.armed)
        if self.armed:
            landed = view.landed
            if landed != self._was_landed:
                self._record_landing(landed)
            if (landed and self._auto_disarm()) or self._disarm_after_kill():
                return
        else:
            self._checks.follow_innovations()
            self.calibration.update()
        take_over = self._check_stick_override()
        self._update_mode(sticks=take_over, flags=flags)
        self._move_gear()
        self._report_checks(flags)
        if self.armed:
            self._run_mode()

    def _move_gear(self) -> None:
        """Raise the landing gear in AUTO modes well above home and lower it for landing (PX4 ``FlightTaskAuto``)."""
        if self.landed_state in (_ON_GROUND, _LANDING):
            self.gear_up = False
        elif self._active_mode.auto and self.home is not None:
            height = self.home.position[2] - self.view.position[2]
            self.gear_up = self.gear_up or height > _GEAR_HEIGHT

    def _run_mode(self) -> None:
        """Advance the active mode."""
        if self._active_mode.sticks:
            self._steer()
            self._hold_without_obstacles()
        following = self.navigator.update()
        # never during a failsafe: its modes have no successor. PX4's change() keeps a mode whose successor cannot be
        # flown, such as a takeoff without a global position
        if following is not None and self._can_choose(following):
            if following is modes.AUTO_RTL:
                self._announcements.tell(INFO, "Returning to launch", "commander_rtl")
            self._set_intended_mode(following)
            self._update_mode(changed=True)

    def _hold_without_obstacles(self) -> None:
        """Change to hold when collision prevention has had no data for long (PX4 ``CollisionPrevention``)."""
        if self._obstacle_hold[0]:
            self._obstacle_hold[0] = 0
            self.request(modes.AUTO_LOITER)

    def _report_checks(self, flags: Flags) -> None:
        """Emit the arming checks as events when their result has changed."""
        key = (flags, self._mode, self.armed)
        now_us = self.view.time_us
        due = not self.armed and now_us - self._checked_us >= _CHECK_INTERVAL_US
        if key == self._reported and not due:
            return
        self._reported, self._checked_us = key, now_us
        report = self._checks.report(flags, self._mode, self.armed)
        self._announcements.emit(self._checks.events(report, now_us))

    def _record_landing(self, landed: bool) -> None:
        self._was_landed = landed
        self._took_off = True
        self._landed_us = self.view.time_us
        if self._takeoff_us is None and not landed:
            self._takeoff_us = self.view.time_us
        if landed:
            self._announcements.tell(INFO, "Landing detected", "commander_landing_detected")
        else:
            self._announcements.tell(INFO, "Takeoff detected", "commander_takeoff_detected")
            self._home.set_if_enabled()

    def _auto_disarm(self) -> bool:
        now = self.view.time_us
        if self._took_off:
            delay = self.parameters.get("COM_DISARM_LAND")
            if delay > 0.0 and now - self._landed_us >= delay * 1e6:
                self._disarm(ArmReason.LANDING)
                return True
            return False
        delay = self.parameters.get("COM_DISARM_PRFLT")
        if delay > 0.0 and now - self._armed_us >= delay * 1e6:
            self._disarm(ArmReason.UNUSED)
            return True
        return False
