"""Destination of a return, geofence breaches, and landing on a target."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
from mission_fakes import NAN, MissionFlight, at, do

from xtdrone_autopilot.navigator import plan
from xtdrone_autopilot.navigator.precision_landing import from_angles
from xtdrone_autopilot.state import TASK_GOTO, TASK_LAND
from xtdrone_common import modes


def flying(north=0.0, east=0.0, **parameters):
    flight = MissionFlight(**parameters)
    flight.hover()
    flight.place(north, east, -10)
    return flight


RALLY = (at(100, 0, 0, plan.RALLY_POINT), at(0, 100, 20, plan.RALLY_POINT))
LANDING = (at(0, 0, command=plan.TAKEOFF), at(-50, 0), at(-100, 0, 0, plan.LAND))


@pytest.mark.parametrize(
    ("kind", "place", "name", "goal"),
    [
        (0, (10, 10), "home position", (0, 0)),
        (0, (80, 10), "safe landing point", (100, 0)),
        (0, (-80, 0), "home position", (0, 0)),
        (1, (-40, 0), "mission landing", (-100, 0)),
        (3, (-80, 0), "mission landing", (-100, 0)),
        (3, (-10, 0), "home position", (0, 0)),
        (3, (0, 80), "safe landing point", (0, 100)),
    ],
)
def test_destinations(kind, place, name, goal):
    flight = flying(*place, RTL_TYPE=kind)
    flight.load(*RALLY, kind=plan.RALLY)
    flight.load(*LANDING)
    flight.texts()
    flight.commander.request(modes.AUTO_RTL)
    assert f"RTL: landing at {name}." in flight.texts()
    flight.run(0.2)
    flight.follow()
    flight.run(0.1)
    assert flight.goal()[:2] == list(goal)


LOOP = (
    at(0, 0, command=plan.TAKEOFF),
    at(40, 0, 15),
    do(plan.CHANGE_SPEED, 1, 3.0),
    at(40, 40, 20, plan.LOITER_TIME, 30.0),
    do(plan.JUMP, 1, 5),
    at(0, 40),
)


def flown_by(flight, ticks):
    """Return the goals (north, east, height) of a vehicle that reaches each at once, without repetitions."""
    goals = []
    for _ in range(ticks):
        north, east, down = flight.goal()
        goal = (north, east, -down)
        if goal not in goals[-1:]:
            goals.append(goal)
        flight.tick()
    return goals


@pytest.mark.parametrize(
    ("start", "place", "expected"),
    [
        # in the mission at its item 5: back from the position before the one that it flies to
        (5, (20, 40), [(40, 40, 20), (40, 0, 15), (0, 0, 10)]),
        # in hold: from the closest position, home being one
        (None, (35, 45), [(40, 40, 20), (40, 0, 15), (0, 0, 10)]),
        (None, (3, 42), [(0, 40, 10), (40, 40, 20), (40, 0, 15), (0, 0, 10)]),
        (None, (1, 0), []),
    ],
)
def test_a_mission_without_a_landing_is_flown_back(start, place, expected):
    """PX4 navigator_main.cpp, RTL_TYPE_MISSION_LANDING_REVERSED: positions only, without waits and jumps."""
    flight = flying(RTL_TYPE=2)
    flight.load(*LOOP)
    flight.load(*RALLY, kind=plan.RALLY)
    if start is not None:
        flight.commander.request(modes.AUTO_MISSION)
        flight.commander.navigator.set_current(start)
    flight.place(*place, -10 if expected else -1)
    flight.texts()
    flight.commander.request(modes.AUTO_RTL)
    assert "RTL Mission activated, fly mission in reverse" in flight.texts()
    goals = flown_by(flight, 14)
    assert goals[: len(expected)] == expected
    said = flight.texts() if expected else ["Reverse Mission finished, loitering", "RTL: landing at home position."]
    assert said.index("Reverse Mission finished, loitering") < said.index("RTL: landing at home position.")
    assert flight.goal()[:2] == [0, 0]
    assert flight.setpoint["task"] == TASK_LAND


@pytest.mark.parametrize(
    ("start", "place", "expected"),
    [
        (1, (0, 5), [(-50, 0, 10), (-80, 0, 12), (-100, 0, 12), (-100, 0, 0)]),
        (None, (-82, 3), [(-80, 0, 12), (-100, 0, 12), (-100, 0, 0)]),
    ],
)
def test_a_mission_with_a_landing_is_flown_on(start, place, expected):
    flight = flying(RTL_TYPE=2)
    wait = at(-50, 0, 10, plan.LOITER_UNLIM)
    flight.load(at(0, 0, command=plan.TAKEOFF), wait, do(plan.DELAY, 60), at(-80, 0, 12), at(-100, 0, 0, plan.LAND))
    if start is not None:
        flight.commander.request(modes.AUTO_MISSION)
        flight.commander.navigator.set_current(start)
    flight.place(*place, -12)
    flight.texts()
    flight.commander.request(modes.AUTO_RTL)
    assert "RTL Mission activated, continue mission" in flight.texts()
    assert flown_by(flight, 12) == expected
    assert flight.setpoint["task"] == TASK_LAND


def test_a_return_from_a_stick_mode_goes_to_the_landing_or_home():
    flight = flying(30.0, RTL_TYPE=2)
    flight.load(*LOOP)
    flight.run(0.2, lambda: flight.commander.manual_control(0.0, 0.0, 0.0, 0.0))
    flight.commander.request(modes.POSCTL)
    flight.texts()
    flight.commander.request(modes.AUTO_RTL)
    assert "RTL Mission activated, fly to home" in flight.texts()
    flight.commander.manual_control(0.0, 0.0, 0.0, 0.0)
    flight.commander.request(modes.POSCTL)
    flight.load(at(0, 0, command=plan.TAKEOFF), at(90, 0), do(plan.LAND_START), at(60, 0), at(50, 0, 0, plan.LAND))
    flight.commander.request(modes.AUTO_RTL)
    flight.tick()
    assert flight.goal()[:2] == [60, 0]


def test_a_return_goes_to_the_start_of_the_landing_and_continues_one_that_has_begun():
    """PX4 rtl.cpp: a multirotor lands at the first position after DO_LAND_START."""
    landing = (at(0, 0, command=plan.TAKEOFF), at(90, 0), do(plan.LAND_START), at(60, 0, 5), at(50, 0, 0, plan.LAND))
    flight = flying(30.0, RTL_TYPE=1)
    flight.load(*landing)
    flight.commander.request(modes.AUTO_RTL)
    flight.tick()
    flight.tick()
    assert flight.goal()[:2] == [60, 0]
    flight = flying(70.0, RTL_TYPE=1)
    flight.load(*landing)
    flight.commander.request(modes.AUTO_MISSION)
    flight.commander.navigator.set_current(3)
    flight.commander.request(modes.AUTO_RTL)
    assert flight.setpoint["task"] == TASK_LAND


@pytest.mark.parametrize(("mode", "headings"), [(0, (NAN, -math.pi / 2, NAN)), (1, (0.5,) * 3), (2, (NAN,) * 3)])
def test_the_heading_of_a_return(mode, headings):
    """PX4 rtl.cpp: RTL_HDG_MD, while climbing, returning and landing; NaN keeps the heading."""
    flight = flying(0.0, 70.0, RTL_HDG_MD=mode)
    flight.commander.navigator.home = replace(flight.commander.navigator.home, yaw=0.5)
    flight.commander.request(modes.AUTO_RTL)
    found = [float(flight.setpoint["goal_yaw"])]
    flight.tick()
    found.append(float(flight.setpoint["goal_yaw"]))
    for _ in range(3):
        flight.tick()
    assert flight.setpoint["task"] == TASK_LAND
    found.append(float(flight.setpoint["goal_yaw"]))
    assert found == pytest.approx(headings, nan_ok=True)


def test_heights_are_over_the_destination():
    flight = flying(0.0, 70.0)
    flight.load(*RALLY, kind=plan.RALLY)
    flight.commander.request(modes.AUTO_RTL)
    assert flight.goal() == [0, 70, -50]
    assert "RTL: climb to 538 m (30 m above destination)" in flight.texts()
    for _ in range(4):
        flight.tick()
    assert flight.goal()[:2] == [0, 100]
    assert flight.setpoint["task"] == TASK_LAND


def test_waiting_at_the_end():
    flight = flying(40.0, RTL_LAND_DELAY=2.0)
    flight.commander.request(modes.AUTO_RTL)
    for _ in range(4):
        flight.tick()
    assert "RTL: loiter 2.0s" in flight.texts()
    assert flight.setpoint["task"] == TASK_GOTO
    flight.run(2.1)
    assert flight.setpoint["task"] == TASK_LAND


# geofence


def test_no_fence_no_breach():
    assert flying(5000).commander.navigator.geofence_breach() == ""


@pytest.mark.parametrize(
    ("parameters", "place", "breach"),
    [
        ({"GF_MAX_HOR_DIST": 50}, (49, 0, -10), ""),
        ({"GF_MAX_HOR_DIST": 50}, (40, 40, -10), "Maximum distance from home exceeded by 6.6 m"),
        ({"GF_MAX_VER_DIST": 30}, (0, 0, -31), "Maximum altitude above home exceeded by 1.0 m"),
        ({"GF_MAX_VER_DIST": 30, "GF_ACTION": 0}, (0, 0, -31), ""),
    ],
)
def test_distances_from_home(parameters, place, breach):
    flight = flying(**parameters)
    flight.place(*place)
    assert flight.commander.navigator.geofence_breach() == breach


def test_areas():
    flight = flying()
    navigator = flight.commander.navigator
    corners = [(-20, -20), (20, -20), (20, 20), (-20, 20)]
    square = [at(n, e, 0, plan.FENCE_INCLUSION, 4.0) for n, e in corners]
    flight.load(*square, at(0, 10, 0, plan.FENCE_CIRCLE_EXCLUSION, 5.0), kind=plan.FENCE)
    for place, allowed in [
        ((0, 0), True),
        ((19.9, -19.9), True),
        ((20.1, 0), False),
        ((0, 10), False),
        ((0, 4.9), True),
    ]:
        flight.place(*place, -10)
        assert (navigator.geofence_breach() == "") is allowed, place
    flight.load(kind=plan.FENCE)
    flight.place(50, 0, -10)
    assert navigator.geofence_breach() == ""


def test_prediction_looks_where_the_vehicle_stops():
    flight = flying(GF_MAX_HOR_DIST=50, GF_PREDICT=1)
    flight.place(45, 0, -10)
    assert flight.commander.navigator.geofence_breach() == ""
    flight.autopilot.estimator[0]["velocity"] = (6.0, 0.0, 0.0)  # stops after 6 m
    assert flight.commander.navigator.geofence_breach() == "Maximum distance from home exceeded by 1.0 m"


def test_the_source_can_be_the_gps():
    flight = flying(GF_MAX_HOR_DIST=50, GF_SOURCE=1)
    latitude, longitude, altitude = flight.commander.view.to_global((60.0, 0.0, -10.0))
    for field, value in (("gps_lat", latitude), ("gps_lon", longitude), ("gps_alt", altitude)):
        flight.autopilot.sensors[0][field] = value
    assert "10.0 m" in flight.commander.navigator.geofence_breach()


# precision landing


def see(flight, north, east):
    flight.commander.navigator.set_landing_target((north, east, 0.0))


def test_a_target_is_approached_and_landed_on():
    flight = flying(LTEST_MODE=1)
    see(flight, 2.0, 1.0)
    assert flight.commander.request(modes.AUTO_PRECLAND) == 0
    assert (flight.setpoint["task"], flight.goal()) == (TASK_GOTO, [2, 1, -10])
    flight.follow()
    flight.run(1.3, lambda: see(flight, 2.0, 1.0))
    assert flight.setpoint["task"] == TASK_LAND
    flight.run(0.2, lambda: see(flight, 2.2, 1.1))  # the nearer the vehicle, the better the view
    assert flight.goal() == [2.2, 1.1, 0]
    flight.place(2.2, 1.1, -0.05)
    flight.run(0.1, lambda: see(flight, 9.0, 9.0))
    assert flight.goal() == [2.2, 1.1, 0]


def test_a_target_that_is_lost_is_searched_for():
    flight = flying()
    see(flight, 2.0, 1.0)
    flight.commander.request(modes.AUTO_PRECLAND)
    flight.run(5.2)
    assert "Lost landing target while landing" in flight.texts()
    assert (flight.setpoint["task"], flight.goal()) == (TASK_GOTO, [0, 0, -10])
    flight.run(3.0)
    see(flight, -1.0, 0.0)
    flight.run(0.1)
    assert flight.goal()[:2] == [-1, 0]


def test_without_a_target_it_lands_after_a_search():
    flight = flying()
    flight.commander.request(modes.AUTO_PRECLAND)
    flight.run(0.3)
    assert flight.setpoint["task"] == TASK_GOTO
    flight.run(10.0)
    assert flight.setpoint["task"] == TASK_LAND
    assert "Search timed out, landing normally" in flight.texts()


@pytest.mark.parametrize(("mode", "task"), [(0.0, TASK_LAND), (1.0, TASK_LAND), (2.0, TASK_GOTO)])
def test_a_mission_lands_precisely_in_the_mode_of_its_item(mode, task):
    flight = flying()
    flight.load(at(0, 0), at(0, 0, 0, plan.LAND, 0, mode))
    flight.commander.request(modes.AUTO_MISSION)
    flight.tick()
    assert flight.setpoint["task"] == task


def test_angles_to_a_place():
    place = from_angles(math.atan(0.5), math.atan(0.25), 8.0, (10.0, 20.0, -8.0), math.pi / 2)
    assert place == pytest.approx((8.0, 24.0, 0.0))
    assert math.isnan(from_angles(2.0, 0.0, 8.0, (0.0, 0.0, -8.0), 0.0)[0])


def test_a_return_of_the_mission_is_announced_once_it_is_accepted(monkeypatch):
    flight = flying()
    flight.load(at(0, 0, 10), do(plan.SET_HOME, 0, 0, 0, 90.0), do(plan.RETURN))
    headings = []
    monkeypatch.setattr(flight.commander.navigator.mission, "set_home", lambda _location, yaw: headings.append(yaw))
    monkeypatch.setattr(flight.commander, "_can_choose", lambda mode: mode is not modes.AUTO_RTL)
    flight.commander.request(modes.AUTO_MISSION)
    flight.follow()
    flight.run(1.0)
    assert headings == [pytest.approx(math.pi / 2.0)]
    assert "Returning to launch" not in flight.texts()
    monkeypatch.undo()
    flight.run(1.0)
    assert flight.texts().count("Returning to launch") == 1
