"""A mission flown item by item by a vehicle that is always at its setpoint."""

from __future__ import annotations

import dataclasses
import itertools
import math

import pytest
from mission_fakes import NAN, MissionFlight, at, do

from xtdrone_autopilot.navigator import plan
from xtdrone_autopilot.state import TASK_GOTO, TASK_LAND
from xtdrone_common import modes


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


def test_the_heading_is_kept_within_the_radius_of_the_item(hovering):
    """PX4 FlightTaskAuto::_set_heading_from_mode: the radius of the setpoint, not NAV_ACC_RAD."""
    fly(hovering, at(40, 0, 10, plan.WAYPOINT, 0, 8.0), at(60, 0))
    hovering.place(35, 5, -5)
    hovering.run(0.2)
    assert hovering.current == 0
    assert hovering.setpoint["goal_yaw"] == pytest.approx(0.0, abs=0.01)
    hovering.place(35, 8, -5)
    hovering.run(0.2)
    assert hovering.setpoint["goal_yaw"] == pytest.approx(math.atan2(-8, 5), abs=0.01)


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


BRAKES = {  # items behind a waypoint, and whether PX4 v1.14 disregards the waypoint after them
    "delay": (do(plan.DELAY, 3.0), True),
    "delay until a time of day, not supported": (do(plan.DELAY, -1.0, 12.0, 0.0, 0.0), False),
    "delay of nothing": (do(plan.DELAY, 0.0), False),
    "gripper": (do(plan.GRIPPER, 1, 0), True),
    "winch": (do(plan.WINCH, 1, 0), True),
    "without autocontinue": (dataclasses.replace(do(plan.START_VIDEO), autocontinue=False), True),
    "speed": (do(plan.CHANGE_SPEED, 1, 4.0), False),
    "picture": (do(plan.START_IMAGES, 0, 0, 1), False),
    "gimbal": (do(plan.GIMBAL_PITCHYAW, -30, 0), False),
    "region of interest": (do(plan.SET_ROI_NONE), False),
    "start of landing": (do(plan.LAND_START), False),
}


@pytest.mark.parametrize(("item", "brakes"), BRAKES.values(), ids=BRAKES)
def test_items_that_take_time_brake_at_the_waypoint_before(hovering, item, brakes):
    """PX4 Mission::set_mission_items: brake_for_hold clears the next setpoint, the current one stays."""
    fly(hovering, at(40, 0), item, at(40, 40), at(0, 40))
    assert hovering.setpoint["onward_position"].tolist() == pytest.approx([40, 40, -10], abs=0.01)
    hovering.tick()
    assert (hovering.current, hovering.goal()) == (1, [40, 0, -10])
    assert math.isnan(hovering.setpoint["onward_position"][0]) == brakes


def test_a_command_after_a_loiter_stays_there(hovering):
    """FlightTaskAuto::_evaluateTriplets: a loiter has no next waypoint."""
    fly(hovering, at(40, 0, 10, plan.LOITER_TIME, 1.0), do(plan.START_VIDEO), at(40, 40))
    hovering.tick()
    hovering.run(1.0)
    assert (hovering.current, hovering.goal()) == (1, [40, 0, -10])
    assert math.isnan(hovering.setpoint["onward_position"][0])


def test_a_mission_that_begins_with_a_delay_holds(hovering):
    hovering.place(7, 3, -12)
    fly(hovering, do(plan.DELAY, 3.0), at(20, 0))
    assert (hovering.setpoint["task"], hovering.goal()) == (TASK_GOTO, [7, 3, -12])
    assert math.isnan(hovering.setpoint["onward_position"][0])


def test_a_new_mission_in_flight_that_begins_with_a_delay_holds(hovering):
    """PX4 Mission::on_active: a changed mission resets the setpoints."""
    fly(hovering, at(40, 0), at(80, 0))
    hovering.place(10, 0, -10)
    hovering.load(do(plan.DELAY, 3.0), at(40, 40))
    assert hovering.goal() == [10, 0, -10]
    hovering.run(3.0)
    assert hovering.current == 0
    hovering.run(0.2)
    assert hovering.goal() == [40, 40, -10]


def test_a_gate_leads_to_the_radius_of_the_waypoint_behind_it(hovering):
    fly(hovering, at(20, 0, 10, plan.CONDITION_GATE), at(40, 0, 10, plan.WAYPOINT, 0, 7.0))
    assert hovering.setpoint["goal_radius"] == 7.0


@pytest.mark.parametrize(("mode", "climbs"), [(modes.AUTO_RTL, True), (modes.AUTO_LOITER, False)])
def test_a_mission_resumed_from_a_mode_without_a_goal_climbs_first(hovering, mode, climbs):
    """PX4 Mission::on_inactive: a takeoff is required after any mode that cannot loiter at its setpoint."""
    fly(hovering, at(20, 0), at(40, 0, 30))
    hovering.tick()
    hovering.commander.request(mode)
    hovering.place(10, 0, -10)
    hovering.run(0.5)
    hovering.texts()
    hovering.commander.request(modes.AUTO_MISSION)
    assert hovering.goal() == ([10, 0, -30] if climbs else [40, 0, -30])
    assert ("Takeoff to 30.0 meters above home" in hovering.texts()) == climbs


def test_a_mission_flown_to_its_end_in_the_air_is_not_flown_again(hovering):
    """PX4 Mission::set_mission_items: the index stays behind the last item until it is set or the vehicle disarmed."""
    fly(hovering, at(20, 0), at(40, 0))
    for _ in ticks(hovering):
        pass
    hovering.texts()
    hovering.commander.request(modes.AUTO_MISSION)
    hovering.run(0.1)
    assert hovering.commander.mode is modes.AUTO_LOITER
    assert "No valid mission available, loitering" in hovering.texts()
    hovering.load(at(20, 0), at(40, 0), at(60, 0))
    hovering.commander.request(modes.AUTO_MISSION)
    assert hovering.goal() == [60, 0, -10]
    assert hovering.commander.navigator.set_current(0)
    assert hovering.goal() == [20, 0, -10]


HEADINGS = {  # item, MIS_YAW_TMT, heading of the vehicle there, whether the item is complete
    "loiter time": (at(20, 0, 10, plan.LOITER_TIME, 0.0, 0.0, 0.0, 90.0), -1.0, 0.0, False),
    "loiter time, waived": (at(20, 0, 10, plan.LOITER_TIME, 0.0, 0.0, 0.0, 90.0), 5.0, 0.0, True),
    "loiter time, required": (at(20, 0, 10, plan.LOITER_TIME, 0.0, 1.0, 0.0, 90.0), 5.0, 0.0, False),
    "loiter to altitude turns north": (at(20, 0, 10, plan.LOITER_TO_ALT, 0, 0, 0, 90.0), -1.0, math.pi / 2, False),
    "loiter to altitude, at north": (at(20, 0, 10, plan.LOITER_TO_ALT, 0, 0, 0, 90.0), -1.0, 0.0, True),
    "landing ignores it": (at(20, 0, 10, plan.LAND, 0, 0, 0, 90.0), -1.0, 0.0, False),
}


@pytest.mark.parametrize(("item", "timeout", "heading", "complete"), HEADINGS.values(), ids=HEADINGS)
def test_headings_by_item(item, timeout, heading, complete):
    """PX4 MissionBlock::is_mission_item_reached_or_completed; LOITER_TO_ALT stores no heading: 0, the north."""
    flight = MissionFlight(MIS_YAW_TMT=timeout)
    flight.hover()
    fly(flight, item, at(40, 0))
    flight.place(20, 0, -10, yaw=heading)
    flight.run(1.0)
    assert (flight.current == 1) == complete


def test_a_required_heading_that_is_not_reached_in_time_fails_the_mission():
    flight = MissionFlight(MIS_YAW_TMT=5)
    flight.hover()
    fly(flight, at(20, 0, 10, plan.LOITER_TIME, 0.0, 1.0, 0.0, 90.0), at(40, 0))
    flight.place(20, 0, -10, yaw=0.0)
    flight.run(4.9)
    assert flight.commander.mode is modes.AUTO_MISSION
    flight.run(0.4)
    assert flight.commander.mode is modes.AUTO_RTL
    assert "unable to reach heading within timeout" in flight.texts()


def test_jumps_are_counted(hovering):
    fly(hovering, at(20, 0), at(40, 0), do(plan.JUMP, 0, 2), at(60, 0))
    seen = []
    for _ in ticks(hovering):
        seen.append(hovering.current)
    order = [seen[0], *(b for a, b in itertools.pairwise(seen) if a != b)]
    assert order == [1, 0, 1, 0, 1, 3]
    assert "DO JUMP repetitions completed." in hovering.texts()


@pytest.mark.parametrize("jump", [(1, 1e9), (700, 5), (-3, 5)])
def test_jumps_that_lead_nowhere_end_the_mission(hovering, jump):
    fly(hovering, at(0, 0), do(plan.JUMP, *jump))
    for _ in ticks(hovering, 5):
        pass
    assert hovering.commander.mode is modes.AUTO_LOITER


@pytest.mark.parametrize(
    ("params", "stored"),
    [
        ((1, -1), (1, 65535)),
        ((1, 70000), (1, 4464)),
        ((1, 2.9), (1, 2)),
        ((40000, 3), (-25536, 3)),
        ((NAN, math.inf), (0, 0)),
        ((1e30, -1e30), (0, 0)),
    ],
)
def test_a_jump_is_stored_in_px4s_integers(params, stored):
    """PX4 MavlinkMissionManager::parse_mavlink_mission_item, built for SITL: int16 index, uint16 count."""
    assert plan.jump(params) == stored


def test_a_jump_that_repeats_minus_once_does_not_end(hovering):
    fly(hovering, at(20, 0), at(40, 0), do(plan.JUMP, 0, -1), at(60, 0))
    assert [hovering.current for _ in ticks(hovering, 40)][-4:] == [1, 0, 1, 0]


def test_the_search_for_the_next_position_goes_on_behind_a_jump(hovering):
    """PX4 Mission::prepare_mission_items: the command at which the jump ends does not move the search."""
    fly(hovering, do(plan.START_VIDEO), at(20, 0), do(plan.JUMP, 0, 5), at(20, 20), at(60, 0))
    hovering.run(0.1)
    assert hovering.current == 1
    assert hovering.setpoint["onward_position"].tolist() == pytest.approx([20, 20, -10], abs=0.01)


@pytest.mark.parametrize("index", [700, -3])
def test_a_jump_out_of_bounds_is_reported(hovering, index):
    fly(hovering, at(0, 0), do(plan.JUMP, index, 5))
    for _ in ticks(hovering, 5):
        pass
    assert f"Mission item index out of bound, index: {index}, max: 2." in hovering.texts()


def test_speeds(hovering):
    items = [do(plan.CHANGE_SPEED, 1, 2.0, -1), do(plan.CHANGE_SPEED, 2, 1.0), at(20, 0), do(plan.CHANGE_SPEED, 1, 0)]
    fly(hovering, *items, at(40, 0))
    assert hovering.setpoint["cruise_speed"] == 2.0
    hovering.run(0.2)
    assert hovering.setpoint["cruise_speed"] == 1.0  # of any kind, also climb: PX4 v1.14 does not distinguish them
    assert math.isnan(hovering.setpoint["climb_speed"])
    hovering.tick()
    hovering.run(0.1)
    assert math.isnan(hovering.setpoint["cruise_speed"])


@pytest.mark.parametrize("speed", [0.0, -1.0, -2.0, NAN])
def test_a_speed_that_is_none_restores_the_parameters(hovering, speed):
    """PX4 Navigator::run, DO_CHANGE_SPEED: any speed that is not positive."""
    fly(hovering, do(plan.CHANGE_SPEED, 1, 2.0), do(plan.CHANGE_SPEED, 1, speed), at(20, 0))
    assert hovering.setpoint["cruise_speed"] == 2.0
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


def test_a_series_of_pictures_ends_when_the_mission_is_left(hovering):
    payload = hovering.commander.navigator.payload
    fly(hovering, do(plan.START_IMAGES, 0, 0.5, 4), at(30, 0))
    hovering.run(0.7)
    assert payload.count == 2
    hovering.commander.request(modes.AUTO_LOITER)
    hovering.run(3.0)
    assert payload.count == 2
    hovering.commander.request(modes.AUTO_MISSION)
    hovering.run(5.0)
    assert payload.count == 2  # a series ends with the mission (PX4 Mission::on_inactivation, stop_capturing_images)


def test_pictures_by_the_trigger_go_on_with_the_mission(hovering):
    payload = hovering.commander.navigator.payload
    fly(hovering, do(plan.TRIGGER_INTERVAL, 500.0), at(30, 0))
    hovering.run(0.7)
    hovering.commander.request(modes.AUTO_LOITER)
    hovering.run(3.0)
    assert payload.count == 2
    hovering.commander.request(modes.AUTO_MISSION)
    hovering.run(1.0)
    assert payload.count > 2


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
