"""Failsafe actions chosen from health flags and parameters, modelled on PX4 v1.14's failsafe framework.

``triggered`` maps the current conditions to actions and has no state. ``Failsafe`` tracks the active conditions, delays
an action that the pilot may prevent by COM_FAIL_ACT_T, handles pilot takeover, and falls back to a mode that the
vehicle can fly.
"""

from __future__ import annotations

import enum
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

from xtdrone_common import modes
from xtdrone_common.modes import Mode

Get = Callable[[str], float]

FLIGHT_TERMINATION_KEY = 121212  # CBRK_FLIGHTTERM: exceeding the attitude limit only warns
_MIN_DELAY_US = 100_000
_STICKS_DISABLED = 4  # COM_RC_IN_MODE
_EXCEPT_MISSION, _EXCEPT_HOLD, _EXCEPT_OFFBOARD = 1, 2, 4  # COM_RCL_EXCEPT

BATTERY_OK, BATTERY_LOW, BATTERY_CRITICAL, BATTERY_EMERGENCY = range(4)


class Action(enum.IntEnum):
    """Failsafe action in ascending severity; values of PX4's failsafe_action_t."""

    NONE = 0
    WARN = 1
    POSCTL = 2
    ALTCTL = 3
    STABILIZED = 4
    HOLD = 5
    RETURN = 6
    LAND = 7
    DESCEND = 8
    DISARM = 9
    TERMINATE = 10


class Cause(enum.IntEnum):
    """Cause of a failsafe action; values of PX4's failsafe_cause_t."""

    GENERIC = 0
    MANUAL_CONTROL_LOSS = 1
    GCS_CONNECTION_LOSS = 2
    BATTERY_LOW = 3
    BATTERY_CRITICAL = 4
    BATTERY_EMERGENCY = 5


class Clear(enum.Enum):
    """Event that ends an action after its condition has cleared."""

    CONDITION_CLEARED = "immediately"
    MODE_CHANGE = "at the next mode change or disarming"
    NEVER = "never"


class Takeover(enum.IntEnum):
    """The pilot's options to take over, from the least to the most restricted."""

    ALWAYS = 0
    MODE_SWITCH = 1
    AUTO = 2  # resolved to ALWAYS or MODE_SWITCH, depending on COM_FAIL_ACT_T
    NEVER = 3


class Flags(NamedTuple):
    """Health flags of a vehicle; all false or zero for a healthy vehicle.

    Attributes:
        attitude_invalid: no attitude estimate.
        altitude_invalid: no altitude estimate.
        position_invalid: no horizontal position estimate accurate enough for AUTO modes.
        relaxed_position_invalid: no horizontal position estimate at all.
        global_position_invalid: the same as ``position_invalid``, or the local frame's place on Earth is unknown.
        home_missing: no home position.
        mission_missing: no feasible mission.
        offboard_lost: OFFBOARD setpoint stream missing or unusable.
        manual_lost: no manual control input.
        gcs_lost: no ground station connection.
        geofence: geofence breached.
        battery: BATTERY_OK, _LOW, _CRITICAL or _EMERGENCY.
        battery_unhealthy: no battery detected.
        attitude_failure: roll or pitch beyond its limit for too long.
        motor_failure: at least one motor has stopped.
        flight_time_exceeded: more than COM_FLT_TIME_MAX since takeoff.
    """

    attitude_invalid: bool = False
    altitude_invalid: bool = False
    position_invalid: bool = False
    relaxed_position_invalid: bool = False
    global_position_invalid: bool = False
    home_missing: bool = False
    mission_missing: bool = False
    offboard_lost: bool = False
    manual_lost: bool = False
    gcs_lost: bool = False
    geofence: bool = False
    battery: int = BATTERY_OK
    battery_unhealthy: bool = False
    attitude_failure: bool = False
    motor_failure: bool = False
    flight_time_exceeded: bool = False


class Situation(NamedTuple):
    """Flight state that the failsafe conditions depend on.

    Attributes:
        armed: whether the vehicle is armed.
        mode: requested mode.
        starting: less than COM_SPOOLUP_TIME + COM_LKDOWN_TKO since arming.
        manual_needed: manual control was available at arming or has been since.
    """

    armed: bool
    mode: Mode
    starting: bool = False
    manual_needed: bool = True


@dataclass(frozen=True)
class Option:
    """Response to a condition."""

    action: Action
    clear: Clear = Clear.CONDITION_CLEARED
    takeover: Takeover = Takeover.AUTO
    cause: Cause = Cause.GENERIC


_NOTHING = Option(Action.NONE)
_WARN = Option(Action.WARN)
_HOLD = Option(Action.HOLD, Clear.MODE_CHANGE)
_RETURN = Option(Action.RETURN, Clear.MODE_CHANGE)
_LAND = Option(Action.LAND, Clear.MODE_CHANGE)
_TERMINATE = Option(Action.TERMINATE, Clear.NEVER, Takeover.NEVER)

_LINK_ACTIONS = {
    0: _NOTHING,
    1: _HOLD,
    2: _RETURN,
    3: _LAND,
    5: _TERMINATE,
    6: Option(Action.DISARM, takeover=Takeover.NEVER),
}
_GEOFENCE_ACTIONS = {
    0: _NOTHING,
    1: _WARN,
    2: Option(Action.HOLD, Clear.MODE_CHANGE, Takeover.MODE_SWITCH),  # so that the pilot can fly back
    3: _RETURN,
    4: _TERMINATE,
    5: _LAND,
}
_MOTOR_ACTIONS = {0: _WARN, 1: Option(Action.HOLD), 2: _LAND, 3: _RETURN, 4: Option(Action.TERMINATE, Clear.NEVER)}
_OFFBOARD_ACTIONS: dict[int, tuple[Action, Mode]] = {
    0: (Action.POSCTL, modes.POSCTL),
    1: (Action.ALTCTL, modes.ALTCTL),
    2: (Action.STABILIZED, modes.STABILIZED),
    3: (Action.RETURN, modes.AUTO_RTL),
    4: (Action.LAND, modes.AUTO_LAND),
    5: (Action.HOLD, modes.AUTO_LOITER),
    6: (Action.TERMINATE, modes.TERMINATION),
    7: (Action.DISARM, modes.OFFBOARD),
}
# COM_LOW_BAT_ACT: actions for a critical and for an emergency battery level
_BATTERY_ACTIONS = {
    0: (Action.WARN, Action.WARN),
    1: (Action.RETURN, Action.RETURN),
    2: (Action.LAND, Action.LAND),
    3: (Action.RETURN, Action.LAND),
}
_MODES: dict[Action, Mode] = {
    Action.POSCTL: modes.POSCTL,
    Action.ALTCTL: modes.ALTCTL,
    Action.STABILIZED: modes.STABILIZED,
    Action.HOLD: modes.AUTO_LOITER,
    Action.RETURN: modes.AUTO_RTL,
    Action.LAND: modes.AUTO_LAND,
    Action.DESCEND: modes.DESCEND,
    Action.TERMINATE: modes.TERMINATION,
}


def can_run(mode: Mode, flags: Flags) -> bool:
    """Return whether the vehicle can fly ``mode``, with or without a pilot."""
    return not missing(mode, flags)


def missing(mode: Mode, flags: Flags) -> set[str]:
    """Return the needs of ``mode`` (see ``Mode.needs``) that the vehicle does not meet."""
    lacking = {
        "attitude": flags.attitude_invalid,
        "altitude": flags.altitude_invalid,
        "position": flags.position_invalid,
        "relaxed_position": flags.relaxed_position_invalid,
        "global_position": flags.global_position_invalid,
        "home": flags.home_missing,
        "mission": flags.mission_missing,
        "offboard": flags.offboard_lost,
    }
    return {need for need in mode.needs if lacking[need]}


def _battery_option(flags: Flags, get: Get) -> Option:
    if flags.battery == BATTERY_LOW:
        return Option(Action.WARN, cause=Cause.BATTERY_LOW)
    critical, emergency = _BATTERY_ACTIONS.get(int(get("COM_LOW_BAT_ACT")), _BATTERY_ACTIONS[0])
    if flags.battery == BATTERY_CRITICAL:
        return Option(critical, cause=Cause.BATTERY_CRITICAL)
    return Option(emergency, cause=Cause.BATTERY_EMERGENCY)


def _manual_loss_ignored(situation: Situation, get: Get) -> bool:
    if int(get("COM_RC_IN_MODE")) == _STICKS_DISABLED or not situation.manual_needed:
        return True
    exceptions = int(get("COM_RCL_EXCEPT"))
    bits = {
        modes.AUTO_MISSION: _EXCEPT_MISSION,
        modes.AUTO_LOITER: _EXCEPT_HOLD,
        modes.AUTO_TAKEOFF: _EXCEPT_HOLD,
        modes.OFFBOARD: _EXCEPT_OFFBOARD,
    }
    return bool(exceptions & bits.get(situation.mode, 0))


def _attitude_option(situation: Situation, get: Get) -> Option:
    if situation.starting:
        return Option(Action.DISARM)
    if int(get("CBRK_FLIGHTTERM")) == FLIGHT_TERMINATION_KEY:
        return _WARN
    return Option(Action.TERMINATE)


def mode_fallback(mode: Mode, flags: Flags, get: Get) -> Action:
    """Return the action that replaces ``mode`` when it cannot be flown, ``Action.NONE`` when it can."""
    action = Action.NONE
    if mode is modes.OFFBOARD and flags.offboard_lost:
        action, mode = _OFFBOARD_ACTIONS.get(int(get("COM_OBL_RC_ACT")), _OFFBOARD_ACTIONS[0])
        if action is Action.DISARM:
            return action
    if int(get("COM_POSCTL_NAVL")) == 0:
        if mode is modes.POSCTL and not can_run(mode, flags):
            action, mode = Action.ALTCTL, modes.ALTCTL
        if mode is modes.ALTCTL and not can_run(mode, flags):
            action, mode = Action.STABILIZED, modes.STABILIZED
    elif mode is modes.POSCTL and not can_run(mode, flags):
        action, mode = Action.LAND, modes.AUTO_LAND
        if not can_run(mode, flags):
            action, mode = Action.DESCEND, modes.DESCEND
    return action if can_run(mode, flags) else Action.RETURN


def triggered(situation: Situation, flags: Flags, get: Get) -> dict[str, Option]:
    """Return the response to each condition that holds, keyed by the condition's name.

    Args:
        situation: flight state.
        flags: health flags.
        get: returns a parameter by name.
    """
    found: dict[str, Option] = {}
    if flags.manual_lost and not _manual_loss_ignored(situation, get):
        option = _LINK_ACTIONS.get(int(get("NAV_RCL_ACT")), _NOTHING)
        found["manual control"] = replace(option, cause=Cause.MANUAL_CONTROL_LOSS)
    if flags.gcs_lost and situation.mode not in (modes.AUTO_LAND, modes.AUTO_PRECLAND):
        option = _LINK_ACTIONS.get(int(get("NAV_DLL_ACT")), _NOTHING)
        found["ground station"] = replace(option, cause=Cause.GCS_CONNECTION_LOSS)
    if flags.flight_time_exceeded:
        found["flight time"] = Option(Action.RETURN)
    if flags.geofence:
        found["geofence"] = _GEOFENCE_ACTIONS.get(int(get("GF_ACTION")), _WARN)
    if flags.battery_unhealthy:
        found["battery health"] = _WARN
    if flags.battery:
        found[f"battery {flags.battery}"] = _battery_option(flags, get)
    if flags.attitude_failure:
        found["attitude"] = _attitude_option(situation, get)
    if flags.motor_failure:
        found["motor"] = _MOTOR_ACTIONS.get(int(get("COM_ACT_FAIL_ACT")), _WARN)
    fallback = mode_fallback(situation.mode, flags, get)
    if fallback is not Action.NONE:
        found["mode"] = Option(fallback, takeover=Takeover.ALWAYS)
    return {name: option for name, option in found.items() if option.action is not Action.NONE}


def possible(action: Action, flags: Flags) -> Action:
    """Return ``action``, or the next more severe action that the vehicle can perform."""
    if action < Action.POSCTL or action is Action.DISARM:
        return action
    for candidate in list(Action)[action : Action.DISARM]:
        if can_run(_MODES[candidate], flags):
            return candidate
    return Action.TERMINATE


def _already_landing(action: Action, delayed: Action, mode: Mode, flags: Flags) -> bool:
    """Return whether the vehicle is already landing, which makes ``action`` unnecessary."""
    if not can_run(mode, flags):
        return False
    if mode is modes.AUTO_LAND:
        return Action.RETURN in (action, delayed)
    return mode is modes.AUTO_PRECLAND and bool({Action.RETURN, Action.LAND} & {action, delayed})


@dataclass
class _Active:
    option: Option
    failing: bool = True


@dataclass(frozen=True)
class Outcome:
    """Decision of the failsafe framework.

    Attributes:
        action: current action.
        delayed: action that follows the delay of COM_FAIL_ACT_T; NONE outside the delay.
        delay: remaining delay, s.
        cause: cause of the action.
        mode: mode to fly.
        intended: requested mode, or the one selected by the pilot's takeover.
        notify: whether to notify the operator.
        takeover: whether the pilot has taken over.
    """

    action: Action
    delayed: Action
    delay: float
    cause: Cause
    mode: Mode
    intended: Mode
    notify: bool = False
    takeover: bool = False

    @property
    def active(self) -> bool:
        """Whether the action overrides the requested mode."""
        return self.action > Action.WARN


class Failsafe:
    """Failsafe framework of one vehicle.

    Attributes:
        outcome: the last decision.
    """

    def __init__(self, get: Get, mode: Mode, changes: Callable[[], int] = int) -> None:
        """Start without any active condition.

        Args:
            get: returns a parameter by name.
            mode: requested mode.
            changes: returns the number of parameter changes so far.
        """
        self._get = get
        self._changes = changes
        self._active: dict[str, _Active] = {}
        self._takeover = False
        self._armed = False
        self._armed_us = 0
        self._manual_needed = False
        self._last_us: int | None = None
        self._last_mode = mode
        self._delay_us = 0.0  # remaining time before a delayed action
        self._start_delay_us = self._configured_delay_us()
        self._idle_key: tuple[bool, Mode, Flags, int] | None = None  # input that needs no action
        self.outcome = Outcome(Action.NONE, Action.NONE, 0.0, Cause.GENERIC, mode, mode)

    def _configured_delay_us(self) -> float:
        return self._get("COM_FAIL_ACT_T") * 1e6

    def update(
        self, now_us: int, armed: bool, mode: Mode, flags: Flags, *, changed: bool = False, sticks: bool = False
    ) -> Outcome:
        """Return the decision for the current flags and requested mode.

        Args:
            now_us: simulated time, microseconds.
            armed: whether the vehicle is armed.
            mode: requested mode.
            flags: health flags.
            changed: a mode, even the same one, was requested since the last call.
            sticks: the pilot takes over with the sticks.
        """
        key = (armed, mode, flags, self._changes())
        if key == self._idle_key and not changed and not sticks:
            self._last_us = now_us
            return self.outcome
        elapsed = 0 if self._last_us is None else now_us - self._last_us
        changed = changed or mode is not self._last_mode
        self._drop_ended(armed, changed)
        situation = self._situation(now_us, armed, mode, flags)
        self._delay_us = max(self._delay_us - elapsed, 0.0)
        added = self._update_active(triggered(situation, flags, self._get))
        if self.outcome.action > Action.HOLD or self._takeover or not can_run(modes.AUTO_LOITER, flags):
            self._delay_us = 0.0
        outcome = self._select(armed, mode, flags, changed, sticks)
        self._restore_delay(elapsed, outcome.delayed is not Action.NONE)
        worse = outcome.action > self.outcome.action or (added and outcome.action is not Action.NONE)
        self.outcome = replace(outcome, notify=False)
        self._takeover = outcome.takeover
        self._last_us, self._last_mode = now_us, outcome.intended
        at_rest = not self._active and self._start_delay_us >= self._configured_delay_us()
        self._idle_key = key if at_rest and outcome.mode is mode and not sticks else None
        return replace(outcome, notify=worse)

    def _drop_ended(self, armed: bool, changed: bool) -> None:
        """Drop actions ended by arming, disarming or a mode change, unless their condition still holds."""
        turned = armed is not self._armed
        if turned:
            self._takeover = False
        if turned or changed or self._takeover:
            for name, active in list(self._active.items()):
                if not active.failing and active.option.clear is Clear.MODE_CHANGE:
                    del self._active[name]

    def _situation(self, now_us: int, armed: bool, mode: Mode, flags: Flags) -> Situation:
        if not armed or not self._armed:
            self._manual_needed = not flags.manual_lost
            self._armed_us = now_us
        elif not flags.manual_lost:
            self._manual_needed = True
        self._armed = armed
        window = self._get("COM_SPOOLUP_TIME") + self._get("COM_LKDOWN_TKO")
        starting = armed and now_us - self._armed_us < window * 1e6
        return Situation(armed, mode, starting, self._manual_needed)

    def _update_active(self, found: dict[str, Option]) -> bool:
        """Update the active conditions; return whether a new warning must be announced."""
        for name, active in list(self._active.items()):
            active.failing = name in found
            if not active.failing and active.option.clear is Clear.CONDITION_CLEARED:
                del self._active[name]
        warned = False
        for name, option in found.items():
            if name in self._active:
                # a mode or parameter change may alter the action; takeover and end condition stay
                self._active[name].option = replace(self._active[name].option, action=option.action)
                continue
            self._active[name] = _Active(self._with_delay(option))
            warned = warned or option.action is Action.WARN
            if option.action >= Action.HOLD:
                self._takeover = False
        return warned

    def _with_delay(self, option: Option) -> Option:
        """Start the delay of an action that the pilot may prevent; return the action with its takeover resolved."""
        if option.takeover is not Takeover.AUTO:
            return option
        if self._configured_delay_us() <= _MIN_DELAY_US:
            return replace(option, takeover=Takeover.MODE_SWITCH)
        if option.action is not Action.WARN and self._delay_us == 0.0:
            self._delay_us = self._start_delay_us
        return replace(option, takeover=Takeover.ALWAYS)

    def _restore_delay(self, elapsed: float, delaying: bool) -> None:
        """Restore the delay more slowly than it elapses, so that a flickering condition triggers its action."""
        if delaying:
            self._start_delay_us = max(self._start_delay_us - elapsed, 0.0)
        else:
            self._start_delay_us = min(self._start_delay_us + elapsed / 4, self._configured_delay_us())

    def _select(self, armed: bool, mode: Mode, flags: Flags, changed: bool, sticks: bool) -> Outcome:
        if self.outcome.action is Action.TERMINATE:
            return replace(self.outcome, intended=mode)  # termination is final
        if not armed:
            return Outcome(Action.NONE, Action.NONE, 0.0, Cause.GENERIC, mode, mode)
        action, cause, allowed = self._most_severe()
        delayed = Action.NONE
        waiting = self._delay_us > 0 and not self._takeover and allowed <= Takeover.MODE_SWITCH
        if waiting and Action.WARN < action < Action.DISARM:
            action, delayed, allowed = Action.HOLD, action, Takeover.MODE_SWITCH
        takeover = self._pilot_takes_over(action, allowed, changed, sticks)
        if takeover:
            if sticks and not self._takeover:
                mode = modes.POSCTL
            action, delayed = max(Action.WARN, mode_fallback(mode, flags, self._get)), Action.NONE
        feasible = possible(action, flags)
        if feasible is not action:
            action, cause = feasible, Cause.GENERIC
        if _already_landing(action, delayed, mode, flags):
            action, delayed = Action.WARN, Action.NONE
        return Outcome(action, delayed, self._delay_us * 1e-6, cause, _MODES.get(action, mode), mode, takeover=takeover)

    def _most_severe(self) -> tuple[Action, Cause, Takeover]:
        action, cause, allowed = Action.NONE, Cause.GENERIC, Takeover.ALWAYS
        for active in self._active.values():
            allowed = max(allowed, active.option.takeover)
            if active.option.action > action:
                action, cause = active.option.action, active.option.cause
        return action, cause, allowed

    def _pilot_takes_over(self, action: Action, allowed: Takeover, changed: bool, sticks: bool) -> bool:
        if not Action.HOLD <= action <= Action.DESCEND:
            return False  # manual modes need no takeover; disarming and termination allow none
        switched = changed and self.outcome.action is action
        if allowed is Takeover.ALWAYS:
            return self._takeover or switched or sticks
        return allowed is Takeover.MODE_SWITCH and (self._takeover or switched)
