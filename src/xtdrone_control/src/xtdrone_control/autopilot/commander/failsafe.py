"""Failsafes: what a vehicle does of its own accord, decided from flags and parameters (PX4 v1.14's failsafe framework).

``triggered`` says, without memory, which conditions ask for which action. ``Failsafe`` remembers which of them still
hold, waits COM_FAIL_ACT_T before what a pilot may prevent, lets a pilot take over, and falls back to what can be flown.
"""

from __future__ import annotations

import enum
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

from xtdrone_control.autopilot import modes
from xtdrone_control.autopilot.modes import Mode

Get = Callable[[str], float]

FLIGHT_TERMINATION_KEY = 121212  # CBRK_FLIGHTTERM: the attitude limit only warns
_SHORTEST_DELAY_US = 100_000
_STICKS_DISABLED = 4  # COM_RC_IN_MODE
_EXCEPT_MISSION, _EXCEPT_HOLD, _EXCEPT_OFFBOARD = 1, 2, 4  # COM_RCL_EXCEPT

BATTERY_OK, BATTERY_LOW, BATTERY_CRITICAL, BATTERY_EMERGENCY = range(4)


class Action(enum.IntEnum):
    """What is done, the later the more severe; the numbers are PX4's failsafe_action_t."""

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
    """Why; the numbers are PX4's failsafe_cause_t."""

    GENERIC = 0
    MANUAL_CONTROL_LOSS = 1
    GCS_CONNECTION_LOSS = 2
    BATTERY_LOW = 3
    BATTERY_CRITICAL = 4
    BATTERY_EMERGENCY = 5


class Clear(enum.Enum):
    """When an action ends whose condition has passed."""

    AT_ONCE = "at once"
    MODE_CHANGE = "with the next mode change or disarming"
    NEVER = "never"


class Takeover(enum.IntEnum):
    """Whether a pilot may take over, the later the less."""

    ALWAYS = 0
    MODE_SWITCH = 1
    AUTO = 2  # after the delay that COM_FAIL_ACT_T gives him
    NEVER = 3


class Flags(NamedTuple):
    """What is wrong with a vehicle. All false or zero: nothing is.

    Attributes:
        attitude_invalid: no attitude estimate.
        altitude_invalid: no height estimate.
        position_invalid: no horizontal estimate that is exact enough for an AUTO mode.
        place_invalid: no horizontal estimate at all.
        home_missing: no home position.
        mission_missing: no mission that can be flown.
        offboard_lost: no setpoints that OFFBOARD could follow.
        manual_lost: no pilot's sticks.
        gcs_lost: no ground station.
        geofence: a geofence is breached.
        battery: BATTERY_OK, _LOW, _CRITICAL or _EMERGENCY.
        battery_unhealthy: no battery is seen.
        attitude_failure: roll or pitch beyond its limit for too long.
        motor_failure: a motor does not turn.
        flight_time_exceeded: COM_FLT_TIME_MAX has passed since takeoff.
    """

    attitude_invalid: bool = False
    altitude_invalid: bool = False
    position_invalid: bool = False
    place_invalid: bool = False
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
    """What the vehicle is about.

    Attributes:
        armed: whether motors run.
        mode: the mode that was asked for.
        starting: COM_SPOOLUP_TIME and COM_LKDOWN_TKO since arming have not passed yet.
        manual_needed: manual control was there at arming or has been since.
    """

    armed: bool
    mode: Mode
    starting: bool = False
    manual_needed: bool = True


@dataclass(frozen=True)
class Option:
    """What a condition asks for."""

    action: Action
    clear: Clear = Clear.AT_ONCE
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
_MOTOR_ACTIONS = {
    0: _WARN,
    1: Option(Action.HOLD),
    2: _LAND,
    3: _RETURN,
    4: Option(Action.TERMINATE, Clear.NEVER),
}
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
# COM_LOW_BAT_ACT: what a critical and what an emergency battery asks for
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
    """Return what ``mode`` needs (see ``Mode.needs``) and the vehicle does not have."""
    lacking = {
        "attitude": flags.attitude_invalid,
        "altitude": flags.altitude_invalid,
        "position": flags.position_invalid,
        "place": flags.place_invalid,
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
    """Return what is done because ``mode`` cannot be flown, ``Action.NONE`` when it can."""
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
    """Return what each condition that holds asks for, by the condition's name.

    Args:
        situation: what the vehicle is about.
        flags: what is wrong.
        get: parameter by name.
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
    """Return ``action``, or the next more severe one that can be done."""
    if action < Action.POSCTL or action is Action.DISARM:
        return action
    for candidate in list(Action)[action : Action.DISARM]:
        if can_run(_MODES[candidate], flags):
            return candidate
    return Action.TERMINATE


def _already_as_safe(action: Action, delayed: Action, mode: Mode, flags: Flags) -> bool:
    """Return whether the vehicle is landing by itself, so that ``action`` would be no gain."""
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
    """What the framework has decided.

    Attributes:
        action: what is done.
        delayed: what will be done when COM_FAIL_ACT_T has passed; NONE outside that delay.
        delay: seconds until then.
        cause: why.
        mode: what is to be flown.
        intended: the mode that was asked for, or that the pilot's sticks ask for.
        notify: whether the operator is to be told.
        takeover: a pilot has taken over.
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
        """Whether the vehicle does something else than it was told."""
        return self.action > Action.WARN


class Failsafe:
    """The failsafe framework of one vehicle.

    Attributes:
        outcome: the last decision.
    """

    def __init__(self, get: Get, mode: Mode, changes: Callable[[], int] = int) -> None:
        """Start with nothing wrong.

        Args:
            get: parameter by name.
            mode: the mode that was asked for.
            changes: returns how often a parameter has changed.
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
        self._delay_us = 0.0  # until a delayed action
        self._start_delay_us = self._configured_delay_us()
        self._quiet: tuple[bool, Mode, Flags, int] | None = None  # with this nothing is to be done
        self.outcome = Outcome(Action.NONE, Action.NONE, 0.0, Cause.GENERIC, mode, mode)

    def _configured_delay_us(self) -> float:
        return self._get("COM_FAIL_ACT_T") * 1e6

    def update(
        self, now_us: int, armed: bool, mode: Mode, flags: Flags, *, changed: bool = False, sticks: bool = False
    ) -> Outcome:
        """Decide.

        Args:
            now_us: simulated time, microseconds.
            armed: whether motors run.
            mode: the mode that was asked for.
            flags: what is wrong.
            changed: somebody has asked for a mode since the last call, be it the same one.
            sticks: a pilot moves the sticks and wants to take over.
        """
        key = (armed, mode, flags, self._changes())
        if key == self._quiet and not changed and not sticks:
            self._last_us = now_us
            return self.outcome
        elapsed = 0 if self._last_us is None else now_us - self._last_us
        changed = changed or mode is not self._last_mode
        self._forget(armed, changed)
        situation = self._situation(now_us, armed, mode, flags)
        self._delay_us = max(self._delay_us - elapsed, 0.0)
        added = self._note(triggered(situation, flags, self._get))
        if self.outcome.action > Action.HOLD or self._takeover or not can_run(modes.AUTO_LOITER, flags):
            self._delay_us = 0.0
        outcome = self._select(armed, mode, flags, changed, sticks)
        self._recharge(elapsed, outcome.delayed is not Action.NONE)
        worse = outcome.action > self.outcome.action or (added and outcome.action is not Action.NONE)
        self.outcome = replace(outcome, notify=False)
        self._takeover = outcome.takeover
        self._last_us, self._last_mode = now_us, outcome.intended
        at_rest = not self._active and self._start_delay_us >= self._configured_delay_us()
        self._quiet = key if at_rest and outcome.mode is mode and not sticks else None
        return replace(outcome, notify=worse)

    def _forget(self, armed: bool, changed: bool) -> None:
        """Drop the actions that arming, disarming or a mode change ends, unless their condition still holds."""
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

    def _note(self, found: dict[str, Option]) -> bool:
        """Remember the conditions that hold; return whether the operator has to hear of a new warning."""
        for name, active in list(self._active.items()):
            active.failing = name in found
            if not active.failing and active.option.clear is Clear.AT_ONCE:
                del self._active[name]
        warned = False
        for name, option in found.items():
            if name in self._active:
                # what is done may change with the mode or a parameter, the rest stays
                self._active[name].option = replace(self._active[name].option, action=option.action)
                continue
            self._active[name] = _Active(self._delayed(option))
            warned = warned or option.action is Action.WARN
            if option.action >= Action.HOLD:
                self._takeover = False
        return warned

    def _delayed(self, option: Option) -> Option:
        """Start the delay before what a pilot may prevent, and say how he may."""
        if option.takeover is not Takeover.AUTO:
            return option
        if self._configured_delay_us() <= _SHORTEST_DELAY_US:
            return replace(option, takeover=Takeover.MODE_SWITCH)
        if option.action is not Action.WARN and self._delay_us == 0.0:
            self._delay_us = self._start_delay_us
        return replace(option, takeover=Takeover.ALWAYS)

    def _recharge(self, elapsed: float, delaying: bool) -> None:
        """Let the next delay grow slower than it shrinks, so that a condition that comes and goes acts at last."""
        if delaying:
            self._start_delay_us = max(self._start_delay_us - elapsed, 0.0)
        else:
            self._start_delay_us = min(self._start_delay_us + elapsed / 4, self._configured_delay_us())

    def _select(self, armed: bool, mode: Mode, flags: Flags, changed: bool, sticks: bool) -> Outcome:
        if self.outcome.action is Action.TERMINATE:
            return replace(self.outcome, intended=mode)  # it never ends
        if not armed:
            return Outcome(Action.NONE, Action.NONE, 0.0, Cause.GENERIC, mode, mode)
        action, cause, allowed = self._worst()
        delayed = Action.NONE
        waiting = self._delay_us > 0 and not self._takeover and allowed <= Takeover.MODE_SWITCH
        if waiting and Action.WARN < action < Action.DISARM:
            action, delayed, allowed = Action.HOLD, action, Takeover.MODE_SWITCH
        takeover = self._taken_over(action, allowed, changed, sticks)
        if takeover:
            if sticks and not self._takeover:
                mode = modes.POSCTL
            action, delayed = max(Action.WARN, mode_fallback(mode, flags, self._get)), Action.NONE
        feasible = possible(action, flags)
        if feasible is not action:
            action, cause = feasible, Cause.GENERIC
        if _already_as_safe(action, delayed, mode, flags):
            action, delayed = Action.WARN, Action.NONE
        return Outcome(action, delayed, self._delay_us * 1e-6, cause, _MODES.get(action, mode), mode, takeover=takeover)

    def _worst(self) -> tuple[Action, Cause, Takeover]:
        action, cause, allowed = Action.NONE, Cause.GENERIC, Takeover.ALWAYS
        for active in self._active.values():
            allowed = max(allowed, active.option.takeover)
            if active.option.action > action:
                action, cause = active.option.action, active.option.cause
        return action, cause, allowed

    def _taken_over(self, action: Action, allowed: Takeover, changed: bool, sticks: bool) -> bool:
        if not Action.HOLD <= action <= Action.DESCEND:
            return False  # stick modes need no takeover, and nothing ends the others
        switched = changed and self.outcome.action is action
        if allowed is Takeover.ALWAYS:
            return self._takeover or switched or sticks
        return allowed is Takeover.MODE_SWITCH and (self._takeover or switched)
