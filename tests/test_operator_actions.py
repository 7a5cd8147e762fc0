"""A session on the page is recorded; its actions, repeated on another simulation, result in the same flight."""

from __future__ import annotations

import itertools
import json
import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from conftest import START_LIMIT, WALL_LIMIT, Graph, Stack, free_port, poll, wait_for_ports

pytest.importorskip("rospy")
pytest.importorskip("websockets")

import rospy
from websockets.sync.client import connect

from validation.replay.digest_comparison import Digests, compare, read_digests
from xtdrone_interaction.web.actions.recorded_actions import read_actions

FLEET = "iris:2"
URL = re.compile(r"station \(operate\): (\S+)")


def fly(graph: Graph, folder: Path, act: Callable[[Stack], None], *options: str) -> Digests:
    """Fly while ``act`` acts; return the digests. ``options`` are of the launch file."""
    folder.mkdir()
    wait_for_ports(FLEET)
    stack = Stack(graph, folder, FLEET)
    file = folder / "digest.jsonl"
    arguments = (f"vehicles:={FLEET}", "participants:=/mavros,/communication", f"digest:={file}", *options)
    try:
        stack.launch("multi_vehicle.launch", *arguments)
        poll(lambda: rospy.has_param("/lockstep/uri"), "the simulator offers its lockstep", START_LIMIT)
        stack.run("communication", "xtdrone_control", "multirotor_communication.py", "iris", "0-1")
        act(stack)
    finally:
        stack.stop()
    graph.forget()
    return read_digests(file)


class Page:
    """The messages that a page sends for a user's clicks and keys."""

    def __init__(self, url: str) -> None:
        self._socket = connect(url.replace("http", "ws") + "ws", max_size=None)
        self._numbers = itertools.count(1)
        self.call("hello", token="")

    def call(self, method: str, **params: Any) -> Any:
        """Return the result of a method."""
        number = next(self._numbers)
        self._socket.send(json.dumps({"id": number, "method": method, "params": params}))
        while True:
            message = self._socket.recv(timeout=WALL_LIMIT)
            answer = json.loads(message) if isinstance(message, str) else {}
            if answer.get("id") == number:
                assert "error" not in answer, answer
                return answer["result"]

    def close(self) -> None:
        self._socket.close()


def operate(page: Page, stack: Stack) -> None:
    """Take off, go to a place as a group, hover, steer by keys, land."""
    names = [vehicle.name for vehicle in stack.vehicles]

    def command(action: str, **params: Any) -> bool:
        results = page.call("vehicles.command", vehicles=names, action=action, **params).values()
        return all(result["ok"] for result in results)

    stack.wait(lambda: command("takeoff"), "they take off", sim=60.0)
    stack.wait(lambda: stack.height(1) > 1.0, "they climb", sim=60.0)
    assert command("goto", place=[4, 2, 3])
    stack.pass_time(0.5)
    page.call("swarm.command", text="HOVER", vehicles=names)
    page.call("steering.open", vehicles=names)
    for key in "iiw":
        page.call("steering.key", key=key)
    stack.pass_time(0.5)
    page.call("steering.close")
    assert command("land")
    stack.pass_time(2.0)


def test_a_recorded_session_is_repeated_to_the_last_bit(graph: Graph, tmp_path: Path) -> None:
    def recorded(stack: Stack) -> None:
        rospy.set_param("/web_station/recordings", str(tmp_path))
        station = stack.run("web_station", "xtdrone_interaction", "web_station.py", f"_port:={free_port()}")
        url = poll(lambda: URL.search(station.output), "the station prints its URL")[1]
        poll(lambda: rospy.get_param("/xtdrone/fleet", ""), "the fleet is known")
        page = Page(url)
        poll(lambda: page.call("fleet.roster")["vehicles"], "the station knows the fleet")
        page.call("recordings.start", profile="light")
        operate(page, stack)
        page.call("recordings.stop")
        page.close()

    def repeated(stack: Stack) -> None:
        arguments = ("-m", "xtdrone_interaction", "replay-actions", str(bag))
        status = stack.start("replay", [sys.executable, *arguments]).end(START_LIMIT)
        assert status == 0, stack.programs["replay"].output
        assert "vehicles.command: done by iris_0, iris_1" in stack.programs["replay"].output
        stack.wait(lambda: stack.time > first.end * 1e-6, "the flight is as long as the first", sim=1000.0)

    first = fly(graph, tmp_path / "recorded", recorded, "speed:=2")
    (bag,) = tmp_path.glob("*.bag")
    actions = read_actions([bag])
    assert {action.method for action in actions} == {"vehicles.command", "swarm.command", "steering.send"}
    assert all(action.exact for action in actions)
    second = fly(graph, tmp_path / "repeated", repeated, "speed:=0", "paused:=true")
    result = compare(first, second, first.end // 1_000_000 * 1_000_000 - 1_000_000)
    assert result.same, result
    assert result.time > actions[-1].time
