"""Arming, modes, failsafes and home position, after the behaviour of PX4 v1.14.3."""

from __future__ import annotations

import math
from types import SimpleNamespace

import pytest
from autopilot_fakes import ORIGIN, Flight

from xtdrone_autopilot.commander.commander import Result
from xtdrone_autopilot.commander.failsafe import Action
from xtdrone_autopilot.commander.offboard_setpoint import SetpointError
from xtdrone_autopilot.mavlink.commands.setpoint_conversion import local_target
from xtdrone_autopilot.state import (
    TASK_ATTITUDE,
    TASK_DESCEND,
    TASK_GOTO,
    TASK_IDLE,
    TASK_LAND,
    TASK_RATES,
    TASK_STICKS,
    TASK_TRAJECTORY,
)
from xtdrone_common import modes

_NAN3 = (math.nan,) * 3


@pytest.fixture
def flight():
    return Flight()


def fly_offboard(flight):
    """Hover in OFFBOARD at (1, 2, -3)."""
    flight.hover()
    assert flight.commander.request(modes.OFFBOARD) is Result.ACCEPTED
    assert flight.commander.arm_disarm(True) is Result.ACCEPTED
    flight.place(1.0, 2.0, -3.0)
    flight.run(0.5, flight.hover)
    flight.texts()


def test_heartbeat_fields_are_px4s(flight):
    c = flight.commander
    assert (c.base_mode, c.custom_mode, c.system_status) == (29, 50593792, 3)
    c.arm_disarm(True)
    assert (c.base_mode, c.custom_mode, c.system_status) == (157, 50593792, 4)
    flight.hover()
    c.request(modes.OFFBOARD)
    assert (c.base_mode, c.custom_mode) == (145, 393216)


def test_disarmed_every_mode_can_be_chosen(flight):
    for mode in modes.SUPPORTED:
        assert flight.commander.set_mode(1, mode.custom_mode) is Result.ACCEPTED, mode.name
        assert flight.commander.custom_mode == mode.custom_mode


def test_an_unknown_sub_mode_of_auto_is_rejected(flight):
    assert flight.commander.set_mode(1, 4 << 16 | 1 << 24) is Result.TEMPORARILY_REJECTED  # AUTO.READY
    assert flight.texts() == ["Unsupported auto mode"]
    assert flight.commander.mode is modes.AUTO_LOITER


@pytest.mark.parametrize("mode", [modes.MANUAL, modes.ALTCTL, modes.POSCTL, modes.ACRO, modes.OFFBOARD])
def test_sub_modes_exist_in_auto_only(flight, mode):
    """PX4 v1.14's DO_SET_MODE (3, 1), the number of ORBIT, selects POSCTL."""
    assert flight.commander.set_mode(1, mode.custom_mode | 1 << 24) is Result.ACCEPTED
    assert flight.commander.mode is mode


def test_an_unknown_main_mode_is_acknowledged_and_changes_nothing(flight):
    assert flight.commander.set_mode(1, 99 << 16) is Result.ACCEPTED
    for base_mode in (0, 8, 16):  # without AUTO and MANUAL_INPUT
        assert flight.commander.set_mode(base_mode, 0) is Result.ACCEPTED
    assert flight.commander.mode is modes.AUTO_LOITER


def test_base_mode_of_manual(flight):
    flight.commander.request(modes.MANUAL)
    assert flight.commander.base_mode == 81


@pytest.mark.parametrize(
    ("base_mode", "mode"),
    [(4, modes.AUTO_MISSION), (64, modes.MANUAL), (64 | 16, modes.STABILIZED), (64 | 16 | 8, modes.POSCTL)],
)
def test_mode_by_base_mode_alone(flight, base_mode, mode):
    assert flight.commander.set_mode(base_mode, 0) is Result.ACCEPTED
    assert flight.commander.mode is mode


@pytest.mark.parametrize(
    "mode",
    [
        modes.MANUAL,
        modes.ALTCTL,
        modes.POSCTL,
        modes.ACRO,
        modes.STABILIZED,
        modes.OFFBOARD,
        modes.AUTO_RTL,
        modes.AUTO_LAND,
        modes.AUTO_MISSION,
    ],
)
def test_modes_not_for_arming(flight, mode):
    """PX4 v1.14.3 rejects arming in these modes without pilot, setpoints and mission; the reason is in events only."""
    assert flight.commander.request(mode) is Result.ACCEPTED
    flight.run(0.1)
    flight.texts()
    flight.commander.events.clear()
    assert flight.commander.arm_disarm(True) is Result.TEMPORARILY_REJECTED
    assert not flight.commander.armed
    assert flight.texts() == []
    reason = {
        modes.OFFBOARD: "check_modes_offboard_signal",
        modes.AUTO_RTL: "check_modes_cannot_takeoff",
        modes.AUTO_LAND: "check_modes_cannot_takeoff",
        modes.AUTO_MISSION: "check_modes_mission",
    }.get(mode, "check_modes_manual_control")
    names = [event.name for event in flight.commander.events]
    assert names[0] == "commander_arming_check_summary"
    assert reason in names


@pytest.mark.parametrize("mode", [modes.AUTO_LOITER, modes.AUTO_TAKEOFF])
def test_modes_for_arming(flight, mode):
    flight.commander.request(mode)
    assert flight.commander.arm_disarm(True) is Result.ACCEPTED
    assert flight.setpoint["armed"] == 1
    assert "Armed by external command" in flight.texts()


def test_arming_twice_is_accepted(flight):
    flight.commander.arm_disarm(True)
    assert flight.commander.arm_disarm(True) is Result.ACCEPTED


def test_rearming_in_the_air_skips_checks_for_five_seconds(flight):
    fly_offboard(flight)
    flight.commander.arm_disarm(False, force=True)
    flight.run(1.5)  # the setpoints are too old for OFFBOARD
    assert flight.commander.arm_disarm(True) is Result.ACCEPTED
    flight.commander.arm_disarm(False, force=True)
    flight.run(5.1)
    assert flight.commander.arm_disarm(True) is Result.TEMPORARILY_REJECTED


@pytest.mark.parametrize("field", ["initialised", "position_valid", "altitude_valid"])
def test_arming_needs_an_estimate(flight, field):
    flight.autopilot.estimator[field] = 0
    assert flight.commander.arm_disarm(True) is Result.TEMPORARILY_REJECTED
    assert not flight.commander.armed


@pytest.mark.parametrize(
    ("field", "least", "name"),
    [
        ("vel", 0.25, "check_estimator_vel_not_stable"),  # squares of COM_ARM_EKF_*
        ("pos", 0.25, "check_estimator_pos_not_stable"),
        ("hgt", 1.0, "check_estimator_hgt_not_stable"),
        ("mag", 0.25, "check_estimator_heading_not_stable"),
    ],
)
def test_arming_needs_small_innovations(flight, field, least, name):
    for value, result in ((0.98 * least, Result.ACCEPTED), (1.02 * least, Result.TEMPORARILY_REJECTED)):
        flight.autopilot.estimator["test_ratio"][field] = value
        flight.run(10.0)
        flight.commander.events.clear()
        assert flight.commander.arm_disarm(True) is result
        flight.commander.arm_disarm(False)
    assert name in [event.name for event in flight.commander.events]


@pytest.mark.parametrize(("needed", "result"), [(1, Result.ACCEPTED), (0, Result.TEMPORARILY_REJECTED)])
def test_arming_without_a_gps_fix(needed, result):
    flight = Flight(COM_ARM_WO_GPS=needed)
    flight.autopilot.sensors["gps_fix"] = 0
    assert flight.commander.arm_disarm(True) is result


def test_arming_may_need_a_mission():
    flight = Flight(COM_ARM_MIS_REQ=1)
    assert flight.commander.arm_disarm(True) is Result.TEMPORARILY_REJECTED
    assert flight.commander.arming_denial() == "No valid mission available"


def test_force_does_not_arm_without_an_attitude(flight):
    flight.autopilot.estimator["initialised"] = 0
    assert flight.commander.arm_disarm(True, force=True) is Result.TEMPORARILY_REJECTED
    assert flight.commander.system_status == 0


def test_disarming_in_the_air_needs_force(flight):
    fly_offboard(flight)
    assert flight.commander.arm_disarm(False) is Result.TEMPORARILY_REJECTED
    assert flight.texts() == ["Disarming denied! Not landed"]
    assert flight.setpoint["armed"] == 1
    assert flight.commander.arm_disarm(False, force=True) is Result.ACCEPTED
    assert flight.setpoint["armed"] == 0


def test_disarms_when_unused(flight):
    flight.commander.arm_disarm(True)
    flight.run(9.8)
    assert flight.commander.armed
    flight.run(0.3)
    assert not flight.commander.armed


def test_armed_loiter_remains_on_the_ground(flight):
    flight.commander.arm_disarm(True)
    flight.run(1.0)
    assert flight.setpoint["task"] == TASK_IDLE


def test_disarms_two_seconds_after_landing(flight):
    fly_offboard(flight)
    assert flight.commander.request(modes.AUTO_LAND) is Result.ACCEPTED
    assert flight.setpoint["task"] == TASK_LAND
    assert flight.commander.landed_state == 4
    flight.place(1.0, 2.0, 0.0)
    flight.run(1.9)
    assert flight.commander.armed
    flight.run(0.3)
    assert not flight.commander.armed
    assert flight.commander.mode is modes.OFFBOARD, "the last mode that can be armed in"
    assert flight.texts() == ["Landing detected", "Disarmed by landing"]


def test_landing_and_returning_end_in_the_mode_before(flight):
    flight.commander.arm_disarm(True)
    flight.place(0.0, 0.0, -5.0)
    flight.run(0.2)
    for mode in (modes.AUTO_RTL, modes.AUTO_LAND):
        flight.commander.request(mode)
    flight.place(0.0, 0.0, 0.0)
    flight.run(2.3)
    assert not flight.commander.armed
    assert flight.commander.mode is modes.AUTO_LOITER


def test_offboard_needs_a_stream_in_flight(flight):
    flight.commander.arm_disarm(True)
    flight.place(0.0, 0.0, -5.0)
    flight.texts()
    assert flight.commander.request(modes.OFFBOARD) is Result.TEMPORARILY_REJECTED
    assert flight.texts()[0] == "Switching to OFFBOARD is currently not available"
    assert flight.commander.mode is modes.AUTO_LOITER
    flight.hover()
    assert flight.commander.request(modes.OFFBOARD) is Result.ACCEPTED
    assert flight.setpoint["task"] == TASK_TRAJECTORY


def test_offboard_writes_setpoints(flight):
    fly_offboard(flight)
    s = flight.setpoint
    assert s["position"].tolist() == [1.0, 2.0, -3.0]
    assert all(math.isnan(v) for v in s["velocity"])
    assert s["yaw"] == 0.0
    assert math.isnan(s["yaw_rate"])
    flight.commander.offboard.set_attitude((2.0, 0.0, 0.0, 0.0), math.nan, 1.5)
    assert s["task"] == TASK_ATTITUDE
    assert s["attitude_q"].tolist() == [1.0, 0.0, 0.0, 0.0]
    assert s["thrust"] == 1.0
    flight.commander.offboard.set_rates((0.1, 0.2, 0.3), 0.5)
    assert s["task"] == TASK_RATES
    assert s["rates"].tolist() == [0.1, 0.2, 0.3]


def test_setpoints_wait_for_offboard(flight):
    flight.hover()
    assert flight.setpoint["task"] == TASK_IDLE
    assert flight.setpoint["position"].tolist() == [0.0, 0.0, 0.0]


@pytest.mark.parametrize(
    "give",
    [
        lambda c: c.offboard.set_trajectory(_NAN3, _NAN3, _NAN3, 0.0, 0.0),
        lambda c: c.offboard.set_attitude((0.0, 0.0, 0.0, 0.0), 0.0, 0.5),
        lambda c: c.offboard.set_attitude((math.nan, 0.0, 0.0, 1.0), 0.0, 0.5),
        lambda c: c.manual_control(0.0, math.nan, 0.0, 0.0),
    ],
)
def test_bad_setpoints_neither_act_nor_feed_the_watchdog(flight, give):
    fly_offboard(flight)
    before = str(flight.setpoint)

    def offend():
        with pytest.raises(SetpointError):
            give(flight.commander)

    flight.run(0.9, offend)
    assert str(flight.setpoint) == before
    flight.run(0.3, offend)
    assert flight.commander.failsafe


def test_offboard_loss_sinks_as_px4_does_and_disarms(flight):
    fly_offboard(flight)
    flight.run(0.9)
    assert not flight.commander.failsafe
    flight.run(0.2)
    c = flight.commander
    assert flight.texts()[0] == "Failsafe activated"
    assert (c.base_mode, c.custom_mode, c.system_status) == (209, 196608, 5)
    s = flight.setpoint
    assert s["task"] == TASK_TRAJECTORY
    assert s["velocity"].tolist() == [0.0, 0.0, pytest.approx(0.7)]
    assert all(math.isnan(v) for v in s["position"])
    flight.place(1.0, 2.0, 0.0)
    flight.run(2.3)
    assert not c.armed
    assert (c.mode, c.system_status) == (modes.OFFBOARD, 3)


def test_offboard_returns_with_its_stream(flight):
    fly_offboard(flight)
    flight.run(1.2)
    flight.run(0.1, flight.hover)
    assert flight.commander.failsafe, "one setpoint is no stream"
    flight.run(0.1, flight.hover)
    assert flight.commander.mode is modes.OFFBOARD
    assert flight.setpoint["position"].tolist() == [1.0, 2.0, -3.0]
    assert flight.commander.system_status == 4


def test_a_stream_does_not_lift_a_vehicle_that_the_failsafe_has_landed(flight):
    fly_offboard(flight)
    flight.run(1.2)
    flight.place(1.0, 2.0, 0.0)
    flight.run(1.0, flight.hover)
    assert flight.commander.failsafe


def test_a_command_ends_the_failsafe(flight):
    fly_offboard(flight)
    flight.run(1.2)
    assert flight.commander.request(modes.AUTO_LOITER) is Result.ACCEPTED
    assert (flight.commander.failsafe, flight.commander.system_status) == (False, 4)
    assert flight.setpoint["task"] == TASK_GOTO


@pytest.mark.parametrize(
    ("action", "mode", "task"),
    [(3, modes.AUTO_RTL, TASK_GOTO), (4, modes.AUTO_LAND, TASK_LAND), (5, modes.AUTO_LOITER, TASK_GOTO)],
)
def test_offboard_loss_actions(action, mode, task):
    flight = Flight(COM_OBL_RC_ACT=action)
    fly_offboard(flight)
    flight.run(1.2)
    assert flight.commander.mode is mode
    assert flight.setpoint["task"] == task


def offset(flight, x, yaw=0.0):
    """Return a position x m forward of the vehicle in local NED, as XTDrone's communication node repeats it."""
    message = SimpleNamespace(coordinate_frame=9, type_mask=0b100111111000, x=x, y=0.0, z=0.0, yaw=yaw, yaw_rate=0.0)
    message.vx = message.vy = message.vz = message.afx = message.afy = message.afz = math.nan
    local_target(flight.commander, message)
    return flight.setpoint["position"].tolist()


def test_an_offset_counts_from_where_its_command_came(flight):
    fly_offboard(flight)
    flight.place(1.0, 2.0, -3.0, yaw=math.pi / 2)
    assert offset(flight, 2.0) == pytest.approx([1.0, 4.0, -3.0])
    for y in (2.5, 3.0, 3.9):  # during the approach, while turning
        flight.place(1.0, y, -3.0, yaw=0.3 * y)
        flight.run(0.1)
        assert offset(flight, 2.0) == pytest.approx([1.0, 4.0, -3.0])
        assert flight.setpoint["yaw"] == pytest.approx(math.pi / 2)
    flight.place(1.0, 4.0, -3.0)
    assert offset(flight, 1.0) == pytest.approx([2.0, 4.0, -3.0]), "another command"
    flight.place(2.0, 4.0, -3.0)
    flight.hover()
    assert offset(flight, 1.0) == pytest.approx([3.0, 4.0, -3.0]), "another setpoint was between"
    flight.place(3.0, 4.0, -3.0)
    flight.run(0.9)
    assert offset(flight, 1.0) == pytest.approx([3.0, 4.0, -3.0]), "the stream goes on"
    flight.autopilot.time_us += 1_100_000
    assert offset(flight, 1.0) == pytest.approx([4.0, 4.0, -3.0]), "a pause ended the stream"


def test_an_offset_starts_where_offboard_begins(flight):
    fly_offboard(flight)
    offset(flight, 2.0)
    assert flight.commander.request(modes.AUTO_LOITER) is Result.ACCEPTED
    for x in (10.0, 20.0):
        flight.place(x, 2.0, -3.0)
        flight.run(0.1)
        offset(flight, 2.0)
    assert flight.commander.request(modes.OFFBOARD) is Result.ACCEPTED
    assert flight.setpoint["position"].tolist() == pytest.approx([22.0, 2.0, -3.0])
    flight.place(21.0, 2.0, -3.0)
    assert offset(flight, 2.0) == pytest.approx([22.0, 2.0, -3.0])


def test_offboard_without_a_position_falls_back_to_altitude_control_and_recovers(flight):
    fly_offboard(flight)
    flight.autopilot.estimator["position_valid"] = 0
    flight.run(0.9, flight.hover)
    assert not flight.commander.failsafe
    flight.run(0.3, flight.hover)
    assert flight.commander.mode is modes.ALTCTL
    assert flight.setpoint["task"] == TASK_DESCEND, "no manual control"
    assert flight.commander.request(modes.AUTO_LOITER) is Result.TEMPORARILY_REJECTED
    assert flight.setpoint["task"] == TASK_DESCEND
    flight.autopilot.estimator["position_valid"] = 1
    flight.run(0.2, flight.hover)
    assert flight.commander.mode is modes.OFFBOARD
    assert flight.setpoint["task"] == TASK_TRAJECTORY


def test_auto_modes_without_a_position_descend(flight):
    flight.commander.arm_disarm(True)
    flight.place(0.0, 0.0, -5.0)
    flight.run(0.5)
    flight.autopilot.estimator["position_valid"] = 0
    flight.run(0.9)
    assert not flight.commander.failsafe
    flight.run(0.3)
    assert flight.commander.mode is modes.DESCEND
    assert flight.commander.custom_mode == modes.AUTO_LAND.custom_mode
    assert flight.setpoint["task"] == TASK_DESCEND
    assert flight.commander.landed_state == 4
    flight.autopilot.estimator["position_valid"] = 1
    flight.run(0.2)
    assert flight.commander.mode is modes.AUTO_LOITER


def test_attitude_flight_needs_no_position(flight):
    fly_offboard(flight)
    flight.autopilot.estimator["position_valid"] = 0
    flight.run(3.0, lambda: flight.commander.offboard.set_attitude((1.0, 0.0, 0.0, 0.0), math.nan, 0.5))
    assert not flight.commander.failsafe


def test_ground_station_loss_is_announced(flight):
    fly_offboard(flight)
    flight.commander.gcs_heartbeat()
    flight.run(10.2, flight.hover)
    assert flight.texts() == ["Connection to ground station lost"]
    assert flight.commander.mode is modes.OFFBOARD
    flight.commander.gcs_heartbeat()
    flight.run(0.1, flight.hover)
    assert flight.texts() == ["GCS connection regained"]


def test_ground_station_loss_returns_if_configured():
    flight = Flight(NAV_DLL_ACT=2)
    assert flight.commander.arm_disarm(True) is Result.TEMPORARILY_REJECTED, "without a ground station"
    flight.commander.gcs_heartbeat()
    fly_offboard(flight)
    flight.commander.gcs_heartbeat()
    flight.run(10.1, flight.hover)
    assert flight.commander.mode is modes.AUTO_LOITER, "COM_FAIL_ACT_T for the pilot"
    assert "Failsafe activated, entering Hold for 5 seconds" in flight.texts()
    flight.run(4.8, flight.hover)
    assert flight.commander.mode is modes.AUTO_LOITER
    flight.run(0.3, flight.hover)
    assert flight.commander.mode is modes.AUTO_RTL
    assert flight.commander.failsafe_outcome.action is Action.RETURN


def test_home_is_where_it_was_armed(flight):
    assert flight.commander.home is not None, "set by the first valid position"
    flight.place(3.0, 4.0, 0.0)
    flight.commander.arm_disarm(True)
    assert flight.commander.home.position == (3.0, 4.0, 0.0)
    assert flight.commander.home.altitude == pytest.approx(ORIGIN[2])


@pytest.mark.parametrize("place", [(math.nan, 8.0, 0.0), (200.0, 8.0, 0.0), (47.0, 8.0, math.inf)])
def test_bad_home_is_denied(flight, place):
    home = flight.commander.home
    assert flight.commander.commands.set_home(place) is Result.DENIED
    assert flight.commander.home is home


def test_sticks_fly_posctl_and_the_vehicle_returns_when_they_fall_silent(flight):
    fly_offboard(flight)
    assert flight.commander.request(modes.POSCTL) is Result.TEMPORARILY_REJECTED, "without a pilot"
    flight.commander.manual_control(0.0, 0.0, 0.0, 0.0)
    flight.run(0.1, flight.hover)
    assert flight.commander.request(modes.POSCTL) is Result.ACCEPTED
    s = flight.setpoint
    assert (s["task"], s["stick_x"]) == (TASK_STICKS, 0.0)
    flight.commander.manual_control(1.0, -1.0, 0.05, 0.55)
    assert (s["stick_x"], s["stick_y"], s["stick_z"]) == (1.0, -1.0, 0.0)
    assert s["stick_yaw"] == pytest.approx(0.4 * 0.5 + 0.6 * 0.125)
    flight.run(0.7)
    assert flight.commander.mode is modes.AUTO_LOITER, "waits for the pilot before it returns"
    flight.run(5.0)
    assert flight.commander.mode is modes.AUTO_RTL


def test_sticks_allow_arming_in_posctl(flight):
    flight.commander.request(modes.POSCTL)
    flight.commander.manual_control(0.0, 0.0, 0.0, 0.0)
    flight.run(0.1)
    assert flight.commander.arm_disarm(True) is Result.ACCEPTED
    assert flight.setpoint["task"] == TASK_STICKS


def test_warnings_are_logged_once_a_second(flight):
    flight.run(1.0, lambda: flight.commander.warn("no"))
    assert flight.texts() == ["no"]
    flight.run(0.1, lambda: flight.commander.warn("no"))
    assert flight.texts() == ["no"]
