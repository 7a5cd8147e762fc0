"""The planner in flight, with a lidar that freezes and one that is silent: it brakes, waits, and arrives in the end.

The same flight begins with commands by ``ego_transfer.py`` and ends with a goal by ``./xtdrone gcs goto --avoid``.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest
import rospy
from conftest import START_LIMIT, WALL_LIMIT, Stack, poll, wait_for_ports

PILOT = Path(__file__).with_name("planner_pilot.py")
WORLD = "forest:density=0.05,trunks=true,seed=4,length=50,width=30"

PARAMETERS = {"/lockstep/wait": True, "/use_sim_time": True, "/xtdrone/fleet": "iris_3d_lidar:1"}


def test_a_lidar_that_fails_in_flight_is_reported_and_does_no_harm(graph, tmp_path: Path) -> None:
    wait_for_ports("iris:1")
    record = tmp_path / "record.jsonl"
    for (
        name,
        value,
    ) in PARAMETERS.items():  # nodes may start before the launch file has set them
        rospy.set_param(name, value)
    stack = Stack(graph, tmp_path, "iris_3d_lidar:1")
    try:
        stack.launch(
            "multi_vehicle.launch", "vehicles:=iris_3d_lidar:1", "poses:=[[14,5]]", f"world:={WORLD}", "speed:=0",
            "lidars:=true", "participants:=/mavros,/lidars,/planner,/planner_pilot,/ego_transfer",
        )  # fmt: skip
        stack.run("ego_transfer", "xtdrone_planning", "ego_transfer.py", "iris_3d_lidar", "0")
        stack.run("planner", "xtdrone_planning", "planner.py", "iris_3d_lidar", "0")
        pilot = stack.start("planner_pilot", [sys.executable, str(PILOT), str(record), "__name:=planner_pilot"])
        poll(lambda: not pilot.alive, "the pilot's end", START_LIMIT + WALL_LIMIT)
    finally:
        stack.stop()
    lines = [json.loads(line) for line in record.read_text().splitlines()]
    assert lines[-1]["kind"] == "end", lines[-8:]
    states = [line["text"] for line in lines if line["kind"] == "state"]
    failed = ["following", "braking", "planning"]
    arrived = "following", "hovering at the goal"
    assert states[: -len(arrived) - 1] == ["waiting", "planning", *failed, *failed, *arrived]
    assert tuple(states[-len(arrived) :]) == arrived
    reports = [(line["level"], line["text"]) for line in lines if line["kind"] == "report"]
    assert (1, "waiting; a goal was dropped: the vehicle is not flying") in reports
    assert any(level == 2 and "sensor frozen: 4 equal measurements" in text for level, text in reports)
    assert any(level == 2 and "sensor silent for 0." in text for level, text in reports)
    assert reports[-1][0] == 0
    ends = [line["end"] for line in lines if line["kind"] == "trajectory"]
    assert all(end[2] < 5.0 for end in ends)  # the rejected goal, which was too high, was never flown to
    assert [40.0, 5.0, 2.0] in ends
    assert ends[-1] == [36.0, 3.0, 2.5]
    station = next(line for line in lines if line["kind"] == "station")
    assert station["status"] == 0, station
    assert "its planner flies there" in station["text"]
    ego = next(line for line in lines if line["kind"] == "ego")
    assert ego["mode"] == "OFFBOARD"
    assert ego["north"] == pytest.approx(3.0, abs=0.15)
    assert ego["off"] < 0.4
    assert ego["frame"] == "world"
    assert ego["lag"] < 0.05
    assert ego["camera"] == pytest.approx([-0.5, 0.5, -0.5, 0.5], abs=0.03)
