"""Senseless parameters, items and estimates: PX4 accepts them, so they must do no harm beyond their vehicle."""

from __future__ import annotations

import math

import numpy as np
import pytest
from autopilot_fakes import ORIGIN, Flight
from pymavlink.dialects.v20 import common as mavlink
from service_fakes import SYSTEM, Served
from xtdrone_native.mavlink_wire import Outbox

from xtdrone_autopilot.autopilot import Autopilot
from xtdrone_autopilot.commander.commander import Result
from xtdrone_autopilot.commander.manual_control import ManualControl
from xtdrone_autopilot.control.control_allocator import RotorLayout
from xtdrone_autopilot.mavlink.wire.codec import message_name
from xtdrone_autopilot.navigator import plan
from xtdrone_autopilot.navigator.plan import PlanItem
from xtdrone_autopilot.parameters.parameters import Parameters
from xtdrone_autopilot.state import TASK_GOTO
from xtdrone_common import modes
from xtdrone_common.geodesy import projection
from xtdrone_common.geodesy.projection import Datum

NAN = math.nan
NOTHING = (0.0, 0.0, 0.0, 0.0)


@pytest.fixture
def flight():
    """An iris that flies north at 5 m/s in AUTO.LOITER, 10 m over home."""
    flight = Flight()
    flight.commander.arm_disarm(True)
    flight.place(0.0, 0.0, -10.0)
    flight.run(0.1)
    flight.autopilot.estimator[0]["velocity"] = (5.0, 0.0, 1.0)
    flight.texts()
    return flight


@pytest.mark.parametrize("value", [0.0, -3.0])
def test_a_vehicle_that_may_not_brake_stops_all_the_same(flight, value):
    for name in ("MPC_ACC_HOR", "MPC_ACC_UP_MAX", "MPC_ACC_DOWN_MAX"):
        flight.parameters.set(name, value)
    flight.parameters.set("GF_MAX_HOR_DIST", 100.0)
    flight.parameters.set("GF_PREDICT", 1)
    flight.run(0.2)
    flight.commander.request(modes.AUTO_LOITER)
    assert flight.setpoint["goal_position"].tolist() == pytest.approx([9.25, 0.0, -10.0])


def test_an_invalid_covariance_counts_as_exact(flight):
    flight.autopilot.estimator[0]["P"][6, 6] = -1.0
    flight.run(0.2)
    assert flight.commander.mode is modes.AUTO_LOITER


def test_a_gate_of_zero_allows_arming():
    flight = Flight(EKF2_HDG_GATE=0.0)
    flight.run(0.2)
    assert flight.commander.ready_to_arm


def test_a_failsafe_may_wait_for_days():
    flight = Flight(COM_FAIL_ACT_T=1e6, NAV_DLL_ACT=2)
    flight.commander.gcs_heartbeat()
    flight.commander.arm_disarm(True)
    flight.place(0.0, 0.0, -10.0)
    flight.run(11.0)
    assert "Failsafe activated, entering Hold for 65535 seconds" in flight.texts()


def test_items_for_the_payload_without_numbers(flight):
    payload = flight.commander.navigator.payload
    for value in (math.inf, -math.inf, NAN):
        for command in (plan.TRIGGER_INTERVAL, plan.START_IMAGES, plan.TRIGGER_DISTANCE, plan.SET_ACTUATOR):
            assert payload.execute(command, [value] * 7)
    flight.run(0.3)
    assert payload.gimbal == pytest.approx((NAN,) * 3, nan_ok=True)


@pytest.mark.parametrize("x", [math.inf, NAN, 91.0])
def test_a_mission_sets_no_home_beyond_the_globe(flight, x):
    home = flight.commander.home
    flight.commander.navigator.set_plan(plan.MISSION, [PlanItem(plan.SET_HOME, 2, NOTHING, x, 8.5, 400.0)])
    assert flight.commander.request(modes.AUTO_MISSION) is Result.ACCEPTED
    flight.run(0.3)
    assert flight.commander.home is home


def test_a_return_passes_over_a_landing_without_a_place(flight):
    flight.parameters.set("RTL_TYPE", 1)
    items = [
        PlanItem(plan.WAYPOINT, 3, NOTHING, *ORIGIN[:2], 10.0),
        PlanItem(plan.LAND, 3, NOTHING, math.inf, math.inf, 0.0),
    ]
    flight.commander.navigator.set_plan(plan.MISSION, items)
    assert flight.commander.request(modes.AUTO_RTL) is Result.ACCEPTED
    assert "RTL: landing at home position." in flight.texts()


def test_a_far_waypoint_seen_from_nowhere(flight):
    flight.autopilot.estimator[0]["position"] = NAN
    items = [PlanItem(plan.WAYPOINT, 3, NOTHING, 0.0, 0.0, 10.0)]
    flight.commander.navigator.set_plan(plan.MISSION, items)
    flight.run(0.1)
    assert not any("too far" in text for text in flight.texts())


@pytest.mark.parametrize(("pulse", "value"), [(800, -1.0), (1400, -1.0), (1490, -1.0), (2000, -1.0)])
def test_a_channel_whose_calibration_is_turned_round(pulse, value):
    parameters = Parameters({"RC1_MIN": 1500.0, "RC1_TRIM": 1510.0, "RC1_DZ": 10.0, "RC1_MAX": 1400.0})
    for name, channel in {"RC_MAP_ROLL": 1, "RC_MAP_PITCH": 2, "RC_MAP_THROTTLE": 3, "RC_MAP_YAW": 4}.items():
        parameters.set(name, channel)
    parameters.set("COM_RC_IN_MODE", 0)
    for low in (1490.0, 1500.0, 1501.0):
        parameters.set("RC1_MIN", low)
        manual = ManualControl(parameters.get)
        manual.radio([pulse] * 8, 1_000_000)
        manual.update(1_000_000)
        assert manual.sticks is not None
        assert manual.sticks.y in (0.0, value)


def test_projections_at_the_ends_of_the_globe():
    rng = np.random.default_rng(4)
    for latitude, longitude in zip(rng.uniform(-90, 90, 3000), rng.uniform(-180, 180, 3000), strict=True):
        opposite = projection.project(180.0 - latitude, longitude + 180.0, latitude, longitude)
        assert math.hypot(*opposite) == pytest.approx(0.0, abs=1.0)
        pole = projection.project(90.0, longitude, latitude, longitude)
        assert projection.reproject(*pole, latitude, longitude)[0] == pytest.approx(90.0, abs=1e-5)


def test_no_speed_makes_no_time():
    served = Served()
    served.autopilot.control["landing"]["landed"] = 0
    served.parameters.set("MPC_XY_CRUISE", 0.0)
    served.ask(mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3))
    served.link.telemetry.refresh(served.autopilot.time_us)
    payloads: dict[int, bytes | list[bytes] | None] = {}
    served.link.streams.send_due(60_000_000, payloads, Outbox("127.0.0.1", 9, 1, 1), None, served.link.warnings.append)
    told = {message_name(number) for number, payload in payloads.items() if payload}
    assert "ATTITUDE" in told
    assert "TIME_ESTIMATE_TO_TARGET" not in told


@pytest.mark.parametrize("reference", [-1, 4, 1_000_000_000])
def test_a_height_reference_that_does_not_exist(reference):
    places = np.array([(0.1, 0.1, 0.0), (-0.1, -0.1, 0.0), (0.1, -0.1, 0.0), (-0.1, 0.1, 0.0)])
    layout = RotorLayout(places, np.array([0.05, 0.05, -0.05, -0.05]))
    autopilot = Autopilot([layout], Datum(*ORIGIN))
    Parameters({"EKF2_HGT_REF": reference}).write_to(autopilot.params[0])
    sensors = autopilot.sensors
    sensors["accel"] = (0.0, 0.0, -9.81)
    sensors["mag"] = (0.2, 0.0, 0.4)
    sensors["baro_alt"] = ORIGIN[2]
    for step in range(2000):
        sensors["time_us"] = (step + 1) * 4000
        sensors["mag_fresh"] = sensors["baro_fresh"] = step % 5 == 0
        autopilot.step()
    assert autopilot.estimator["altitude_valid"][0]
    assert np.isfinite(autopilot.estimator["position"]).all()


# commands at the wrong moment


def test_a_kill_switch_that_is_still_on_counts_from_the_next_arming():
    flight = Flight(COM_KILL_DISARM=5.0)
    flight.commander.arm_disarm(True)
    flight.commander.kill(True)
    flight.run(5.2)
    assert not flight.commander.armed
    flight.run(1.0)
    flight.commander.arm_disarm(True)
    flight.run(4.5)
    assert flight.commander.armed
    assert flight.setpoint["armed"] == 0
    flight.run(1.0)
    assert not flight.commander.armed


def test_a_client_that_goes_in_the_middle_of_an_upload_leaves_the_door_open():
    served = Served()
    served.ask(mavlink.MAVLink_mission_count_message(SYSTEM, 1, 3, 0), served.link)
    served.link.open = False
    (answer,) = served.ask(mavlink.MAVLink_mission_count_message(SYSTEM, 1, 3, 0), served.other)
    assert type(answer).__name__ == "MISSION_REQUEST"


def test_a_failsafe_action_set_late_acts():
    flight = Flight(COM_FAIL_ACT_T=0.0)
    flight.commander.gcs_heartbeat()
    flight.commander.arm_disarm(True)
    flight.place(30.0, 0.0, -10.0)
    flight.run(15.0)
    assert flight.commander.mode is modes.AUTO_LOITER
    assert flight.commander.health.flags.gcs_lost
    flight.parameters.set("NAV_DLL_ACT", 2)
    flight.run(0.2)
    assert flight.commander.mode is modes.AUTO_RTL


def test_armed_again_in_the_air_with_a_failsafe_on_the_vehicle_is_caught():
    flight = Flight(NAV_DLL_ACT=1)
    flight.commander.gcs_heartbeat()
    flight.commander.arm_disarm(True)
    flight.place(0.0, 0.0, -50.0)
    flight.run(11.0)
    flight.commander.arm_disarm(False, force=True)
    flight.run(0.5)
    flight.place(0.0, 0.0, -45.0)
    assert flight.commander.arm_disarm(True) is Result.ACCEPTED
    assert flight.commander.failsafe
    assert flight.commander.mode is modes.AUTO_LOITER
    assert flight.setpoint["task"] == TASK_GOTO
    assert flight.setpoint["goal_position"].tolist() == pytest.approx([0.0, 0.0, -45.0])


def test_a_killed_vehicle_forgets_no_mission_before_it_is_disarmed(flight):
    place = (3, NOTHING, *ORIGIN[:2])
    flight.commander.navigator.set_plan(plan.MISSION, [PlanItem(plan.WAYPOINT, *place, z) for z in (10.0, 20.0)], 1)
    flight.commander.request(modes.AUTO_MISSION)
    flight.commander.kill(True)
    flight.hover()
    assert flight.commander.request(modes.OFFBOARD) is Result.ACCEPTED
    flight.run(0.2)
    assert flight.commander.navigator.plans.current == 1
    flight.commander.arm_disarm(False, force=True)
    assert flight.commander.navigator.plans.current == 0
