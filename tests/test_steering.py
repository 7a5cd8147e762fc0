"""A vehicle in the real simulator flies by every kind of MAVROS's setpoints, published by steering_pilot.py."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from conftest import Graph, Stack, poll, wait_for_ports

pytest.importorskip("rospy")

import rosgraph
import rospy
from std_msgs.msg import String
from steering_pilot import MAVROS, QUATERNION

FLEET = "iris:1"
PLACE = 0.4  # m, greatest error of a settled vehicle
Leg = tuple[list[float], list[float]]


@pytest.fixture(scope="module")
def legs(graph: Graph, tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, Leg]]:
    """The pilot's report of its flight: true positions (m, ENU) at the start and end of each leg."""
    wait_for_ports(FLEET)
    stack = Stack(graph, tmp_path_factory.mktemp("steering"), FLEET)
    try:
        rospy.set_param(MAVROS + QUATERNION, True)
        stack.launch("multi_vehicle.launch", f"vehicles:={FLEET}", "speed:=0", "participants:=/mavros,/pilot")
        poll(lambda: rosgraph.Master("/system_tests").hasParam("/lockstep/uri"), "roslaunch starts a simulator")
        stack.start("pilot", [sys.executable, str(Path(__file__).with_name("steering_pilot.py"))])
        told = graph.hear("/pilot/flight", String)
        poll(lambda: told.last, f"the flight is told of; {stack.described()}")
        yield json.loads(told.last.data)
    finally:
        stack.stop()


def test_setpoint_raw_global_takes_it_there(legs: dict[str, Leg]) -> None:
    assert legs["services"] == [True, True]
    assert legs["raw global"][1] == pytest.approx([2.0, 3.0, 2.5], abs=PLACE)


@pytest.mark.parametrize(("name", "axis"), [("attitude east", 0), ("attitude north", 1)])
def test_setpoint_attitude_tilts_it_and_thrust_holds_it(legs: dict[str, Leg], name: str, axis: int) -> None:
    """A tilt of 0.1 rad gives about 1 m/s^2: about half a metre in 1.5 s, lag included."""
    begin, end = legs[name]
    assert 0.3 < end[axis] - begin[axis] < 1.2
    assert end[2] == pytest.approx(begin[2], abs=PLACE)


def test_setpoint_position_global_takes_it_there(legs: dict[str, Leg]) -> None:
    assert legs["global"][1] == pytest.approx([0.0, 6.0, 2.5], abs=2 * PLACE)


def test_global_to_local_sends_it_there(legs: dict[str, Leg]) -> None:
    assert legs["global to local"][1] == pytest.approx([2.0, 4.0, 2.5], abs=PLACE)


def test_setpoint_accel_pushes_it(legs: dict[str, Leg]) -> None:
    begin, end = legs["acceleration"]
    assert 0.1 < end[1] - begin[1] < 0.8
    assert end[0] == pytest.approx(begin[0], abs=PLACE)


def test_setpoint_trajectory_leads_it_along(legs: dict[str, Leg]) -> None:
    """The trajectory is 2 m at 1 m/s; part of it has been flown when the last point arrives."""
    begin, end = legs["trajectory"]
    assert 0.7 < end[0] - begin[0] < 2.5
    assert end[1] == pytest.approx(begin[1], abs=PLACE)


def test_manual_control_flies_it_by_hand(legs: dict[str, Leg]) -> None:
    """The stick points forward, and the vehicle faces east."""
    begin, end = legs["sticks"]
    assert 0.5 < end[0] - begin[0] < 4.0
    assert end[1:] == pytest.approx(begin[1:], abs=PLACE)
    assert legs["followed"] == pytest.approx([0.3, 0.5], abs=1e-3)
