"""A flight with all bridges and a client of all topics is, to the last bit, the flight without them."""

from __future__ import annotations

import threading
from pathlib import Path

import pytest
from conftest import START_LIMIT, Graph, Stack, poll, wait_for_ports

pytest.importorskip("rospy")
pytest.importorskip("websockets")

import rospy
from foxglove_client import FoxgloveClient
from std_srvs.srv import Empty, EmptyRequest
from websockets.exceptions import ConnectionClosed

from xtdrone_interaction.sim_cli import SimError, call

POSE = "/iris_0/mavros/local_position/pose"
FOXGLOVE = 8765


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


def _digest(graph: Graph, folder: Path, watched: bool) -> bytes:
    """Fly two vehicles for some seconds and return the checksums."""
    wait_for_ports()
    graph.forget()
    stack = Stack(graph, folder)
    file = folder / "digest"
    bridges = ("foxglove:=true", "rosbridge:=true", "ros2:=true") if watched else ()
    try:
        launch = stack.launch(
            "multi_vehicle.launch",
            "vehicles:=iris:2",
            "speed:=0",
            "until:=6",
            "paused:=true",
            f"digest:={file}",
            *bridges,
        )
        poll(lambda: rospy.has_param("/xtdrone/fleet"), "the parameters are there", START_LIMIT)
        if watched:
            poll(lambda: rospy.has_param("/foxglove_bridge/actual_port"), "the bridge listens", START_LIMIT)
            watcher = _Everything()
            watcher.start()
            poll(lambda: POSE in watcher.subscribed, "it watches the poses", START_LIMIT)

        def resumed() -> bool:
            try:
                call(graph.uri, "/gazebo/unpause_physics", Empty, EmptyRequest())
            except SimError:
                return False
            return True

        poll(resumed, "time runs", START_LIMIT)
        launch.end(START_LIMIT)
        if watched:
            watcher.running = False
            assert watcher.client.received[watcher.client.channels[POSE]["id"] + 1000]
    finally:
        stack.stop()
    return file.read_bytes()


def test_watching_changes_no_bit_of_a_flight(graph: Graph, tmp_path: Path) -> None:
    folders = [tmp_path / name for name in ("alone", "watched")]
    for folder in folders:
        folder.mkdir()
    alone, watched = (_digest(graph, folder, i == 1) for i, folder in enumerate(folders))
    assert len(alone) > 100
    assert alone == watched
