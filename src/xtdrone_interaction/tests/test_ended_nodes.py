"""Nodes that end in flight: entries of roslaunch's log and their texts."""

from __future__ import annotations

from pathlib import Path

import pytest

from xtdrone_interaction.monitoring.ended_nodes import EndedNodes

BEFORE = "process[follower_2-12]: started with pid [7]\n"
KILLED = "\x1b[31m[follower_2-12] process has died [pid 7, exit code -9, cmd /x/f.py].\nlog file: /l*.log\x1b[0m\n"
DROPPED = "[WARN] [1795250671.65]: simulator: participant /follower_2 is gone: [Errno 104] reset; dropped, ...\n"


@pytest.fixture
def log(tmp_path: Path) -> Path:
    path = tmp_path / "roslaunch.log"
    path.write_text(BEFORE)
    return path


def add(log: Path, text: str) -> None:
    with log.open("a") as file:
        file.write(text)


@pytest.mark.parametrize("first", [True, False])
def test_a_killed_node_is_reported_once_with_its_signal(log: Path, first: bool) -> None:
    ended_nodes = EndedNodes(log)
    assert ended_nodes.update(11.0) == []
    add(log, DROPPED if first else KILLED)
    assert [ended.node for ended in ended_nodes.update(12.04)] == ["follower_2"]
    add(log, KILLED if first else DROPPED)
    assert ended_nodes.update(13.0) == []
    assert [str(d) for d in ended_nodes.found.values()] == [f"follower_2 has died (SIGKILL) at 12.0 s, see {log}"]
    assert next(iter(ended_nodes.found.values())).time == 12.04


@pytest.mark.parametrize(
    ("line", "text"),
    [
        ("[a/b-3] process has finished cleanly\n", "a/b has ended by itself at 1.0 s"),
        ("[a-3] process has died [pid 7, exit code 1, cmd x].\n", "a has died (exit code 1) at 1.0 s"),
        ("[WARN] [17.5, 66.2]: participant /a leaves: it has crashed: ValueError: no\n",
         "a has died (ValueError: no) at 66.2 s"),
        ("[WARN] [17.5]: simulator: participant /a has not answered for 60 s; dropped, the simulation goes on\n",
         "a was dropped by the simulator (has not answered for 60 s) at 1.0 s"),
    ],
)  # fmt: skip
def test_each_kind_of_end_has_its_text(log: Path, line: str, text: str) -> None:
    ended_nodes = EndedNodes(log)
    add(log, line[:12])
    assert ended_nodes.update(1.0) == [], "the line is not whole yet"
    add(log, line[12:])
    assert [str(ended) for ended in ended_nodes.update(1.0)] == [f"{text}, see {log}"]


def test_a_closed_or_crashed_window_does_not_affect_the_flight(log: Path) -> None:
    ended_nodes = EndedNodes(log)
    add(log, "[visualize-9] process has finished cleanly\n")
    assert ended_nodes.update(1.0) == []
    add(log, "[visualize-9] process has died [pid 7, exit code 1, cmd x].\n")
    assert [ended.matters for ended in ended_nodes.update(2.0)] == [False]
    add(log, KILLED)
    assert [ended.matters for ended in ended_nodes.update(3.0)] == [True]


def test_a_killed_station_or_bridge_takes_no_part_in_the_result(log: Path) -> None:
    ended_nodes = EndedNodes(log)
    for node in ("web_station", "foxglove_bridge", "rosbridge_websocket"):
        add(log, f"[{node}-9] process has died [pid 7, exit code -9, cmd x].\n")
    found = ended_nodes.update(1.0)
    assert [(ended.died, ended.matters) for ended in found] == [(True, False)] * 3  # shown, and no shortcoming


def test_the_ground_station_may_go_when_it_has_done_its_work(log: Path) -> None:
    ended_nodes = EndedNodes(log)
    add(log, "[upload_plans-9] process has finished cleanly\n")
    assert ended_nodes.update(1.0) == []
    add(log, "[upload_plans-9] process has died [pid 7, exit code 1, cmd x].\n")
    assert [ended.matters for ended in ended_nodes.update(2.0)] == [True]


@pytest.mark.parametrize("line", ["[leader-5] killing on exit\n", "Initiating shutdown!\n"])
def test_nodes_that_end_with_the_flight_are_not_reported(log: Path, line: str) -> None:
    add(log, line + KILLED)
    assert EndedNodes(log).update(1.0) == []


def test_the_file_with_the_traceback_is_reported(log: Path) -> None:
    own = log.parent / "run" / "follower_2-12-stdout.log"
    own.parent.mkdir()
    own.write_text("Traceback (most recent call last):\n")
    add(log, KILLED)
    assert EndedNodes(log).update(None)[0].log == str(own)


def test_no_log_yet_is_no_death(tmp_path: Path) -> None:
    assert EndedNodes(tmp_path / "roslaunch.log").update(None) == []


REQUIRED = "{line}REQUIRED process [{node}-2] has died!\nprocess has {how}\nlog file: /x*.log\nInitiating shutdown!\n"


def required(node: str, how: str) -> str:
    """Return roslaunch's text for the end of a required node."""
    return REQUIRED.format(line="=" * 80, node=node, how=how)


def test_a_required_nodes_normal_end_is_no_failure(log: Path) -> None:
    ended_nodes = EndedNodes(log)
    add(log, required("director", "finished cleanly"))
    assert ended_nodes.update(1.0) == []
    assert (ended_nodes.required is not None, ended_nodes.failure, ended_nodes.all()) == (True, None, [])


def test_a_failed_simulator_is_listed_before_its_participants(log: Path) -> None:
    """The order does not follow roslaunch's log, which may report a participant's end first."""
    ended_nodes = EndedNodes(log)
    add(log, "[follower_1-9] process has died [pid 9, exit code 1, cmd x].\n" + KILLED)
    add(log, required("simulator", "died [pid 7, exit code -9, cmd /x/simulator.py]."))
    add(log, "[leader-5] process has died [pid 5, exit code 1, cmd x].\n")
    ended_nodes.update(1.0)
    assert [str(ended).partition(" at")[0] for ended in ended_nodes.all()] == [
        "simulator has died (SIGKILL)",
        "follower_2 has died (SIGKILL)",  # killed, not ended because of the simulator
    ]
    assert ended_nodes.consequences == ["follower_1"]


def test_the_masters_end_is_reported(log: Path) -> None:
    ended_nodes = EndedNodes(log)
    add(
        log,
        REQUIRED.format(line="=", node="master", how="died [pid 7, exit code -9, cmd rosmaster].").replace("-2]", "]"),
    )
    ended_nodes.update(None)
    assert str(ended_nodes.failure).startswith("master has died (SIGKILL)")
