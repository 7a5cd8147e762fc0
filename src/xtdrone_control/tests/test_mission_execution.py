"""A mission flown item by item by a vehicle that is always at its setpoint."""

from __future__ import annotations

import itertools
import math

import pytest
from mission_fakes import NAN, MissionFlight, at, do

from xtdrone_control.autopilot import modes
from xtdrone_control.autopilot.navigator import plan
from xtdrone_control.autopilot.state import TASK_GOTO, TASK_LAND


@pytest.fixture
def flight():
    return MissionFlight()


@pytest.fixture
def hovering():
    flight = MissionFlight()
    flight.hover()
    return flight


def fly(flight, *items):
    """Fly ``items``, starting in the air."""
    flight.load(*items)
    assert flight.commander.request(modes.AUTO_MISSION) == 0
    flight.texts()


def ticks(flight, most=100):
    """Advance the vehicle; yield after each 0.1 s while the mission is flown."""
    for _ in range(most):
        flight.tick()
        yield
        if flight.commander.mode is not modes.AUTO_MISSION:
            return


def test_a_square_in_order(flight):
    flight.load(at(0, 0, command=plan.TAKEOFF), at(20, 0), at(20, 20), at(0, 20), at(0, 0))
    flight.start()
    assert "Takeoff to 10.0 meters above home" in flight.texts()
    assert (flight.setpoint["task"], flight.goal()) == (TASK_GOTO, [0, 0, -10])
    assert flight.setpoint["climb_speed"] == 1.5
    flight.place(0, 0, -5)
    assert flight.commander.landed_state == 3
    flight.place(0, 0, 0)
    seen = [(flight.reached, flight.current)]
    for _ in ticks(flight):
        seen.append((flight.reached, flight.current))
    assert list(dict.fromkeys(seen)) == [(-1, 0), (0, 1), (1, 2), (2, 3), (3, 4), (4, 4)]
    assert flight.texts()[-1] == "Mission finished, loitering"
    assert flight.commander.mode is modes.AUTO_LOITER
    assert math.isnan(flight.setpoint["climb_speed"])


def test_the_path_continues_through_a_waypoint_but_not_through_a_hold(hovering):
    fly(hovering, at(20, 0), at(20, 20, 10, plan.WAYPOINT, 3.0, 1.0), at(0, 20))
    assert hovering.setpoint["onward_position"].tolist() == pytest.approx([20, 20, -10], abs=0.01)
    assert hovering.setpoint["goal_radius"] == 2.0
    hovering.tick()
    assert math.isnan(hovering.setpoint["onward_position"][0])
    assert hovering.setpoint["goal_radius"] == 1.0
    hovering.tick()
    hovering.run(2.9)
    assert hovering.current == 1
    hovering.run(0.2)
    assert hovering.current == 2


def test_reached_by_radius_and_height(hovering):
    fly(hovering, at(20, 0), at(40, 0))
    for place, current in [((17.9, 0, -10), 0), ((18.1, 0, -9.1), 0), ((18.1, 0, -9.3), 1)]:
        hovering.place(*place)
        hovering.run(0.1)
        assert hovering.current == current


def test_a_heading_is_waited_for(hovering):
    fly(hovering, at(20, 0, 10, plan.WAYPOINT, 0, 0, 0, 90.0), at(40, 0))
    hovering.place(20, 0, -10, yaw=0.0)
    hovering.run(2.0)
    assert hovering.current == 0
    assert hovering.setpoint["goal_yaw"] == pytest.approx(math.pi / 2)
    hovering.place(20, 0, -10, yaw=math.radians(79.0))
    hovering.run(0.1)
    assert hovering.current == 1


def test_a_positive_timeout_does_not_wait_for_the_heading():
    flight = MissionFlight(MIS_YAW_TMT=5)
    flight.hover()
    fly(flight, at(20, 0, 10, plan.WAYPOINT, 0, 0, 0, 90.0), at(40, 0))
    flight.place(20, 0, -10, yaw=0.0)
    flight.run(0.1)
    assert flight.current == 1


@pytest.mark.parametrize(
    ("mode", "bearing"), [(0, 90.0), (1, -90.0), (2, 90.0), (4, 90.0)]
)  # home is at the origin; the vehicle flies from 10 m to 30 m east
def test_heading_modes(mode, bearing):
    flight = MissionFlight(MPC_YAW_MODE=mode)
    flight.hover()
    flight.place(0, 10, -10)
    fly(flight, at(0, 30))
    flight.run(0.2)
    error = math.remainder(float(flight.setpoint["goal_yaw"]) - math.radians(bearing), 2 * math.pi)
    assert abs(error) < 0.01


def test_a_region_of_interest_turns_the_vehicle(hovering):
    fly(hovering, do(plan.SET_ROI_NONE), at(0, 30, 0, plan.SET_ROI_LOCATION), at(30, 30), at(60, 30))
    hovering.run(0.1)
    hovering.run(0.2)
    assert hovering.current == 2
    assert hovering.setpoint["goal_yaw"] == pytest.approx(math.pi / 2, abs=0.01)
    hovering.place(20, 0, -10)
    hovering.run(0.1)
    assert hovering.setpoint["goal_yaw"] == pytest.approx(math.atan2(30, -20), abs=0.01)


def test_pause_and_resume_continue_with_the_same_item(hovering):
    fly(hovering, at(20, 0), at(40, 0), at(60, 0))
    hovering.tick()
    assert hovering.current == 1
    hovering.commander.request(modes.AUTO_LOITER)
    hovering.run(3.0)
    assert hovering.current == 1
    hovering.commander.request(modes.AUTO_MISSION)
    assert hovering.goal() == [40, 0, -10]
    assert hovering.reached == -1


def test_a_flight_after_landing_begins_with_the_first_item(flight):
    flight.load(at(0, 0, command=plan.TAKEOFF), at(20, 0), at(20, 0, 0, plan.LAND))
    flight.start()
    for _ in ticks(flight, 4):
        pass
    assert (flight.current, flight.setpoint["task"]) == (2, TASK_LAND)
    flight.place(20, 0, 0)
    flight.run(0.2)
    assert flight.reached == 2
    assert "Mission finished, landed" in flight.texts()
    flight.run(3.0)
    assert not flight.commander.armed
    assert flight.current == 0
    flight.start()
    assert flight.goal() == [20, 0, -10]


def test_landing_flies_to_its_place_first(hovering):
    fly(hovering, at(30, 0, 5, plan.LAND))
    assert (hovering.setpoint["task"], hovering.goal()) == (TASK_GOTO, [30, 0, -10])
    hovering.tick()
    assert (hovering.setpoint["task"], hovering.goal()) == (TASK_LAND, [30, 0, 0])
    assert hovering.commander.landed_state == 4


def test_loiters(hovering):
    fly(
        hovering,
        at(0, 0, 10, plan.LOITER_TIME, 2.0),
        at(0, 0, 30, plan.LOITER_TO_ALT),
        at(0, 20, 10, plan.LOITER_UNLIM),
    )
    hovering.tick()
    hovering.run(1.9)
    assert hovering.current == 0
    hovering.run(0.1)
    assert (hovering.current, hovering.goal()) == (1, [0, 0, -10])
    hovering.run(0.1)
    assert hovering.goal() == [0, 0, -30]
    hovering.tick()
    assert hovering.current == 2
    for _ in range(50):
        hovering.tick()
    assert (hovering.current, hovering.commander.mode) == (2, modes.AUTO_MISSION)


def test_a_delay(hovering):
    fly(hovering, do(plan.DELAY, 3.0), at(20, 0))
    hovering.run(3.0)
    assert hovering.current == 0
    hovering.run(0.2)
    assert hovering.current == 1


def test_jumps_are_counted(hovering):
    fly(hovering, at(20, 0), at(40, 0), do(plan.JUMP, 0, 2), at(60, 0))
    seen = []
    for _ in ticks(hovering):
        seen.append(hovering.current)
    order = [seen[0], *(b for a, b in itertools.pairwise(seen) if a != b)]
    assert order == [1, 0, 1, 0, 1, 3]
    assert "DO JUMP repetitions completed." in hovering.texts()


@pytest.mark.parametrize("jump", [(1, 1e9), (700, 5), (-3, 5), (NAN, 5), (1e30, 5)])
def test_jumps_that_lead_nowhere_end_the_mission(hovering, jump):
    fly(hovering, at(0, 0), do(plan.JUMP, *jump))
    for _ in ticks(hovering, 5):
        pass
    assert hovering.commander.mode is modes.AUTO_LOITER


@pytest.mark.parametrize("index", [700, -3])
def test_a_jump_out_of_bounds_is_reported(hovering, index):
    fly(hovering, at(0, 0), do(plan.JUMP, index, 5))
    for _ in ticks(hovering, 5):
        pass
    assert f"Mission item index out of bound, index: {index}, max: 2." in hovering.texts()


def test_speeds(hovering):
    items = [do(plan.CHANGE_SPEED, 1, 2.0, -1), do(plan.CHANGE_SPEED, 2, 1.0), at(20, 0), do(plan.CHANGE_SPEED, 1, 0)]
    fly(hovering, *items, at(40, 0))
    hovering.run(0.2)
    assert (hovering.setpoint["cruise_speed"], hovering.setpoint["climb_speed"]) == (2.0, 1.0)
    hovering.tick()
    hovering.run(0.1)
    assert math.isnan(hovering.setpoint["cruise_speed"])


def test_a_return_in_a_mission(hovering):
    fly(hovering, at(30, 0), do(plan.RETURN))
    hovering.tick()
    hovering.tick()
    assert hovering.commander.mode is modes.AUTO_RTL
    found = hovering.texts()
    assert "RTL: landing at home position." in found
    assert found.index("RTL HOME activated") < found.index("RTL: landing at home position.")


def test_home_can_be_set_by_an_item(hovering):
    fly(hovering, at(20, 0), do(plan.SET_HOME, 1), at(40, 0))
    hovering.tick()
    hovering.tick()
    assert hovering.commander.home.position[:2] == pytest.approx((20, 0), abs=0.01)


def test_a_gate_is_passed_at_right_angles(hovering):
    fly(hovering, at(20, 10, 10, plan.CONDITION_GATE), at(40, 0))
    assert hovering.goal() == [40, 0, -10]
    hovering.place(12, 0, -10)
    hovering.run(0.1)
    assert hovering.current == 0
    hovering.place(26, 0, -10)
    hovering.run(0.1)
    assert hovering.current == 1


def test_the_mission_waits_for_the_gripper(hovering):
    fly(hovering, do(plan.GRIPPER, 1, 0), at(20, 0))
    hovering.run(4.9)
    assert hovering.current == 0
    hovering.run(0.3)
    assert hovering.current == 1


def test_set_current_in_flight(hovering):
    fly(hovering, at(20, 0), at(40, 0), at(60, 0))
    assert hovering.commander.navigator.set_current(2)
    assert hovering.goal() == [60, 0, -10]
    assert not hovering.commander.navigator.set_current(3)


def test_a_new_mission_in_flight_continues_at_the_same_index(hovering):
    fly(hovering, at(20, 0), at(40, 0), at(60, 0))
    hovering.tick()
    hovering.load(at(0, 20), at(0, 40), at(0, 60))
    assert hovering.goal() == [0, 40, -10]
    hovering.load(at(0, 20))
    assert hovering.goal() == [0, 20, -10]
    hovering.texts()
    hovering.load()
    assert "Mission finished, loitering" in hovering.texts()
    hovering.run(0.1)
    assert hovering.commander.mode is modes.AUTO_LOITER


def test_a_first_waypoint_on_the_ground_takes_off_in_place(flight):
    flight.load(at(30, 0, 1.0), at(60, 0))
    flight.start()
    assert "Takeoff to 2.5 meters above home" in flight.texts()
    assert flight.goal() == [0, 0, -2.5]
    flight.tick()
    assert (flight.reached, flight.goal()) == (-1, [30, 0, -1])


def test_items_without_sense_do_no_harm(hovering):
    hovering.parameters.set("MIS_DIST_1WP", 0)
    items = [at(0, 0, NAN), at(0, 0, math.inf), plan.PlanItem(plan.WAYPOINT, 6, (NAN,) * 4, NAN, math.inf, 10.0)]
    fly(hovering, *items)
    for _ in ticks(hovering, 10):
        assert all(map(math.isfinite, hovering.setpoint["goal_position"].tolist()))


def test_without_autocontinue_the_mission_waits(hovering):
    fly(hovering, at(20, 0, autocontinue=False), at(40, 0))
    for _ in range(20):
        hovering.tick()
    assert (hovering.current, hovering.reached) == (0, 0)


# payload


def test_a_camera_triggers_by_distance(hovering):
    shots = []
    hovering.commander.navigator.payload.on_camera_trigger = shots.append
    fly(hovering, do(plan.TRIGGER_DISTANCE, 5.0, 0, 1), at(30, 0), do(plan.TRIGGER_DISTANCE, 0.0), at(60, 0))
    hovering.run(0.1)
    for x in range(1, 30):
        hovering.place(x, 0, -10)
        hovering.run(0.1)
    hovering.place(60, 0, -10)
    hovering.run(1.0)
    assert [round(shot.position[0]) for shot in shots] == [0, 5, 10, 15, 20, 25]
    assert [shot.number for shot in shots] == [1, 2, 3, 4, 5, 6]


def test_pictures_by_time_and_number_wait_while_the_mission_is_paused(hovering):
    payload = hovering.commander.navigator.payload
    fly(hovering, do(plan.START_IMAGES, 0, 0.5, 4), at(30, 0))
    hovering.run(0.7)
    assert payload.count == 2
    hovering.commander.request(modes.AUTO_LOITER)
    hovering.run(3.0)
    assert payload.count == 2
    hovering.commander.request(modes.AUTO_MISSION)
    hovering.run(5.0)
    assert payload.count == 4


def test_gimbal_actuators_and_video_are_kept(hovering):
    payload = hovering.commander.navigator.payload
    fly(
        hovering,
        do(plan.GIMBAL_PITCHYAW, -30, 10, NAN, NAN),
        do(plan.SET_ACTUATOR, 0.5, -2.0),
        do(plan.START_VIDEO),
        at(30, 0),
    )
    hovering.run(0.4)
    assert payload.gimbal == pytest.approx((0.0, math.radians(-30), math.radians(10)))
    assert payload.actuators[:2] == [0.5, -1.0]
    assert payload.recording
