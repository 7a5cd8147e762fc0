"""Feasibility checks of a mission before its start, with the texts of PX4."""

from __future__ import annotations

import pytest
from mission_fakes import MissionFlight, at, do

from xtdrone_autopilot.commander.commander import Result
from xtdrone_autopilot.navigator import plan
from xtdrone_common import modes

TAKEOFF = at(0, 0, command=plan.TAKEOFF)
GOOD = at(20, 0)
VTOL = at(0, 0, 5, plan.VTOL_LAND)


@pytest.mark.parametrize(
    ("items", "text"),
    [
        ([GOOD, do(plan.CONDITION_DELAY, 3)], "Mission rejected: item 2: unsupported cmd: 112"),
        ([at(0, 0, 0, plan.LAND)], "Mission rejected: starts with landing"),
        ([at(950, 0)], "First waypoint too far away: 950m, 900 max"),
        ([at(0, 0, 0.0, plan.TAKEOFF), GOOD], "Mission rejected: Takeoff altitude below home altitude!"),
        ([GOOD, TAKEOFF], "Mission rejected: takeoff not first waypoint item"),
        (
            [GOOD, at(0, 0, 5, plan.VTOL_LAND)],
            "Mission rejected: Mission contains VTOL items but vehicle is not a VTOL",
        ),
        ([GOOD, at(20, 0, 10, plan.CONDITION_GATE)], "Distance between waypoint and gate too close: 0 meters"),
    ],
)
def test_rejected(items, text):
    flight = MissionFlight()
    flight.load(*items)
    assert flight.texts() == [text]
    assert flight.commander.navigator.mission_denial() == "No valid mission available"
    assert flight.texts() == []
    flight.commander.request(modes.AUTO_MISSION)
    assert flight.commander.arm_disarm(True) is Result.TEMPORARILY_REJECTED


@pytest.mark.parametrize(
    ("required", "items", "text"),
    [
        (1, [GOOD], "Mission rejected: Takeoff waypoint required."),
        (2, [TAKEOFF, GOOD], "Mission rejected: Landing waypoint/pattern required."),
        (3, [TAKEOFF, GOOD], "Mission rejected: Takeoff or Landing item missing."),
        (4, [TAKEOFF, GOOD], "Mission rejected: Add Landing item or remove Takeoff."),
        (4, [GOOD, at(20, 0, 0, plan.LAND)], "Mission rejected: Add Takeoff item or remove Landing."),
        (1, [TAKEOFF, GOOD], ""),
        (3, [TAKEOFF, at(20, 0, 0, plan.LAND)], ""),
        (4, [GOOD], ""),
    ],
)
def test_required_items(required, items, text):
    flight = MissionFlight(MIS_TKO_LAND_REQ=required)
    flight.load(*items)
    assert flight.texts() == [text] * bool(text)
    assert (flight.commander.navigator.mission_denial() == "") is (not text)


def test_a_waypoint_below_home_is_only_warned_of():
    flight = MissionFlight()
    flight.load(TAKEOFF, at(20, 0, -5.0))
    assert flight.texts() == ["Warning: Waypoint 2 below home"]
    assert flight.commander.navigator.mission_denial() == ""


def test_commands_may_precede_the_takeoff():
    flight = MissionFlight()
    flight.load(do(plan.CHANGE_SPEED, 1, 3), do(plan.GIMBAL_PITCHYAW, -45, 0), TAKEOFF, GOOD)
    assert flight.commander.navigator.mission_denial() == ""


def test_waypoints_must_be_inside_the_fence():
    flight = MissionFlight(GF_MAX_VER_DIST=50)
    flight.load(TAKEOFF, at(20, 0), at(20, 0, 60))
    assert flight.texts() == ["Geofence violation for waypoint 3"]
    flight.parameters.set("GF_MAX_VER_DIST", 0)
    flight.load(at(0, 0, 0, plan.FENCE_CIRCLE_INCLUSION, 30.0), kind=plan.FENCE)
    flight.load(TAKEOFF, at(40, 0))
    assert flight.texts() == ["Geofence violation for waypoint 2"]
    flight.load(kind=plan.FENCE)
    assert flight.commander.navigator.mission_denial() == ""


def test_the_first_distance_can_be_any():
    flight = MissionFlight(MIS_DIST_1WP=-1)
    flight.load(at(5000, 0))
    assert flight.commander.navigator.mission_denial() == ""


def test_a_mission_waits_for_home():
    flight = MissionFlight()
    flight.commander.navigator.home = None
    flight.load(TAKEOFF, GOOD)
    assert flight.commander.navigator.mission_denial()
    assert flight.texts() == []
    flight.run(0.1)
    assert flight.commander.home is not None
    assert flight.commander.navigator.mission_denial() == ""
