"""Failsafe decisions: tables after PX4 v1.14, and laws for all combinations."""

from __future__ import annotations

import itertools

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from xtdrone_autopilot.commander.failsafe import (
    BATTERY_CRITICAL,
    BATTERY_EMERGENCY,
    BATTERY_LOW,
    Action,
    Cause,
    Failsafe,
    Flags,
    Situation,
    can_run,
    mode_fallback,
    possible,
    triggered,
)
from xtdrone_autopilot.parameters.parameters import Parameters
from xtdrone_common import modes

STEP_US = 100_000


def getter(**changes):
    parameters = Parameters()
    for name, value in changes.items():
        parameters.set(name, value)
    return parameters.get


def worst(mode, flags, get, **situation):
    options = triggered(Situation(True, mode, **situation), flags, get)
    action = max((option.action for option in options.values()), default=Action.NONE)
    return possible(action, flags)


class Course:
    """One vehicle's failsafe, evaluated at 10 Hz."""

    def __init__(self, mode=modes.AUTO_LOITER, **parameters):
        self.now_us = 0
        self.mode = mode
        self.failsafe = Failsafe(getter(**parameters), mode)
        self.told = []
        self.step(Flags(), armed=False)
        self.step(Flags())

    def step(self, flags, *, armed=True, mode=None, changed=False, sticks=False):
        self.now_us += STEP_US
        if mode is not None:
            self.mode, changed = mode, True
        outcome = self.failsafe.update(self.now_us, armed, self.mode, flags, changed=changed, sticks=sticks)
        self.mode = outcome.intended
        if outcome.notify:
            self.told.append((outcome.action, outcome.delayed))
        return outcome

    def run(self, seconds, flags):
        for _ in range(round(seconds * 10)):
            outcome = self.step(flags)
        return outcome

    def until(self, mode, flags, limit=20.0):
        """Return the time in s until ``mode`` is active."""
        start_us = self.now_us
        for _ in range(round(limit * 10)):
            if self.step(flags).mode is mode:
                return (self.now_us - start_us) * 1e-6
        raise AssertionError(f"{mode.name} was not flown within {limit} s")


# tables


@pytest.mark.parametrize(
    ("action", "expected"),
    [
        (1, Action.HOLD),
        (2, Action.RETURN),
        (3, Action.LAND),
        (5, Action.TERMINATE),
        (6, Action.DISARM),
        (0, Action.NONE),
    ],
)
@pytest.mark.parametrize(("name", "field"), [("NAV_RCL_ACT", "manual_lost"), ("NAV_DLL_ACT", "gcs_lost")])
def test_link_loss_actions(name, field, action, expected):
    get = getter(**{name: action})
    assert worst(modes.AUTO_MISSION, Flags(**{field: True}), get) == expected


@pytest.mark.parametrize(
    ("mode", "bit"),
    [(modes.AUTO_MISSION, 1), (modes.AUTO_LOITER, 2), (modes.AUTO_TAKEOFF, 2), (modes.OFFBOARD, 4)],
)
def test_modes_that_need_no_manual_control(mode, bit):
    flags = Flags(manual_lost=True)
    assert worst(mode, flags, getter()) == Action.RETURN
    assert worst(mode, flags, getter(COM_RCL_EXCEPT=bit)) == Action.NONE
    assert worst(mode, flags, getter(COM_RCL_EXCEPT=7 & ~bit)) == Action.RETURN


def test_manual_control_that_never_existed_is_not_lost():
    assert worst(modes.AUTO_LOITER, Flags(manual_lost=True), getter(), manual_needed=False) == Action.NONE
    assert worst(modes.AUTO_LOITER, Flags(manual_lost=True), getter(COM_RC_IN_MODE=4)) == Action.NONE


@pytest.mark.parametrize(
    ("action", "expected"),
    [
        (0, Action.NONE),
        (1, Action.WARN),
        (2, Action.HOLD),
        (3, Action.RETURN),
        (4, Action.TERMINATE),
        (5, Action.LAND),
    ],
)
def test_geofence_actions(action, expected):
    assert worst(modes.AUTO_MISSION, Flags(geofence=True), getter(GF_ACTION=action)) == expected


@pytest.mark.parametrize(
    ("action", "expected"),
    [
        (0, (Action.WARN, Action.WARN, Action.WARN)),
        (1, (Action.WARN, Action.RETURN, Action.RETURN)),
        (2, (Action.WARN, Action.LAND, Action.LAND)),
        (3, (Action.WARN, Action.RETURN, Action.LAND)),
    ],
)
def test_battery_actions(action, expected):
    get = getter(COM_LOW_BAT_ACT=action)
    levels = (BATTERY_LOW, BATTERY_CRITICAL, BATTERY_EMERGENCY)
    assert tuple(worst(modes.AUTO_LOITER, Flags(battery=level), get) for level in levels) == expected


@pytest.mark.parametrize(
    ("action", "expected"),
    [(0, Action.WARN), (1, Action.HOLD), (2, Action.LAND), (3, Action.RETURN), (4, Action.TERMINATE)],
)
def test_motor_failure_actions(action, expected):
    assert worst(modes.POSCTL, Flags(motor_failure=True), getter(COM_ACT_FAIL_ACT=action)) == expected


def test_attitude_limit_disarms_at_first_and_then_warns_or_terminates():
    flags = Flags(attitude_failure=True)
    assert worst(modes.POSCTL, flags, getter(), starting=True) == Action.DISARM
    assert worst(modes.POSCTL, flags, getter()) == Action.WARN
    assert worst(modes.POSCTL, flags, getter(CBRK_FLIGHTTERM=0)) == Action.TERMINATE


@pytest.mark.parametrize(
    ("action", "expected"),
    [
        (0, Action.POSCTL),
        (1, Action.ALTCTL),
        (2, Action.STABILIZED),
        (3, Action.RETURN),
        (4, Action.LAND),
        (5, Action.HOLD),
        (6, Action.TERMINATE),
        (7, Action.DISARM),
    ],
)
def test_offboard_loss_actions(action, expected):
    get = getter(COM_OBL_RC_ACT=action)
    assert mode_fallback(modes.OFFBOARD, Flags(offboard_lost=True), get) == expected
    assert mode_fallback(modes.AUTO_LOITER, Flags(offboard_lost=True), get) == Action.NONE


NO_PLACE = {"position_invalid": True, "relaxed_position_invalid": True}


@pytest.mark.parametrize(
    ("mode", "wrong", "navl", "expected"),
    [
        (modes.POSCTL, NO_PLACE, 0, Action.ALTCTL),
        (modes.POSCTL, {**NO_PLACE, "altitude_invalid": True}, 0, Action.STABILIZED),
        (modes.ALTCTL, NO_PLACE, 0, Action.NONE),
        (modes.ALTCTL, {"altitude_invalid": True}, 0, Action.STABILIZED),
        (modes.STABILIZED, {**NO_PLACE, "altitude_invalid": True}, 0, Action.NONE),
        (modes.POSCTL, NO_PLACE, 1, Action.DESCEND),
        (modes.POSCTL, {"position_invalid": True}, 1, Action.NONE),
        (modes.AUTO_LOITER, {"position_invalid": True}, 0, Action.LAND),
        (modes.AUTO_LOITER, NO_PLACE, 0, Action.DESCEND),
        (modes.AUTO_LAND, NO_PLACE, 0, Action.DESCEND),
        (modes.AUTO_RTL, {"home_missing": True}, 0, Action.LAND),
        (modes.AUTO_MISSION, {"mission_missing": True}, 0, Action.RETURN),
        (modes.OFFBOARD, {"offboard_lost": True, **NO_PLACE}, 0, Action.ALTCTL),
        (modes.ACRO, {**NO_PLACE, "altitude_invalid": True, "attitude_invalid": True}, 0, Action.NONE),
        (modes.STABILIZED, {"attitude_invalid": True}, 0, Action.TERMINATE),
    ],
)
def test_fallbacks_of_modes_that_cannot_be_flown(mode, wrong, navl, expected):
    assert worst(mode, Flags(**wrong), getter(COM_POSCTL_NAVL=navl)) == expected


# laws for all of them

BOOLEANS = [name for name, kind in Flags.__annotations__.items() if "bool" in str(kind)]
SOME_FLAGS = st.builds(Flags, **{name: st.booleans() for name in BOOLEANS}, battery=st.integers(0, 3))
MODES = st.sampled_from(modes.SUPPORTED)
# the vehicle's worst-case action; with 7, disarming on offboard loss, PX4 ignores other faults
SETTINGS = st.fixed_dictionaries(
    {
        "NAV_RCL_ACT": st.sampled_from([1, 2, 3, 5, 6]),
        "NAV_DLL_ACT": st.sampled_from([0, 1, 2, 3, 5, 6]),
        "GF_ACTION": st.integers(0, 5),
        "COM_LOW_BAT_ACT": st.integers(0, 3),
        "COM_ACT_FAIL_ACT": st.integers(0, 4),
        "COM_OBL_RC_ACT": st.integers(0, 6),
        "COM_POSCTL_NAVL": st.integers(0, 1),
        "CBRK_FLIGHTTERM": st.sampled_from([0, 121212]),
    }
)


def joined(first, second):
    return Flags(*(max(a, b) for a, b in zip(first, second, strict=True)))


@settings(max_examples=300, deadline=None, derandomize=True)
@given(MODES, SOME_FLAGS, SOME_FLAGS, SETTINGS, st.booleans())
def test_more_that_is_wrong_is_never_answered_by_less(mode, flags, more, parameters, starting):
    """An additional fault never weakens the action, except that PX4 chooses disarming shortly after takeoff."""
    get = getter(**parameters)
    both = joined(flags, more)
    less, all_of_it = worst(mode, flags, get, starting=starting), worst(mode, both, get, starting=starting)
    assert all_of_it >= less or all_of_it is Action.DISARM


@settings(max_examples=300, deadline=None, derandomize=True)
@given(MODES, SOME_FLAGS, SETTINGS, st.booleans())
def test_every_flown_plan_is_feasible(mode, flags, parameters, sticks):
    course = Course(mode, **parameters)
    for _ in range(3):
        outcome = course.step(flags, sticks=sticks)
    assert can_run(outcome.mode, flags) or outcome.mode is modes.TERMINATION or outcome.action is Action.DISARM


@settings(max_examples=200, deadline=None, derandomize=True)
@given(MODES, st.lists(SOME_FLAGS, min_size=1, max_size=8), SETTINGS)
def test_termination_never_ends(mode, flights, parameters):
    course = Course(mode, **parameters)
    seen = False
    for flags in (*flights, Flags()):
        outcome = course.step(flags)
        assert not seen or outcome.action is Action.TERMINATE
        seen = outcome.action is Action.TERMINATE


@settings(max_examples=200, deadline=None, derandomize=True)
@given(MODES, SOME_FLAGS, SETTINGS)
def test_disarmed_nothing_is_done(mode, flags, parameters):
    failsafe = Failsafe(getter(**parameters), mode)
    for tick in range(1, 4):
        outcome = failsafe.update(tick * STEP_US, False, mode, flags)
        assert (outcome.action, outcome.mode) == (Action.NONE, mode)


@settings(max_examples=200, deadline=None, derandomize=True)
@given(MODES, SOME_FLAGS, SETTINGS)
def test_nothing_is_left_when_all_is_well_and_a_mode_is_chosen(mode, flags, parameters):
    course = Course(mode, **parameters)
    course.run(7.0, flags)
    if course.failsafe.outcome.action is Action.TERMINATE:
        return
    course.step(Flags())
    outcome = course.step(Flags(), mode=modes.AUTO_LOITER)
    outcome = course.run(0.3, Flags())
    assert (outcome.action, outcome.mode) == (Action.NONE, modes.AUTO_LOITER)


# memory


def test_a_pilot_has_com_fail_act_t_before_the_vehicle_returns():
    course = Course(modes.POSCTL)
    lost = Flags(manual_lost=True)
    outcome = course.step(lost)
    assert (outcome.mode, outcome.delayed, outcome.cause) == (
        modes.AUTO_LOITER,
        Action.RETURN,
        Cause.MANUAL_CONTROL_LOSS,
    )
    assert round(outcome.delay) == 5
    assert course.until(modes.AUTO_RTL, lost) == pytest.approx(5.0, abs=0.11)
    assert course.told == [(Action.HOLD, Action.RETURN), (Action.RETURN, Action.NONE)]


def test_without_a_delay_it_returns_at_once():
    course = Course(modes.POSCTL, COM_FAIL_ACT_T=0.0)
    assert course.step(Flags(manual_lost=True)).mode is modes.AUTO_RTL


def test_a_delayed_failsafe_ends_only_with_a_mode_change():
    course = Course(modes.POSCTL)
    course.run(6.0, Flags(manual_lost=True))
    assert course.run(2.0, Flags()).mode is modes.AUTO_RTL
    assert course.step(Flags(), mode=modes.POSCTL).mode is modes.POSCTL
    assert course.failsafe.outcome.action is Action.NONE


def test_a_mode_change_overrides_a_failsafe_in_its_hold_delay():
    course = Course(modes.AUTO_MISSION, NAV_DLL_ACT=2)
    lost = Flags(gcs_lost=True)
    course.run(6.0, lost)
    outcome = course.step(lost, mode=modes.AUTO_LOITER)
    assert (outcome.mode, outcome.action, outcome.takeover) == (modes.AUTO_LOITER, Action.WARN, True)
    assert course.run(3.0, lost).mode is modes.AUTO_LOITER


def test_sticks_take_over_by_position_control():
    course = Course(modes.AUTO_MISSION, NAV_DLL_ACT=2)
    lost = Flags(gcs_lost=True)
    course.run(6.0, lost)
    outcome = course.step(lost, sticks=True)
    assert (outcome.mode, outcome.intended, outcome.takeover) == (modes.POSCTL, modes.POSCTL, True)
    assert course.run(3.0, lost).mode is modes.POSCTL


def test_sticks_do_not_leave_a_geofence_failsafe_but_a_mode_change_does():
    course = Course(modes.AUTO_MISSION)
    breached = Flags(geofence=True)
    assert course.step(breached).mode is modes.AUTO_LOITER
    assert course.step(breached, sticks=True).mode is modes.AUTO_LOITER
    assert course.step(breached, mode=modes.POSCTL).mode is modes.POSCTL


def test_a_worse_failsafe_ends_a_takeover():
    course = Course(modes.AUTO_MISSION, NAV_DLL_ACT=2)
    course.run(6.0, Flags(gcs_lost=True))
    course.step(Flags(gcs_lost=True), mode=modes.POSCTL)
    course.run(20.0, Flags(gcs_lost=True))  # the delay has recovered
    both = Flags(gcs_lost=True, battery=BATTERY_CRITICAL)
    assert course.step(both).mode is modes.AUTO_LOITER
    assert course.until(modes.AUTO_LAND, both, 6.0) == pytest.approx(5.0, abs=0.2)


def test_a_landing_vehicle_does_not_climb_to_return():
    course = Course(modes.AUTO_LAND, NAV_RCL_ACT=2)
    outcome = course.run(6.0, Flags(manual_lost=True))
    assert (outcome.mode, outcome.action) == (modes.AUTO_LAND, Action.WARN)


def test_an_intermittent_condition_acts_eventually():
    """With a loss of 0.75 s in every second, the delay runs down faster than it recovers."""
    course = Course(modes.POSCTL, NAV_RCL_ACT=3)
    for flags in itertools.islice(itertools.cycle([Flags(manual_lost=True)] * 8 + [Flags()] * 2), 120):
        course.step(flags)
    assert course.failsafe.outcome.action is Action.LAND


def test_a_low_battery_warns_once():
    course = Course()
    course.run(3.0, Flags(battery=BATTERY_LOW))
    assert course.told == [(Action.WARN, Action.NONE)]
    assert course.failsafe.outcome.mode is modes.AUTO_LOITER
