"""Manual control: the selected source, scaling of a radio's channels, gestures, switches, taking over."""

from __future__ import annotations

import math

import pytest
from autopilot_fakes import Flight
from hypothesis import given, settings
from hypothesis import strategies as st

from xtdrone_autopilot.commander.manual_control import CENTRED, ManualControl, Sticks, channel_count, mode_slot
from xtdrone_autopilot.commander.offboard_setpoint import SetpointError
from xtdrone_autopilot.parameters.parameters import Parameters
from xtdrone_autopilot.state import FAILURE_OFF, TASK_ACRO, TASK_ALTITUDE, TASK_MANUAL, TASK_STICKS
from xtdrone_common import modes

UNUSED = 0xFFFF
MAPPED = {"RC_MAP_ROLL": 1, "RC_MAP_PITCH": 2, "RC_MAP_THROTTLE": 3, "RC_MAP_YAW": 4}
MIDDLE = (1500,) * 8
BY_RADIO = {**MAPPED, "COM_RC_IN_MODE": 0}
STEP_US = 100_000
THROTTLE_DOWN = -1.0


def pilot(**changes):
    parameters = Parameters()
    for name, value in changes.items():
        parameters.set(name, value)
    return ManualControl(parameters.get)


def channels(*pulses):
    return (*pulses, *[UNUSED] * (18 - len(pulses)))


# selected source


@pytest.mark.parametrize(
    ("mode", "radio", "joystick"),
    [(0, True, False), (1, False, True), (2, True, True), (3, True, True), (4, False, False)],
)
def test_sources(mode, radio, joystick):
    by_radio, by_joystick = (pilot(COM_RC_IN_MODE=mode, **MAPPED) for _ in range(2))
    by_radio.radio(channels(*MIDDLE), 1_000_000)
    by_joystick.joystick(CENTRED, 1_000_000)
    for manual, expected in ((by_radio, radio), (by_joystick, joystick)):
        manual.update(1_000_000)
        assert (manual.sticks is not None) is expected


def test_the_other_source_takes_over_if_allowed():
    for mode, other in ((2, True), (3, False)):
        manual = pilot(COM_RC_IN_MODE=mode, **MAPPED)
        manual.radio(channels(*MIDDLE), 1_000_000)
        manual.joystick(Sticks(0.5, 0.0, 0.0, 0.0), 1_100_000)
        manual.update(1_100_000)
        assert manual.sticks == CENTRED, "the radio was first"
        manual.joystick(Sticks(0.5, 0.0, 0.0, 0.0), 1_600_000)
        manual.update(1_700_000)
        assert (manual.sticks == (0.5, 0.0, 0.0, 0.0)) is other


def test_silence_is_loss():
    manual = pilot()
    manual.joystick(CENTRED, 1_000_000)
    manual.update(1_500_000)
    assert manual.sticks is not None
    manual.update(1_504_000)
    assert manual.sticks is None


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_sticks_that_are_no_numbers(value):
    with pytest.raises(SetpointError):
        pilot().joystick(Sticks(0.0, value, 0.0, 0.0), 0)


# channels


@pytest.mark.parametrize(
    ("pulse", "value"),
    [(1000, -1.0), (900, -1.0), (2000, 1.0), (2300, 1.0), (1500, 0.0), (1510, 0.0), (1490, 0.0), (1755, 0.5)],
)
def test_scaling_past_the_dead_zone(pulse, value):
    manual = pilot(**BY_RADIO)
    manual.radio(channels(1500, pulse, 1500, 1500), 1_000_000)
    manual.update(1_000_000)
    assert manual.sticks.x == pytest.approx(value)


def test_reversed_channel_and_other_ends():
    manual = pilot(RC1_REV=-1.0, RC3_MIN=1100.0, RC3_TRIM=1100.0, **BY_RADIO)
    manual.radio(channels(2000, 1500, 1100, 1500), 1_000_000)
    manual.update(1_000_000)
    assert manual.sticks == (0.0, -1.0, 0.0, 0.0)


def test_a_radio_without_a_stick_is_invalid():
    manual = pilot(COM_RC_IN_MODE=0, RC_MAP_ROLL=1, RC_MAP_PITCH=2, RC_MAP_YAW=4)
    manual.radio(channels(*MIDDLE), 1_000_000)
    manual.update(1_000_000)
    assert manual.sticks is None
    manual = pilot(**{**BY_RADIO, "RC_MAP_YAW": 9})
    manual.radio(channels(*MIDDLE), 1_000_000)
    manual.update(1_000_000)
    assert manual.sticks is None, "the yaw channel is left out"


@pytest.mark.parametrize(
    ("pulses", "count"),
    [
        ([UNUSED] * 18, 0),
        ([1500] * 4 + [UNUSED] * 14, 4),
        ([1500] * 8 + [0] * 10, 8),
        ([0] * 8 + [UNUSED] * 10, 8),
        ([1500] * 8 + [0, 1500] + [UNUSED] * 8, 10),
    ],
)
def test_channels_omitted(pulses, count):
    assert channel_count(pulses) == count


def test_a_released_override_is_silence():
    manual = pilot(**BY_RADIO)
    manual.radio(channels(*MIDDLE), 1_000_000)
    manual.radio(channels(), 1_600_000)
    manual.update(1_700_000)
    assert manual.sticks is None


@settings(max_examples=300, deadline=None, derandomize=True)
@given(st.lists(st.integers(0, 65535), min_size=18, max_size=18), st.integers(0, 4))
def test_any_channels_give_sticks_in_range(pulses, mode):
    manual = pilot(**{**MAPPED, "COM_RC_IN_MODE": mode, "RC_MAP_FLTMODE": 5, "RC_MAP_KILL_SW": 6})
    manual.radio(pulses, 1_000_000)
    manual.update(1_000_000)
    assert manual.sticks is None or all(-1.0 <= value <= 1.0 for value in manual.sticks)


def test_slots_of_the_mode_switch():
    slots = [mode_slot(-1.0 + 0.4 * place) for place in range(6)]
    assert slots == [1, 2, 3, 4, 5, 6]
    assert [mode_slot(value) for value in (-1.0, 1.0)] == [1, 6]


# the pilot's setpoints


class Piloted:
    """A fake flight with a pilot at the sticks."""

    def __init__(self, **parameters):
        self.flight = Flight(**parameters)
        self.commander = self.flight.commander
        self.sticks = Sticks(0.0, 0.0, THROTTLE_DOWN, 0.0)
        self.pulses = None

    def run(self, seconds):
        self.flight.run(seconds, self.give)

    def give(self):
        if self.pulses is not None:
            self.commander.radio_control(channels(*self.pulses))
        else:
            self.commander.manual_control(*self.sticks)

    def armed_in(self, mode):
        self.run(0.2)
        self.commander.request(mode)
        assert self.commander.arm_disarm(True) == 0
        self.flight.texts()


def test_the_first_pilot_gets_position_control():
    piloted = Piloted()
    piloted.run(0.2)
    assert piloted.commander.mode is modes.POSCTL
    chosen = Piloted()
    chosen.commander.request(modes.AUTO_LOITER)
    chosen.run(0.2)
    assert chosen.commander.mode is modes.AUTO_LOITER


def test_arming_and_disarming_by_gesture():
    piloted = Piloted()
    piloted.run(0.2)
    piloted.sticks = Sticks(0.0, 0.0, THROTTLE_DOWN, 1.0)
    piloted.run(0.9)
    assert not piloted.commander.armed
    piloted.run(0.3)
    assert piloted.commander.armed
    assert "Armed by RC" in piloted.flight.texts()
    piloted.run(2.0)
    assert piloted.commander.armed
    piloted.sticks = Sticks(0.0, 0.0, THROTTLE_DOWN, -1.0)
    piloted.run(1.2)
    assert not piloted.commander.armed
    assert piloted.flight.texts() == ["Disarmed by RC"]


def test_the_gesture_can_be_switched_off():
    piloted = Piloted(MAN_ARM_GESTURE=0)
    piloted.sticks = Sticks(0.0, 0.0, THROTTLE_DOWN, 1.0)
    piloted.run(2.0)
    assert not piloted.commander.armed


def test_a_gesture_neither_arms_in_auto_modes_nor_disarms_in_the_air():
    piloted = Piloted()
    piloted.commander.request(modes.AUTO_LOITER)
    piloted.sticks = Sticks(0.0, 0.0, THROTTLE_DOWN, 1.0)
    piloted.run(1.2)
    assert piloted.flight.texts() == ["Arming denied: switch to manual mode first"]
    piloted.sticks = Sticks(0.0, 0.0, THROTTLE_DOWN, 0.0)
    piloted.armed_in(modes.POSCTL)
    piloted.flight.place(0.0, 0.0, -5.0)
    piloted.sticks = Sticks(0.0, 0.0, THROTTLE_DOWN, -1.0)
    piloted.run(1.5)
    assert piloted.commander.armed
    assert "Disarming denied! Not landed" not in piloted.flight.texts()


@pytest.mark.parametrize(
    ("mode", "throttle", "text"),
    [
        (modes.POSCTL, 0.5, "Arming denied: throttle above center"),
        (modes.STABILIZED, -0.5, "Arming denied: high throttle"),
    ],
)
def test_arming_looks_at_the_throttle(mode, throttle, text):
    piloted = Piloted()
    piloted.sticks = Sticks(0.0, 0.0, throttle, 0.0)
    piloted.run(0.2)
    piloted.commander.request(mode)
    assert piloted.commander.arm_disarm(True) == 1
    assert piloted.flight.texts() == [text]


@pytest.mark.parametrize(
    ("mode", "task", "shaped"),
    [
        (modes.POSCTL, TASK_STICKS, True),
        (modes.ALTCTL, TASK_ALTITUDE, True),
        (modes.STABILIZED, TASK_MANUAL, False),
        (modes.MANUAL, TASK_MANUAL, False),
        (modes.ACRO, TASK_ACRO, False),
    ],
)
def test_tasks_of_the_stick_modes(mode, task, shaped):
    piloted = Piloted()
    piloted.armed_in(mode)
    s = piloted.flight.setpoint
    piloted.sticks = Sticks(0.05, 1.0, THROTTLE_DOWN, -0.5)
    piloted.run(0.1)
    assert s["task"] == task
    assert s["stick_y"] == 1.0
    assert s["stick_x"] == (0.0 if mode is modes.POSCTL else 0.05)  # the tilt is proportional to the stick
    assert (s["stick_yaw"] == -0.5) is not shaped


def test_moved_sticks_end_auto_flight_but_not_offboard():
    for mode, bits, ends in (
        (modes.AUTO_LOITER, 1, True),
        (modes.AUTO_LOITER, 2, False),
        (modes.OFFBOARD, 1, False),
        (modes.OFFBOARD, 3, True),
    ):
        piloted = Piloted(COM_RC_OVERRIDE=bits)
        piloted.sticks = CENTRED
        piloted.flight.hover()
        piloted.armed_in(mode)
        piloted.flight.place(0.0, 0.0, -5.0)
        piloted.run(1.0) if mode is modes.AUTO_LOITER else None
        piloted.flight.hover()
        piloted.flight.texts()
        piloted.sticks = Sticks(0.2, 0.0, 0.0, 0.0)
        piloted.run(0.1)
        assert piloted.commander.mode is mode, "20 % are too little"
        piloted.sticks = Sticks(0.7, 0.0, 0.0, 0.0)
        piloted.flight.hover()
        piloted.run(0.2)
        assert (piloted.commander.mode is modes.POSCTL) is ends
        assert ("Pilot took over using sticks" in piloted.flight.texts()) is ends


def test_loss_of_the_pilot_returns_after_com_fail_act_t():
    piloted = Piloted()
    piloted.sticks = CENTRED
    piloted.armed_in(modes.POSCTL)
    piloted.flight.place(10.0, 0.0, -5.0)
    piloted.run(1.0)
    piloted.flight.texts()
    flight, seconds = piloted.flight, 0.0
    while piloted.commander.mode is modes.POSCTL:
        flight.run(0.1)
        seconds += 0.1
    assert seconds == pytest.approx(0.5, abs=0.2), "COM_RC_LOSS_T"
    assert flight.texts() == ["Manual control lost", "Failsafe activated, entering Hold for 5 seconds"]
    assert piloted.commander.mode is modes.AUTO_LOITER
    while piloted.commander.mode is modes.AUTO_LOITER:
        flight.run(0.1)
        seconds += 0.1
    assert seconds == pytest.approx(5.5, abs=0.2)
    assert piloted.commander.mode is modes.AUTO_RTL
    assert flight.texts()[:2] == ["Failsafe activated", "RTL HOME activated"]


def test_a_failed_receiver_is_loss_at_once():
    piloted = Piloted(**BY_RADIO)
    piloted.pulses = MIDDLE
    piloted.armed_in(modes.POSCTL)
    piloted.flight.place(10.0, 0.0, -5.0)
    piloted.run(0.5)
    piloted.flight.autopilot.failures["rc_signal"] = FAILURE_OFF
    piloted.run(0.2)
    assert piloted.commander.failsafe


# switches


def test_mode_switch():
    piloted = Piloted(RC_MAP_FLTMODE=5, COM_FLTMODE1=1, COM_FLTMODE6=4, **BY_RADIO)
    piloted.pulses = (1500, 1500, 1000, 1500, 1000)
    piloted.run(0.2)
    assert piloted.commander.mode is modes.ALTCTL, "what the switch says when the radio comes"
    piloted.pulses = (1500, 1500, 1000, 1500, 2000)
    piloted.run(0.2)
    assert piloted.commander.mode is modes.AUTO_LOITER
    piloted.commander.request(modes.POSCTL)
    piloted.run(0.5)
    assert piloted.commander.mode is modes.POSCTL, "it acts when it is moved"


def test_return_switch_goes_back_to_the_mode_switch():
    piloted = Piloted(RC_MAP_FLTMODE=5, COM_FLTMODE1=2, RC_MAP_RETURN_SW=6, **BY_RADIO)
    piloted.pulses = (1500, 1500, 1000, 1500, 1000, 1000)
    piloted.armed_in(modes.POSCTL)
    piloted.flight.place(10.0, 0.0, -5.0)
    piloted.pulses = (1500, 1500, 1500, 1500, 1000, 1000)
    piloted.run(1.5)  # so that the raised throttle no longer counts as taking over
    piloted.pulses = (1500, 1500, 1500, 1500, 1000, 2000)
    piloted.run(0.2)
    assert piloted.commander.mode is modes.AUTO_RTL
    piloted.pulses = (1500, 1500, 1500, 1500, 1000, 1000)
    piloted.run(0.2)
    assert piloted.commander.mode is modes.POSCTL


@pytest.mark.parametrize("button", [0, 1])
def test_arming_switch_and_button(button):
    piloted = Piloted(RC_MAP_ARM_SW=5, COM_ARM_SWISBTN=button, **BY_RADIO)
    off, on = (1500, 1500, 1000, 1500, 1000), (1500, 1500, 1000, 1500, 2000)
    piloted.pulses = off
    piloted.run(0.2)
    piloted.pulses = on
    piloted.run(0.2)
    assert piloted.commander.armed
    piloted.pulses = off
    piloted.run(0.2)
    assert piloted.commander.armed is bool(button)
    piloted.pulses = on
    piloted.run(0.2)
    assert piloted.commander.armed is not bool(button)


def test_kill_switch_stops_the_motors_and_disarms_after_five_seconds():
    piloted = Piloted(RC_MAP_KILL_SW=5, **BY_RADIO)
    run, kill = (1500, 1500, 1000, 1500, 1000), (1500, 1500, 1000, 1500, 2000)
    piloted.pulses = run
    piloted.armed_in(modes.POSCTL)
    piloted.flight.place(0.0, 0.0, -5.0)
    piloted.run(0.1)
    piloted.flight.texts()
    piloted.pulses = kill
    piloted.run(0.1)
    assert piloted.flight.setpoint["armed"] == 0
    assert (piloted.commander.armed, piloted.commander.system_status) == (True, 8)
    assert piloted.flight.texts() == ["Kill engaged"]
    piloted.pulses = run
    piloted.run(0.1)
    assert piloted.flight.setpoint["armed"] == 1
    assert piloted.flight.texts() == ["Kill disengaged"]
    piloted.pulses = kill
    piloted.run(4.9)
    assert piloted.commander.armed
    piloted.run(0.3)
    assert not piloted.commander.armed
    assert piloted.flight.texts() == ["Kill engaged", "Disarmed by kill switch"]
