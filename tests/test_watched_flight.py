"""A flight with all bridges, a client of all topics and the doctor is, to the last bit, the flight without them."""

from __future__ import annotations

import subprocess
import sys
import threading
from pathlib import Path

import pytest
from conftest import REPOSITORY, START_LIMIT, WALL_LIMIT, Graph, Stack, poll, wait_for_ports

pytest.importorskip("rospy")
pytest.importorskip("websockets")

import rospy
from foxglove_client import FoxgloveClient
from test_doctor_flight import doctor
from websockets.exceptions import ConnectionClosed

from validation.replay.digest_comparison import Digests, compare, read_digests

FLEET = "iris:1"
HELLO = REPOSITORY / "src" / "xtdrone_control" / "examples" / "hello.py"
POSE = "/iris_0/mavros/local_position/pose"
FOXGLOVE = 8765
BRIDGES = ("foxglove:=true", "rosbridge:=true", "ros2:=true")
FLYING = "OFFBOARD, armed"


class _Everything(threading.Thread):
    """A client of Foxglove's bridge that subscribes to every topic."""

    def __init__(self) -> None:
        super().__init__(daemon=True)
        self.client = FoxgloveClient(FOXGLOVE)
        self.subscribed: set[str] = set()
        self.running = True

    def run(self) -> None:
        try:
            while self.running:
                for topic in set(self.client.channels) - self.subscribed:
                    self.subscribed.add(topic)
                    self.client.subscribe(topic)
                self.client.take()
        except ConnectionClosed:
            pass


def _fly(graph: Graph, folder: Path, watched: bool) -> Digests:
    folder.mkdir()
    graph.forget()
    wait_for_ports(FLEET)
    stack = Stack(graph, folder, FLEET)
    file = folder / "digest.jsonl"
    try:
        stack.launch(
            "multi_vehicle.launch",
            f"vehicles:={FLEET}",
            "speed:=5",  # slow enough for a report in the air
            "participants:=/mavros,/drone_script",
            f"digest:={file}",
            *(BRIDGES if watched else ()),
        )
        poll(lambda: rospy.has_param("/lockstep/uri"), "the simulator offers its lockstep", START_LIMIT)
        if watched:  # time does not run before the script has joined
            poll(lambda: rospy.has_param("/foxglove_bridge/actual_port"), "the bridge listens", START_LIMIT)
            watcher = _Everything()
            watcher.start()
            poll(lambda: POSE in watcher.subscribed, "it watches the poses", START_LIMIT)
        script = stack.start("script", [sys.executable, str(HELLO)])
        if watched:
            _examine(graph, script.process)
        assert script.end() == 0, script.output
        if watched:
            watcher.running = False
            assert watcher.client.received[watcher.client.channels[POSE]["id"] + 1000]
    finally:
        stack.stop()
    return read_digests(file)


def _examine(graph: Graph, process: subprocess.Popen[bytes]) -> None:
    """Run the doctor repeatedly until it has seen the flight."""
    reports = [doctor(graph)[1]]
    while FLYING not in reports[-1] and process.poll() is None:
        reports.append(doctor(graph)[1])
    assert FLYING in reports[-1], reports


@pytest.mark.timeout(2 * START_LIMIT + 2 * WALL_LIMIT)
def test_watching_changes_no_bit_of_a_flight(graph: Graph, tmp_path: Path) -> None:
    alone, watched = (_fly(graph, tmp_path / name, name == "watched") for name in ("alone", "watched"))
    # the last lines are written when the simulators are stopped
    comparison = compare(alone, watched, min(alone.end, watched.end) // 1_000_000 * 1_000_000 - 1_000_000)
    assert comparison.same, comparison
    assert comparison.time > 20.0
