"""Nodes that are killed in flight: the formation flies on without their vehicle, the same way each time."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from conftest import START_LIMIT, WALL_LIMIT, Graph, Stack, poll

pytest.importorskip("rospy")

import rosgraph
from rospy import Time
from std_srvs.srv import Empty
from xtdrone_msgs.srv import Step

from xtdrone_interaction.missions.formation.state_machine import COMMAND_LIMIT

FLIGHT_LIMIT = 300.0  # s of wall time
COMMUNICATION, FOLLOWER = "multirotor_communication.py iris {} ", "follower_consensus.py iris {} "


def kill(stack: Stack, command: str) -> None:
    """Kill the one process whose command line has ``command``, by SIGKILL."""
    [pid] = [pid for pid, line in stack.processes().items() if command in line]
    os.kill(pid, signal.SIGKILL)


def fly(graph: Graph, folder: Path, count: int, kills: dict[float, str]) -> list[dict[str, Any]]:
    """Fly the formation of simplified vehicles; kill nodes at simulated times (s); return the director's events."""
    folder.mkdir()
    graph.forget()
    stack = Stack(graph, folder, f"iris:{count}")
    try:
        launch = stack.launch(
            "formation.launch", "simulator:=simplified", f"n:={count}", "patterns:=cube", "processes:=per_uav",
            "speed:=0", "paused:=true", f"out:={folder}", "bag:=none",
        )  # fmt: skip
        master = rosgraph.Master("/system_tests")
        poll(lambda: master.hasParam("/lockstep/uri"), "the simulator offers its lockstep", START_LIMIT)
        for time, command in kills.items():
            step = partial(graph.call, "/simulator/step", Step, until=Time(time))
            poll(lambda step=step: step().success, "all have joined, and the step is done", START_LIMIT)
            kill(stack, command)
        graph.call("/gazebo/unpause_physics", Empty)
        launch.end(FLIGHT_LIMIT)
        lines = (folder / "events.jsonl").read_text(encoding="utf-8").splitlines()
        events = [json.loads(line) for line in lines]
        for event in events:
            del event["wall"]
        return events
    finally:
        stack.stop()
        graph.forget()


@pytest.mark.timeout(2 * FLIGHT_LIMIT + 60.0)
def test_the_flight_continues_without_dead_nodes_and_is_repeatable(graph: Graph, tmp_path: Path) -> None:
    kills = {18.0: COMMUNICATION.format(3), 25.0: FOLLOWER.format(2)}
    first, second = (fly(graph, tmp_path / name, 4, kills) for name in ("first", "second"))
    assert first == second
    lost = {event["vehicle"]: event for event in first if event["event"] == "lost"}
    assert set(lost) == {"iris_2", "iris_3"}
    assert lost["iris_3"]["reason"].startswith("is armed in mode 'POSCTL'")
    assert 18.0 < lost["iris_3"]["time"] < 21.0  # a second until the vehicle times out and its state arrives
    assert lost["iris_2"]["reason"].startswith("no command of its follower")
    assert lost["iris_2"]["time"] == pytest.approx(25.0 + COMMAND_LIMIT, abs=0.15)
    assert first[-1]["event"] == "done"
    assert first[-1]["lost"] == ["iris_2", "iris_3"]
    phases = [event["phase"] for event in first if event["event"] == "phase"]
    assert phases[-2:] == ["descend", "land"]


@pytest.mark.timeout(FLIGHT_LIMIT + 60.0)
def test_a_leader_whose_node_is_killed_lands_all(graph: Graph, tmp_path: Path) -> None:
    events = fly(graph, tmp_path / "flight", 3, {18.0: "leader.py iris 3 "})
    assert events[-1]["event"] == "failed"
    assert events[-1]["reason"] == "leader: its node has published no pattern for 5 s"
    [given_up] = [event for event in events if event["event"] == "giving up"]
    assert events[-1]["time"] - given_up["time"] < 60.0  # they land; the director waits for none of the lost ones


@pytest.mark.timeout(FLIGHT_LIMIT + START_LIMIT)
def test_the_demo_ends_with_a_table_that_names_the_vehicle(tmp_path: Path) -> None:
    """The flight is in full physics, where PX4's failsafe takes over."""
    out = tmp_path / "out"
    command = [sys.executable, "-m", "xtdrone_interaction.cli"]
    demo = subprocess.Popen(
        [*command, "demo", "formation", "--n", "3", "--patterns", "cube", "--headless", "--out", str(out)],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    try:
        poll(lambda: "climb" in _text(out / "events.jsonl") or demo.poll() is not None, "they climb", START_LIMIT)
        os.kill(_node(out, COMMUNICATION.format(2)), signal.SIGKILL)
        output, _ = demo.communicate(timeout=FLIGHT_LIMIT)
    finally:
        demo.kill()
        demo.wait(WALL_LIMIT)
    assert demo.returncode == 1, output
    assert "iris_2 is lost, the flight continues: is armed in mode" in output
    assert "Formation flight of 3 vehicles" in output
    assert "Missed: iris_2 was lost at" in output
    assert "iris_2_communication has died" in output
    report = json.loads((out / "report.json").read_text(encoding="utf-8"))
    assert report["outcome"] == "done"
    assert [item["vehicle"] for item in report["lost"]] == ["iris_2"]
    assert [item["pattern"] for item in report["reconfigurations"]] == ["origin", "cube", "origin"]
    assert all(item["settling_time"] is not None for item in report["reconfigurations"])


def _text(file: Path) -> str:
    return file.read_text(encoding="utf-8") if file.is_file() else ""


def _node(out: Path, command: str) -> int:
    """Return the process of a demo that writes to ``out``."""
    for entry in Path("/proc").iterdir():
        try:
            line = (entry / "cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace")
            if command in line and str(out).encode() in (entry / "environ").read_bytes():
                return int(entry.name)
        except (OSError, ValueError):  # no process, or one that has ended
            continue
    raise AssertionError(f"no process {command!r}")
