"""Arming, flight modes, failsafes and home of one vehicle, as PX4 v1.14's commander.

All times are simulated. ``update`` is called at about 10 Hz; commands and setpoints act at once. What the operator is
told waits in ``texts`` and ``events`` until a link takes it.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

from xtdrone_control.autopilot import modes
from xtdrone_control.autopilot.commander.arming_checks import ArmingChecks
from xtdrone_control.autopilot.commander.battery import BatteryEstimate
from xtdrone_control.autopilot.commander.failsafe import Action, Failsafe, Flags, Outcome, can_run
from xtdrone_control.autopilot.commander.flight_commands import FlightCommands, Result
from xtdrone_control.autopilot.commander.health import Health
from xtdrone_control.autopilot.commander.inputs import OffboardInput
from xtdrone_control.autopilot.commander.manual_control import ManualControl, Request, Sticks
from xtdrone_control.autopilot.commander.manual_flight import MANUAL_THRUST, HandFlight
from xtdrone_control.autopilot.commander.motors import ArmReason, MotorSwitch
from xtdrone_control.autopilot.events import events
from xtdrone_control.autopilot.events.announcements import CRITICAL, INFO, WARNING, Announcements
from xtdrone_control.autopilot.events.events import Event
from xtdrone_control.autopilot.modes import Mode
from xtdrone_control.autopilot.navigator.navigator import Navigator
from xtdrone_control.autopilot.parameters.parameters import Parameters
from xtdrone_control.autopilot.state import FAILURE_OFF, TASK_DESCEND, TASK_IDLE
from xtdrone_control.autopilot.vehicle_view import Vector, VehicleView
from xtdrone_control.fleet import Vehicle

if TYPE_CHECKING:
    from xtdrone_control.autopilot.autopilot import Autopilot

__all__ = ["CRITICAL", "INFO", "WARNING", "ArmReason", "Commander", "Result"]

_NEVER_US = -(1 << 60)
_REFUSAL_INTERVAL_US = 1_000_000
_GRACE_US = 5_000_000  # after disarming, in which arming asks for no checks
_CHECK_INTERVAL_US = 1_000_000
_OVERRIDE_AUTO, _OVERRIDE_OFFBOARD = 1, 2  # COM_RC_OVERRIDE
_THROTTLE_HIGH, _THROTTLE_LOW = 0.2, -0.8  # of the stick, above and below which arming looks at it
_STANDBY, _ACTIVE, _CRITICAL_STATE, _TERMINATED, _UNINIT = 3, 4, 5, 8, 0  # MAV_STATE
_GEAR_HEIGHT = 2.0  # m above home
_ON_GROUND, _IN_AIR, _TAKEOFF, _LANDING = 1, 2, 3, 4  # MAV_LANDED_STATE

CommandListener = Callable[[int, Sequence[float], tuple[int, int], int | None], None]


_BY_PILOT = (ArmReason.STICK, ArmReason.SWITCH, ArmReason.BUTTON)
_REASONS = {"stick": ArmReason.STICK, "switch": ArmReason.SWITCH, "button": ArmReason.BUTTON}


class Commander(FlightCommands):
    """The state machine of one vehicle.

    Attributes:
        vehicle: which vehicle.
        parameters: its parameters.
        view: its records.
        navigator: its AUTO modes.
        health: what is wrong with it.
        manual: its pilot.
        on_command: called with each MAV_CMD that has come, when it is not None: number, parameters 1 to 7, sender
            (system, component), MAV_RESULT or None where there is no answer. The logger.
        rebooting: a reboot was asked for; whoever holds the commander carries it out.
        gear_up: whether the landing gear, if there is one, is to be up.
        armed: whether it is armed; motors run unless it has been killed or terminated.
        flights: how often it has been armed and disarmed.
    """

    def __init__(self, vehicle: Vehicle, autopilot: Autopilot, parameters: Parameters, index: int) -> None:
        """Start disarmed in AUTO.LOITER.

        Args:
            vehicle: which vehicle.
            autopilot: holder of the records.
            parameters: the vehicle's parameters; they are written into the autopilot's record.
            index: place in the records.
        """
        self.vehicle = vehicle
        self.parameters = parameters
        self.view = VehicleView(autopilot, index)
        get = parameters.get
        self._announcements = Announcements(self.view)
        self.navigator = Navigator(self.view, parameters, self._announcements)
        self.manual = ManualControl(get)
        self._offboard = OffboardInput(self.view)
        self.health = Health(self.view, get, self.navigator, self._offboard, self.manual, self._announcements)
        self._hand_flight = HandFlight(self.view, get)
        self._failsafe = Failsafe(get, modes.AUTO_LOITER, lambda: parameters.changes)
        self._checks = ArmingChecks(self.view, get)
        self._reported: tuple[Flags, Mode, bool] | None = None
        self._checked_us = _NEVER_US
        self.on_command: CommandListener | None = None
        self.rebooting = False
        self.armed = False
        self.gear_up = False
        self.flights = 0
        self._mode = modes.AUTO_LOITER  # what was asked for
        self._mode_after_disarming = modes.AUTO_LOITER
        self._mode_chosen = False  # somebody has asked for a mode
        self._flown = modes.AUTO_LOITER
        self._followed: Mode | None = None  # what the cascade follows; nothing while disarmed
        self._motors = MotorSwitch(self.view)
        self._armed_us = 0
        self._disarmed_us = _NEVER_US
        self._took_off = False
        self._was_landed = True
        self._landed_us = 0
        self._last_refusal_us = _NEVER_US
        parameters.write_to(autopilot.params[index])

    # what the heartbeat and its like say

    @property
    def texts(self) -> deque[tuple[int, str]]:
        """(MAV_SEVERITY, text) that no link has taken yet; the oldest are dropped beyond 64."""
        return self._announcements.texts

    @property
    def on_text(self) -> Callable[[int, str], None] | None:
        """What is called with every text, besides: the logger."""
        return self._announcements.on_text

    @on_text.setter
    def on_text(self, listener: Callable[[int, str], None] | None) -> None:
        self._announcements.on_text = listener

    @property
    def events(self) -> deque[Event]:
        """Events that no link has taken yet; the oldest are dropped beyond 64."""
        return self._announcements.events

    @property
    def mode(self) -> Mode:
        """The mode that is flown: the failsafe's while one acts."""
        return self._flown

    @property
    def failsafe(self) -> bool:
        """Whether a failsafe has taken the vehicle out of its mode."""
        return self._failsafe.outcome.active

    @property
    def failsafe_outcome(self) -> Outcome:
        """What the failsafes do, and why."""
        return self._failsafe.outcome

    @property
    def battery(self) -> BatteryEstimate:
        """What is known of the battery."""
        return self.health.battery

    @property
    def requested_mode(self) -> Mode:
        """The mode that was asked for, whatever a failsafe has made of it."""
        return self._mode

    @property
    def base_mode(self) -> int:
        """HEARTBEAT.base_mode."""
        return self._flown.flags | (modes.ARMED_FLAG if self.armed else 0)

    @property
    def custom_mode(self) -> int:
        """HEARTBEAT.custom_mode."""
        return self._flown.custom_mode

    @property
    def system_status(self) -> int:
        """HEARTBEAT.system_status: a MAV_STATE."""
        if not self.view.initialised:
            return _UNINIT
        if self._motors.stopped or self._flown is modes.TERMINATION:
            return _TERMINATED
        if not self.armed:
            return _STANDBY
        return _CRITICAL_STATE if self.failsafe else _ACTIVE

    @property
    def landed_state(self) -> int:
        """EXTENDED_SYS_STATE.landed_state: a MAV_LANDED_STATE."""
        if self.view.landed:
            return _ON_GROUND
        if self.navigator.landing or self._flown is modes.DESCEND:
            return _LANDING
        return _TAKEOFF if self.navigator.taking_off else _IN_AIR

    @property
    def armed_since_us(self) -> int:
        """Simulated time of the arming, microseconds; 0 while disarmed."""
        return self._armed_us if self.armed else 0

    @property
    def ready_to_arm(self) -> bool:
        """Whether arming would be accepted in the present mode."""
        return not self.armed and not self.arming_obstacle()

    def say(self, severity: int, text: str) -> None:
        """Queue a text for the operator (``severity``: MAV_SEVERITY)."""
        self._announcements.say(severity, text)

    def tell(self, severity: int, text: str, name: str, *values: float, level: int | None = None) -> None:
        """Queue a text for the operator, and the event that says the same; see ``Announcements.tell``."""
        self._announcements.tell(severity, text, name, *values, level=level)

    def warn(self, text: str) -> None:
        """Queue a warning, at most one a second."""
        self._announcements.warn(text)

    # arming

    def arm_disarm(self, arm: bool, force: bool = False) -> Result:
        """Arm or disarm by command; ``force`` passes over the checks, even in the air."""
        done = self._arm(ArmReason.COMMAND, force) if arm else self._disarm_unless_flying(ArmReason.COMMAND, force)
        return Result.ACCEPTED if done else Result.TEMPORARILY_REJECTED

    def arming_obstacle(self) -> str:
        """Return why the vehicle may not be armed now in the present mode, or an empty text."""
        flags = self.health.look(self._mode, self.armed)
        return self._checks.report(flags, self._mode, self.armed).reason(self._mode)

    def mode_obstacle(self, mode: Mode) -> str:
        """Return why ``mode`` cannot be flown now, or an empty text."""
        flags = self.health.look(mode, self.armed)
        return self._checks.report(flags, mode, self.armed).reason(mode)

    def _arm(self, reason: ArmReason, force: bool = False) -> bool:
        """Arm, unless something stands against it; return whether the vehicle is armed."""
        if self.armed:
            return True
        if self._motors.terminated:
            self.say(CRITICAL, "Arming denied: flight was terminated, reboot the autopilot")
            return False
        if not self.view.initialised:
            self._refuse_arming()
            return False
        in_grace = self.view.time_us - self._disarmed_us < _GRACE_US and not self.view.landed
        if not force and not in_grace and self._arming_refused(reason):
            return False
        self.armed = True
        self._armed_us = self.view.time_us
        self._took_off = not self.view.landed
        self._was_landed = self.view.landed
        if self.view.global_valid and int(self.parameters.get("COM_HOME_EN")) and self.view.landed:
            self._set_home_here()
        self._motors.apply(self.armed)
        number, words = reason.value
        self._announcements.tell(INFO, f"Armed by {words}", "commander_armed_by", number)
        self._decide(changed=True)
        return True

    def _arming_refused(self, reason: ArmReason) -> bool:
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
        if self.arming_obstacle():
            self._refuse_arming()
            return True
        return False

    def _refuse_arming(self) -> None:
        """Tell why arming is refused: PX4 does so by events alone."""
        flags = self.health.look(self._mode, self.armed)
        report = self._checks.report(flags, self._mode, self.armed)
        self._announcements.emit(self._checks.events(report, self.view.time_us, force=True))

    def _disarm_unless_flying(self, reason: ArmReason, force: bool = False) -> bool:
        if not self.armed:
            return True
        on_ground = self.view.landed or bool(self.view.control["maybe_landed"])
        by_pilot = self._flown in MANUAL_THRUST and reason in _BY_PILOT
        if not on_ground and not by_pilot and not force:
            if reason is not ArmReason.STICK:
                text = "Disarming denied! Not landed"
                self._announcements.tell(CRITICAL, text, "commander_disarming_denied_not_landed")
            return False
        self._disarm(reason)
        return True

    def _disarm(self, reason: ArmReason) -> None:
        self.armed = False
        self.flights += 1
        self._disarmed_us = self.view.time_us
        self._motors.apply(self.armed)
        self.navigator.deactivate()
        self.navigator.mission.reset()
        self._followed = None
        self.view.start_task(TASK_IDLE)
        number, words = reason.value
        self._announcements.tell(INFO, f"Disarmed by {words}", "commander_disarmed_by", number)
        self._mode = self._mode_after_disarming
        self._decide()

    # kill and termination

    def kill(self, stop: bool) -> None:
        """Stop the motors at once, as a kill switch does, or let them run again; it disarms after COM_KILL_DISARM."""
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
        """Obey MAV_CMD_DO_FLIGHTTERMINATION: stop the motors for good (1) or as a test (2), or let them run (0)."""
        if math.isnan(level):
            return Result.DENIED
        if level > 1.5:
            self._motors.locked = True
        elif level > 0.5:
            self._motors.terminated = True
        else:
            self._motors.locked = self._motors.terminated = False
        self._motors.apply(self.armed)
        return Result.ACCEPTED

    def _disarm_killed(self) -> bool:
        """Disarm a vehicle whose motors have stood still for COM_KILL_DISARM; return whether it was."""
        reason = self._motors.disarming(self.parameters.get("COM_KILL_DISARM"))
        if reason is not None:
            self._disarm(reason)
        return reason is not None

    # modes

    def set_mode(self, base_mode: int, custom_mode: int) -> Result:
        """Go to the mode of PX4's ``custom_mode``, or, when ``base_mode`` does not say that it is one, to its own."""
        if not base_mode & modes.CUSTOM_FLAG:
            return self.request(modes.from_base_mode(base_mode))
        mode = modes.from_custom_mode(custom_mode)
        if mode is not None:
            return self.request(mode)
        if custom_mode >> 16 & 0xFF == modes.MAIN_AUTO:
            text, name = "Unsupported auto mode", "commander_unsupported_auto_mode"
            self._announcements.tell(CRITICAL, text, name, level=events.ERROR)
            return Result.TEMPORARILY_REJECTED
        if modes.is_main_mode(custom_mode >> 16 & 0xFF):
            return Result.TEMPORARILY_REJECTED
        return Result.ACCEPTED  # as PX4: nothing is done

    def request(self, mode: Mode) -> Result:
        """Go to a mode. A disarmed vehicle goes to any; an armed one only to one that it can fly."""
        if self.armed and not self._can_choose(mode):
            if self.view.time_us - self._last_refusal_us > _REFUSAL_INTERVAL_US:
                self._last_refusal_us = self.view.time_us
                self._announcements.mode_refused(mode)
            return Result.TEMPORARILY_REJECTED
        self._mode_chosen = True
        self._intend(mode)
        self._decide(changed=True)
        return Result.ACCEPTED

    def _can_choose(self, mode: Mode) -> bool:
        if self._flown is modes.TERMINATION:
            return False
        flags = self.health.look(mode, self.armed)
        if mode.sticks and flags.manual_lost:
            return False
        if can_run(mode, flags):
            return True
        falls_back = mode is modes.POSCTL and int(self.parameters.get("COM_POSCTL_NAVL")) == 0
        return falls_back and can_run(modes.ALTCTL, flags)

    def _intend(self, mode: Mode) -> None:
        self._mode = mode
        if not mode.prevents_arming:
            self._mode_after_disarming = mode

    def _decide(self, *, changed: bool = False, sticks: bool = False, flags: Flags | None = None) -> None:
        """Let the failsafes look at what was asked for, and fly what comes of it.

        Args:
            changed: a mode was asked for.
            sticks: the pilot wants to take over.
            flags: what is wrong, when it is known.
        """
        if flags is None:
            flags = self.health.look(self._mode, self.armed)
        before, flown_before = self._failsafe.outcome, self._flown
        outcome = self._failsafe.update(
            self.view.time_us, self.armed, self._mode, flags, changed=changed, sticks=sticks
        )
        if outcome is before:
            return
        if outcome.intended is not self._mode:
            self._intend(outcome.intended)
        if outcome.notify:
            self._announcements.failsafe(outcome)
        if outcome.takeover and not before.takeover:
            self._announcements.tell(INFO, "Pilot took over using sticks", "failsafe_rc_override")
        self._flown = outcome.mode
        self._act(outcome, before)
        if self._flown is not flown_before and self._flown is modes.AUTO_RTL:
            self._announcements.tell(INFO, "RTL HOME activated", "navigator_rtl_home_activated")
        anew = changed and not outcome.active
        stops = outcome.active and not before.active and self._flown is modes.AUTO_LOITER  # whatever it flew to
        if self.armed and (anew or stops or self._flown is not self._followed):
            self._fly(self._flown)

    def _act(self, outcome: Outcome, before: Outcome) -> None:
        """Do what is no mode: stop the motors."""
        if outcome.action is before.action:
            return
        if outcome.action is Action.TERMINATE:
            self._motors.terminated = True
            self._motors.apply(self.armed)
        elif outcome.action is Action.DISARM and self.armed:
            self._disarm(ArmReason.FAILSAFE)

    def _fly(self, mode: Mode) -> None:
        """Let the cascade follow ``mode``; the vehicle is armed."""
        self._followed = mode
        if mode.auto:
            self.navigator.activate(mode)
        else:
            self.navigator.deactivate()
            self._fly_by_hand(mode)

    def _fly_by_hand(self, mode: Mode) -> None:
        if mode is modes.OFFBOARD:
            self._offboard.write()
        elif mode is modes.TERMINATION:
            self.view.start_task(TASK_IDLE)
        elif mode.sticks:
            self._steer(restart=True)
        else:
            self.view.start_task(TASK_DESCEND)

    # the pilot

    def manual_control(self, x: float, y: float, z: float, yaw: float) -> None:
        """Take a joystick's sticks, each -1..1: forward, right, up (0 is the middle), clockwise.

        Raises:
            SetpointError: a value that is not finite.
        """
        self.manual.joystick(Sticks(x, y, z, yaw), self.view.time_us)
        self._follow_pilot()

    def radio_control(self, channels: Sequence[int]) -> None:
        """Take the pulse widths (us) of a radio's channels, see ``ManualControl.radio``."""
        self.manual.radio(channels, self.view.time_us)
        self._follow_pilot()

    def _follow_pilot(self) -> None:
        if self.armed and self._flown.sticks:
            self._steer()

    def _steer(self, *, restart: bool = False) -> None:
        self._hand_flight.steer(self._flown, self.manual.sticks, self.health.flags.place_invalid, restart=restart)

    def _obey_pilot(self) -> None:
        """Do what the pilot asks for by gesture or switch."""
        self.manual.receiver_works = self.view.failures["rc_signal"] != FAILURE_OFF
        for request in self.manual.update(self.view.time_us):
            self._obey(request)

    def _obey(self, request: Request) -> None:
        if request.what in ("kill", "unkill"):
            self.kill(request.what == "kill")
            return
        if request.what == "mode":
            mode = modes.from_number(request.mode)
            if mode is not None:
                self.request(mode)
            return
        reason = _REASONS[request.origin]
        if request.what == "arm" or (request.what == "toggle" and not self.armed):
            self._arm(reason)
        else:
            self._disarm_unless_flying(reason)

    def _look_at_sticks(self) -> bool:
        """Let moved sticks end AUTO and OFFBOARD flight; return whether they are to end a failsafe."""
        if self.manual.sticks is None:
            return False
        if not self.armed:
            # a pilot who comes first, with nobody having asked for a mode, gets the one he can fly
            if not self._mode_chosen and not (self.manual.by_radio and int(self.parameters.get("RC_MAP_FLTMODE"))):
                self._mode_chosen = True
                self._intend(modes.POSCTL)
            return False
        if self.view.landed or self._flown.sticks or self._flown is modes.TERMINATION or not self.manual.moving:
            return False
        bit = _OVERRIDE_OFFBOARD if self._flown is modes.OFFBOARD else _OVERRIDE_AUTO
        if not int(self.parameters.get("COM_RC_OVERRIDE")) & bit:
            return False
        if self.failsafe:
            return True
        if self._can_choose(modes.POSCTL):
            self._intend(modes.POSCTL)
            self._announcements.tell(INFO, "Pilot took over using sticks", "commander_rc_override")
        return False

    # steering from outside

    def offboard_trajectory(
        self, position: Vector, velocity: Vector, acceleration: Vector, yaw: float, yaw_rate: float
    ) -> None:
        """Take a trajectory setpoint of the OFFBOARD stream: local NED, NaN is not controlled.

        It feeds the stream's watchdog in every mode and is flown in OFFBOARD.

        Raises:
            SetpointError: see ``OffboardInput.set_trajectory``.
        """
        self._offboard.set_trajectory(position, velocity, acceleration, yaw, yaw_rate)
        self._follow_offboard()

    def offboard_attitude(self, attitude: Sequence[float], yaw_rate: float, thrust: float) -> None:
        """Take an attitude setpoint of the OFFBOARD stream.

        Raises:
            SetpointError: see ``OffboardInput.set_attitude``.
        """
        self._offboard.set_attitude(attitude, yaw_rate, thrust)
        self._follow_offboard()

    def offboard_rates(self, rates: Sequence[float], thrust: float) -> None:
        """Take a body-rate setpoint of the OFFBOARD stream.

        Raises:
            SetpointError: see ``OffboardInput.set_rates``.
        """
        self._offboard.set_rates(rates, thrust)
        self._follow_offboard()

    @property
    def offboard_incomplete(self) -> bool:
        """Whether the last setpoint leaves an axis without control, and the vehicle stops and waits instead."""
        return self._offboard.incomplete

    def _follow_offboard(self) -> None:
        if self.armed and self._flown is modes.OFFBOARD:
            self._offboard.write()

    def gcs_heartbeat(self) -> None:
        """Note that a ground station is there."""
        self.health.gcs_heartbeat()

    # what goes on by itself

    def update(self) -> None:
        """Look at pilot, landing, failsafes and the AUTO modes' progress; call at about 10 Hz."""
        view = self.view
        self._obey_pilot()
        flags = self.health.update(self._mode, self._flown, self.armed)
        if self.home is None and view.global_valid:
            self._set_home_here()
        if self.armed:
            landed = view.landed
            if landed != self._was_landed:
                self._note_landing(landed)
            if (landed and self._auto_disarm()) or self._disarm_killed():
                return
        else:
            self._checks.follow_innovations()
        take_over = self._look_at_sticks()
        self._decide(sticks=take_over, flags=flags)
        self._move_gear()
        self._tell_checks(flags)
        if self.armed:
            self._go_on()

    def _move_gear(self) -> None:
        """Have the landing gear up in AUTO modes well above home and down to land, else as it is (FlightTaskAuto)."""
        if self.landed_state in (_ON_GROUND, _LANDING):
            self.gear_up = False
        elif self._flown.auto and self.home is not None:
            height = self.home.position[2] - self.view.position[2]
            self.gear_up = self.gear_up or height > _GEAR_HEIGHT

    def _go_on(self) -> None:
        """Let pilot and navigator go on with the mode that is flown."""
        if self._flown.sticks:
            self._steer()
        following = self.navigator.update()
        if following is not None:  # never while a failsafe acts: what it flies does not end
            self._intend(following)
            self._decide(changed=True)

    def _tell_checks(self, flags: Flags) -> None:
        """Tell by events what stands against arming, when that has changed."""
        key = (flags, self._mode, self.armed)
        now_us = self.view.time_us
        due = not self.armed and now_us - self._checked_us >= _CHECK_INTERVAL_US
        if key == self._reported and not due:
            return
        self._reported, self._checked_us = key, now_us
        report = self._checks.report(flags, self._mode, self.armed)
        self._announcements.emit(self._checks.events(report, now_us))

    def _note_landing(self, landed: bool) -> None:
        self._was_landed = landed
        self._took_off = True
        self._landed_us = self.view.time_us
        if landed:
            self._announcements.tell(INFO, "Landing detected", "commander_landing_detected")
        else:
            self._announcements.tell(INFO, "Takeoff detected", "commander_takeoff_detected")

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
