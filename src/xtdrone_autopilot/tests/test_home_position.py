"""Home position after PX4 v1.14's HomePosition.cpp and Commander.cpp: what sets it, follows and leaves it."""

from __future__ import annotations

import math

import pytest
from autopilot_fakes import ORIGIN, Flight
from mission_fakes import at

from xtdrone_autopilot.commander.commander import Result
from xtdrone_autopilot.mavlink.streams.telemetry import Telemetry
from xtdrone_autopilot.navigator import plan
from xtdrone_common import modes

EPH, EPV = 0.4, 0.6
NAN = math.nan


def standing(**parameters):
    """Return a disarmed vehicle at home, with the accuracies EPH and EPV of its local estimate."""
    flight = Flight(**parameters)
    flight.autopilot.estimator["eph"], flight.autopilot.estimator["epv"] = EPH, EPV
    return flight


def move(flight, north, east, down):
    """Move a vehicle that stays on the ground."""
    flight.autopilot.estimator[0]["position"] = (north, east, down)
    flight.run(0.1)


def place(flight):
    return flight.commander.home.position


@pytest.mark.parametrize(
    ("north", "east", "down", "follows"),
    [
        (2.0 * EPH - 0.01, 0.0, 0.0, False),
        (2.0 * EPH + 0.01, 0.0, 0.0, True),
        (1.2 * EPH, 1.2 * EPH, 0.0, False),
        (1.5 * EPH, 1.5 * EPH, 0.0, True),
        (0.0, 0.0, 2.0 * EPV - 0.01, False),
        (0.0, 0.0, 2.0 * EPV + 0.01, True),
        (0.0, 0.0, -2.0 * EPV - 0.01, True),
        (5.0, 0.0, 0.0, True),
    ],
)
def test_home_follows_a_disarmed_vehicle_beyond_twice_its_accuracy(north, east, down, follows):
    flight = standing()
    move(flight, north, east, down)
    assert place(flight) == ((north, east, down) if follows else (0.0, 0.0, 0.0))
    where = flight.commander.view.to_global(place(flight))
    home = flight.commander.home
    assert (home.latitude, home.longitude, home.altitude) == pytest.approx(where)


def test_the_accuracy_is_that_of_now():
    flight = standing()
    flight.autopilot.estimator["eph"] = 10.0
    move(flight, 5.0, 0.0, 0.0)
    assert place(flight) == (0.0, 0.0, 0.0)
    flight.autopilot.estimator["eph"] = 2.4
    flight.run(0.1)
    assert place(flight) == (5.0, 0.0, 0.0)


def test_home_stays_while_the_vehicle_is_armed_and_follows_where_it_has_landed():
    flight = standing()
    flight.commander.arm_disarm(True)
    move(flight, 3.0, 0.0, 0.0)
    assert place(flight) == (0.0, 0.0, 0.0), "armed on the ground"
    flight.autopilot.control[0]["landing"]["landed"] = 0
    flight.run(0.1)
    assert place(flight) == (3.0, 0.0, 0.0), "the takeoff"
    flight.place(20.0, 5.0, -10.0)
    flight.run(1.0)
    flight.place(20.0, 5.0, 0.0)
    flight.run(0.1)
    assert place(flight) == (3.0, 0.0, 0.0), "landed, but armed"
    flight.commander.arm_disarm(False)
    assert place(flight) == (3.0, 0.0, 0.0)
    flight.run(0.1)
    assert place(flight) == (20.0, 5.0, 0.0)
    flight.place(50.0, 5.0, -20.0)
    flight.run(0.1)
    assert place(flight) == (20.0, 5.0, 0.0), "disarmed in the air"


def test_arming_by_command_sets_home_and_arming_by_a_mission_waits_for_the_takeoff():
    flight = standing()
    flight.autopilot.estimator["eph"] = 10.0
    move(flight, 3.0, 0.0, 0.0)
    flight.commander.arm_disarm(True)
    assert place(flight) == (3.0, 0.0, 0.0)
    flight = standing()
    flight.autopilot.estimator["eph"] = 10.0
    move(flight, 3.0, 0.0, 0.0)
    flight.commander.navigator.set_plan(plan.MISSION, [at(20.0, 0.0, 10.0, plan.TAKEOFF), at(40.0, 0.0)])
    assert flight.commander.commands.start_mission(0.0) is Result.ACCEPTED
    assert place(flight) == (0.0, 0.0, 0.0)


def test_a_home_set_by_command_stays_until_one_is_set_here():
    flight = standing()
    assert flight.commander.commands.set_home((ORIGIN[0] + 1e-4, ORIGIN[1], 500.0), -1.0) is Result.ACCEPTED
    home = flight.commander.home
    assert home.manual
    assert home.yaw == pytest.approx(math.tau - 1.0)
    assert home.position == pytest.approx((11.1, 0.0, -12.0), abs=0.1)
    move(flight, 5.0, 0.0, 0.0)
    flight.commander.arm_disarm(True)
    flight.place(5.0, 0.0, -10.0)
    flight.run(0.2)
    flight.place(9.0, 0.0, 0.0)
    flight.commander.arm_disarm(False)
    flight.run(0.2)
    assert flight.commander.home is home
    assert flight.commander.commands.set_home(None) is Result.ACCEPTED
    assert place(flight) == (9.0, 0.0, 0.0)
    move(flight, 5.0, 0.0, 0.0)
    assert place(flight) == (5.0, 0.0, 0.0), "no longer manual"


def test_an_unknown_heading_of_home_is_sent_as_nan():
    flight = standing()
    assert flight.commander.commands.set_home((*ORIGIN[:2], 488.0), NAN) is Result.ACCEPTED
    values = Telemetry(flight.commander, flight.autopilot, 0).flight.home_position()
    assert math.isnan(values[6])
    assert values[:3] == (round(ORIGIN[0] * 1e7), round(ORIGIN[1] * 1e7), 488_000)


def test_without_com_home_en_home_is_neither_set_nor_accepted():
    flight = standing(COM_HOME_EN=0)
    flight.commander.arm_disarm(True)
    flight.place(0.0, 0.0, -5.0)
    flight.run(0.2)
    assert flight.commander.home is None
    for location in (None, ORIGIN):
        assert flight.commander.commands.set_home(location) is Result.DENIED
    assert flight.commander.commands.return_to_launch() is Result.TEMPORARILY_REJECTED


@pytest.mark.parametrize(("in_air", "north"), [(0, None), (1, 3.0)])
def test_a_home_missing_in_the_air(in_air, north):
    """With COM_HOME_IN_AIR it is where the vehicle took off, at the altitude at which PX4 v1.14 leaves it."""
    flight = standing(COM_HOME_IN_AIR=in_air)
    flight.autopilot.estimator["global_valid"] = 0
    flight.commander.navigator.home = None
    move(flight, 3.0, 0.0, 0.0)
    flight.hover()
    flight.commander.request(modes.OFFBOARD)
    flight.commander.arm_disarm(True, force=True)
    flight.place(30.0, 0.0, -10.0)
    flight.run(0.5, flight.hover)
    assert flight.commander.home is None
    flight.autopilot.estimator["global_valid"] = 1
    flight.run(0.2, flight.hover)
    if north is None:
        assert flight.commander.home is None
        return
    assert place(flight) == (north, 0.0, 0.0)
    assert flight.commander.home.altitude == pytest.approx(ORIGIN[2] + 10.0)
    assert flight.commander.home.latitude == pytest.approx(flight.commander.view.to_global((north, 0.0, 0.0))[0])


def test_the_heading_of_home_follows_a_reset_of_the_estimate():
    flight = standing()
    e = flight.autopilot.estimator[0]
    e["shifts"]["heading"] = 0.3
    e["resets"]["heading"] += 1
    flight.run(0.3)
    assert flight.commander.home.yaw == pytest.approx(0.3)


def test_a_mission_is_built_round_the_new_place():
    """The first waypoint's distance and relative altitudes count from where the vehicle stands."""
    flight = standing()
    move(flight, 200.0, 0.0, 4.0)
    assert flight.commander.home.altitude == pytest.approx(ORIGIN[2] - 4.0)
    flight.commander.arm_disarm(True)
    flight.place(260.0, 0.0, -10.0)
    flight.run(0.2)
    assert flight.commander.commands.return_to_launch() is Result.ACCEPTED
    assert "RTL: climb to 514 m (30 m above destination)" in flight.texts()
