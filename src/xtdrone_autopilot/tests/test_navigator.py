"""AUTO modes: goals, phases, texts."""

from __future__ import annotations

import math

import pytest
from autopilot_fakes import ORIGIN, Flight
from mission_fakes import MissionFlight, at

from xtdrone_autopilot.commander.commander import Result
from xtdrone_autopilot.navigator import plan
from xtdrone_autopilot.state import TASK_GOTO, TASK_IDLE, TASK_LAND
from xtdrone_common import modes


@pytest.fixture
def flight():
    """An iris that hovers in AUTO.LOITER at 10 m, home at the origin."""
    flight = Flight()
    flight.commander.arm_disarm(True)
    flight.place(0.0, 0.0, -10.0)
    flight.run(0.1)
    flight.commander.request(modes.POSCTL)
    flight.commander.request(modes.AUTO_LOITER)
    flight.texts()
    return flight


def goal(flight):
    return flight.setpoint["goal_position"].tolist()


@pytest.mark.parametrize(("action", "loaded", "mode"), [
    (0, True, modes.AUTO_LOITER), (1, True, modes.AUTO_MISSION), (1, False, modes.AUTO_LOITER),
])  # fmt: skip
def test_the_mode_after_a_takeoff(action, loaded, mode):
    """PX4 Commander.cpp: COM_TAKEOFF_ACT."""
    flight = MissionFlight(COM_TAKEOFF_ACT=action)
    if loaded:
        flight.load(at(0, 0, command=plan.TAKEOFF), at(40, 0))
    flight.commander.commands.takeoff(math.nan, math.nan)
    flight.commander.arm_disarm(True)
    seen = []
    flight.run(3.0, lambda: (flight.follow(), seen.append(flight.commander.mode)))
    assert (modes.AUTO_MISSION in seen) == (mode is modes.AUTO_MISSION)
    assert modes.AUTO_LOITER in seen, "the mission ends in hold"


def test_takeoff_goes_to_loiter_within_the_altitude_radius():
    flight = Flight(MIS_TAKEOFF_ALT=5)
    flight.place(1.0, 2.0, 0.0)
    flight.commander.request(modes.AUTO_TAKEOFF)
    assert flight.setpoint["task"] == TASK_IDLE
    flight.commander.arm_disarm(True)
    assert (flight.setpoint["task"], goal(flight)) == (TASK_GOTO, [1.0, 2.0, -5.0])
    assert flight.setpoint["climb_speed"] == flight.parameters.get("MPC_TKO_SPEED")
    assert "Using minimum takeoff altitude: 5.00 m" in flight.texts()
    flight.place(1.0, 2.0, -4.1)
    flight.run(0.2)
    assert flight.commander.landed_state == 3
    flight.place(1.0, 2.0, -4.25)
    flight.run(0.1)
    assert flight.commander.mode is modes.AUTO_LOITER
    assert flight.commander.landed_state == 2
    assert goal(flight) == pytest.approx([1.0, 2.0, -4.25])


def test_takeoff_to_a_given_altitude():
    flight = Flight()
    assert flight.commander.commands.takeoff(ORIGIN[2] + 12.0, 1.0) is Result.ACCEPTED
    flight.commander.arm_disarm(True)
    assert goal(flight) == pytest.approx([0.0, 0.0, -12.0])
    assert flight.setpoint["goal_yaw"] == 1.0
    assert not any("minimum" in text for text in flight.texts())


def test_takeoff_is_raised_to_the_least_altitude():
    flight = Flight()
    flight.commander.commands.takeoff(ORIGIN[2] + 1.0, math.nan)
    flight.commander.arm_disarm(True)
    assert goal(flight) == pytest.approx([0.0, 0.0, -2.5])
    assert "Using minimum takeoff altitude: 2.50 m" in flight.texts()


def test_takeoff_to_infinity_is_denied():
    flight = Flight()
    assert flight.commander.commands.takeoff(math.inf, math.nan) is Result.DENIED
    assert flight.commander.mode is modes.AUTO_LOITER


def test_takeoff_in_the_air_does_not_descend(flight):
    flight.commander.commands.takeoff(ORIGIN[2] + 5.0, math.nan)
    assert goal(flight) == [0.0, 0.0, -10.0]
    assert "Already higher than takeoff altitude" in flight.texts()
    flight.run(0.1)
    assert flight.commander.mode is modes.AUTO_LOITER


def test_loiter_brakes_ahead(flight):
    flight.commander.request(modes.POSCTL)
    flight.autopilot.estimator["velocity"] = (3.0, 4.0, 0.5)
    flight.commander.request(modes.AUTO_LOITER)
    stop = 25.0 / (2 * 3.0) + 0.6 * 5.0  # the last term is the distance while the deceleration rises
    assert goal(flight) == pytest.approx([0.6 * stop, 0.8 * stop, -10.0])


def test_land_aims_at_homes_height(flight):
    flight.place(20.0, 5.0, -10.0)
    assert flight.commander.commands.land() is Result.ACCEPTED
    assert (flight.setpoint["task"], goal(flight)) == (TASK_LAND, [20.0, 5.0, 0.0])
    assert flight.texts() == ["Landing at current position"]


def test_return_climbs_flies_back_descends_and_lands(flight):
    flight.place(36.0, 10.0, -10.2)
    assert flight.commander.request(modes.AUTO_RTL) is Result.ACCEPTED
    assert goal(flight) == pytest.approx([36.0, 10.0, -30.0])
    flight.place(36.0, 10.0, -29.0)
    flight.run(0.2)
    assert goal(flight) == pytest.approx([36.0, 10.0, -30.0])
    flight.place(36.0, 10.0, -29.3)
    flight.run(0.1)
    assert goal(flight) == pytest.approx([0.0, 0.0, -30.0])
    assert flight.setpoint["goal_yaw"] == pytest.approx(math.atan2(-10.0, -36.0))
    flight.place(1.0, 1.0, -30.0)
    flight.run(0.1)
    assert goal(flight) == pytest.approx([0.0, 0.0, -10.0])
    assert flight.commander.landed_state == 2
    flight.place(0.0, 0.0, -10.5)
    flight.run(0.1)
    assert (flight.setpoint["task"], flight.commander.landed_state) == (TASK_LAND, 4)
    flight.place(0.0, 0.0, 0.0)
    flight.run(2.3)
    assert not flight.commander.armed
    assert flight.texts() == [
        "RTL HOME activated",
        "RTL: landing at home position.",
        "RTL: climb to 518 m (30 m above destination)",
        "RTL: return at 518 m (30 m above destination)",
        "RTL: descend to 498 m (10 m above destination)",
        "RTL: land at destination",
        "Landing detected",
        "Disarmed by landing",
    ]


@pytest.mark.parametrize(
    ("distance", "height", "expected"),
    [
        (100.0, 50.0, 50.0),  # higher already
        (11.0, 5.0, 30.0),  # outside the cone
        (8.0, 5.0, 8.0),  # inside: 45 degrees
        (3.0, 2.0, 4.0),  # at least twice the acceptance radius
        (0.5, 2.0, 2.0),  # above home: unchanged
    ],
)
def test_return_height(flight, distance, height, expected):
    flight.place(distance, 0.0, -height)
    flight.commander.request(modes.AUTO_RTL)
    assert goal(flight) == pytest.approx([distance, 0.0, -expected])


def test_return_waits_before_landing(flight):
    flight.parameters.set("RTL_LAND_DELAY", 3.0)
    flight.commander.request(modes.AUTO_RTL)
    flight.run(2.8, flight.follow)
    assert flight.setpoint["task"] == TASK_GOTO
    flight.run(1.0, flight.follow)
    assert flight.setpoint["task"] == TASK_LAND


def test_return_from_low_over_home_does_not_climb_to_descend(flight):
    flight.place(0.0, 0.0, -4.0)
    flight.commander.request(modes.AUTO_RTL)
    flight.run(0.3, flight.follow)
    assert flight.setpoint["task"] == TASK_LAND


def test_return_needs_a_home(flight):
    flight.commander.navigator.home = None
    assert flight.commander.commands.return_to_launch() is Result.TEMPORARILY_REJECTED
    assert flight.commander.mode is modes.AUTO_LOITER


def test_reposition(flight):
    target = flight.commander.view.to_global((30.0, 40.0, -20.0))
    assert flight.commander.commands.reposition(target, math.nan, 3.0) is Result.ACCEPTED
    assert goal(flight) == pytest.approx([30.0, 40.0, -20.0], abs=1e-6)
    assert flight.setpoint["goal_yaw"] == pytest.approx(math.atan2(40.0, 30.0))
    assert flight.setpoint["cruise_speed"] == 3.0


@pytest.mark.parametrize("place", [(math.inf, 8.5, 500.0), (91.0, 8.5, 500.0), (47.0, 8.5, -math.inf)])
def test_bad_reposition_is_denied(flight, place):
    before = goal(flight)
    assert flight.commander.commands.reposition(place, math.nan, math.nan) is Result.DENIED
    assert goal(flight) == before


def test_reposition_on_the_ground():
    """Disarmed it is accepted and selects the mode; armed it leads off the ground, as PX4's flight task allows."""
    flight = Flight()
    flight.commander.request(modes.AUTO_TAKEOFF)
    target = flight.commander.view.to_global((30.0, 40.0, -20.0))
    assert flight.commander.commands.reposition(target, math.nan, math.nan) is Result.ACCEPTED
    assert flight.commander.mode is modes.AUTO_LOITER
    flight.commander.arm_disarm(True)
    assert flight.setpoint["task"] == TASK_IDLE, "forgotten"
    assert flight.commander.commands.reposition(target, math.nan, math.nan) is Result.ACCEPTED
    assert flight.setpoint["task"] == TASK_GOTO
    assert goal(flight) == pytest.approx([30.0, 40.0, -20.0], abs=1e-6)


def repositioned(flight, north, east, up, yaw=math.nan, speed=math.nan):
    """Return goal, heading and speed after a DO_REPOSITION to a local position; NaN leaves values out."""
    latitude, longitude, _ = flight.commander.view.to_global((north, east, 0.0))
    place = (latitude, longitude, ORIGIN[2] + up)
    assert flight.commander.commands.reposition(place, yaw, speed) is Result.ACCEPTED
    return [*goal(flight), float(flight.setpoint["goal_yaw"]), float(flight.setpoint["cruise_speed"])]


def test_what_a_reposition_leaves_out(flight):
    """PX4's navigator keeps the goal's place, the vehicle's height, and brakes without place, height and heading."""
    nan = math.nan
    assert repositioned(flight, 30.0, 0.0, 20.0)[:4] == pytest.approx([30.0, 0.0, -20.0, 0.0], abs=1e-6)
    assert repositioned(flight, nan, nan, 12.0)[:3] == pytest.approx([30.0, 0.0, -12.0], abs=1e-6)
    assert repositioned(flight, nan, nan, nan, 1.5)[:4] == pytest.approx([30.0, 0.0, -10.0, 1.5], abs=1e-6)
    flight.autopilot.estimator[0]["velocity"] = (5.0, 0.0, 0.0)
    here = [*flight.commander.navigator._course.stopping_place(), 0.0]
    assert repositioned(flight, nan, nan, nan)[:4] == pytest.approx(here)
    assert here[0] > 5.0
    flight.commander.navigator.deactivate()
    assert repositioned(flight, nan, nan, 12.0)[:3] == pytest.approx([0.0, 0.0, -12.0]), "no goal in manual modes"


def test_a_speed_of_one_reposition_is_no_setting(flight):
    """PX4's navigator returns to its cruising speed: the default, or that of DO_CHANGE_SPEED."""
    speeds = [repositioned(flight, 30.0, 0.0, 10.0, speed=speed)[-1] for speed in (2.0, -1.0, 3.0, math.nan, 0.0)]
    assert speeds == pytest.approx([2.0, math.nan, 3.0, math.nan, math.nan], nan_ok=True)
    flight.commander.commands.change_speed(1, 4.0)
    speeds = [repositioned(flight, 30.0, 0.0, 10.0, speed=speed)[-1] for speed in (2.0, -1.0)]
    assert speeds == [2.0, 4.0]


def test_speed_change_lasts_until_a_return(flight):
    """As in PX4's navigator: it survives changes of mode, and rtl.cpp and a disarming reset it."""
    change = flight.commander.commands.change_speed
    assert change(1, 2.0) is Result.ACCEPTED
    assert flight.setpoint["cruise_speed"] == 2.0, "a ground speed acts at once"
    for mode in (modes.POSCTL, modes.AUTO_LAND, modes.AUTO_LOITER):
        flight.commander.request(mode)
        assert flight.setpoint["cruise_speed"] == 2.0
    flight.commander.request(modes.AUTO_RTL)
    assert math.isnan(flight.setpoint["cruise_speed"])
    for kind, given in ((0, 3.0), (2, 3.0), (3, 3.0), (9, 3.0), (math.nan, 3.0)):  # PX4 looks at ground speed only
        assert change(kind, given) is Result.ACCEPTED
        flight.commander.request(modes.AUTO_LOITER)
        assert flight.setpoint["cruise_speed"] == 3.0
        assert math.isnan(flight.setpoint["climb_speed"])
    for none in (-1.0, 0.0, -3.0, math.nan):
        change(1, 2.0)
        assert change(1, none) is Result.ACCEPTED
        flight.commander.request(modes.AUTO_LOITER)
        assert math.isnan(flight.setpoint["cruise_speed"])
    change(1, 2.0)
    flight.commander.arm_disarm(False, force=True)
    flight.commander.arm_disarm(True)
    flight.commander.request(modes.AUTO_LOITER)
    assert math.isnan(flight.setpoint["cruise_speed"])


def test_a_takeoff_ends_at_its_place_and_forgets_it(flight):
    place = flight.commander.view.to_global((6.0, 8.0, 0.0))[:2]
    assert flight.commander.commands.takeoff(ORIGIN[2] + 25.0, 1.0, place) is Result.ACCEPTED
    assert goal(flight) == pytest.approx([6.0, 8.0, -25.0], abs=1e-6)
    flight.commander.request(modes.AUTO_TAKEOFF)
    assert goal(flight)[:2] == [0.0, 0.0]
    assert math.isnan(flight.setpoint["goal_yaw"])


def test_speed_change_holds_through_a_reposition(flight):
    """After DO_CHANGE_SPEED to 3 m/s, PX4 v1.14.3 flew to a reposition at 2.91 m/s."""
    flight.commander.commands.change_speed(1, 3.0)
    place = (ORIGIN[0] + 0.001, ORIGIN[1], ORIGIN[2] + 5.0)
    assert flight.commander.commands.reposition(place, math.nan, -1.0) is Result.ACCEPTED
    assert flight.setpoint["cruise_speed"] == 3.0


def test_change_of_altitude_keeps_the_place(flight):
    assert flight.commander.commands.change_altitude(ORIGIN[2] + 15.0) is Result.ACCEPTED
    assert goal(flight) == pytest.approx([0.0, 0.0, -15.0])
    assert flight.commander.commands.change_altitude(math.nan) is Result.ACCEPTED, "at the vehicle's height"
    assert goal(flight) == pytest.approx([0.0, 0.0, -10.0])


def orbit(flight, *values):
    """Return radius, speed and centre's north after a DO_ORBIT round a place ``north`` of the origin, or NaN."""
    radius, speed, behaviour, north = values
    latitude, longitude, _ = flight.commander.view.to_global((north, 0.0, 0.0))
    assert flight.commander.commands.orbit(radius, speed, behaviour, (latitude, longitude, math.nan)) is Result.ACCEPTED
    s = flight.setpoint
    return [float(s["orbit_radius"]), float(s["orbit_speed"]), int(s["orbit_yaw"]), float(s["orbit_centre"][0])]


def test_an_orbit_keeps_its_values_and_the_next_one_takes_none_of_them(flight):
    """PX4's FlightTaskOrbit: NaN keeps a value while the task runs, and a new task starts from its defaults."""
    nan = math.nan
    assert orbit(flight, 10.0, 3.0, 2.0, 20.0) == pytest.approx([10.0, 3.0, 2, 20.0], abs=1e-6)
    assert orbit(flight, nan, 2.0, nan, nan) == pytest.approx([10.0, 2.0, 2, 20.0], abs=1e-6)
    assert orbit(flight, -8.0, nan, nan, 25.0) == pytest.approx([8.0, -2.0, 2, 25.0], abs=1e-6)
    assert orbit(flight, 8.0, -2.0, nan, nan) == pytest.approx([8.0, -2.0, 2, 25.0], abs=1e-6), "against its radius"
    flight.commander.request(modes.AUTO_LOITER)
    assert orbit(flight, nan, nan, nan, 30.0) == pytest.approx([1.0, 1.0, 0, 30.0], abs=1e-6)


def test_a_vehicle_holds_in_place_of_an_orbit_that_is_too_wide(flight):
    """PX4's flight mode manager replaces the task by its failsafe, which holds."""
    assert flight.commander.commands.orbit(1001.0, 2.0, 0.0, (*ORIGIN[:2], math.nan)) is Result.ACCEPTED
    assert flight.texts() == ["Orbit radius limit exceeded"]
    flight.run(1.0)
    assert flight.commander.mode is modes.ORBIT
    assert (flight.setpoint["task"], goal(flight)) == (TASK_GOTO, [0.0, 0.0, -10.0])
