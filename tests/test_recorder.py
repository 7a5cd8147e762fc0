"""The recorder as it is launched: it records by a profile, and the bag is whole when it is asked to end."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from pathlib import Path

import pytest
from conftest import Graph, Stack, poll

pytest.importorskip("rospy")

from std_msgs.msg import String

from xtdrone_interaction.bags.ros1bag import BagFile

WRITTEN = 10_000  # bytes of a bag that has more than its header


@pytest.fixture
def stack(graph: Graph, tmp_path: Path) -> Iterator[Stack]:
    stack = Stack(graph, tmp_path)
    yield stack
    stack.stop()


def test_record_launch_records_the_topics_of_its_profile(stack: Stack, tmp_path: Path) -> None:
    out = tmp_path / "new folder" / "flight"
    recorder = stack.launch("record.launch", f"bag:={out}", "profile:=light", "split:=100")
    active = out.with_name("flight_0.bag.active")

    def recorded() -> bool:
        stack.graph.say("/xtdrone/notes", String("word " * 50_000))  # the recorder packs and writes every 768 kB
        return active.is_file() and active.stat().st_size > WRITTEN

    poll(recorded, "the recorder writes")
    recorder.process.send_signal(signal.SIGINT)
    assert recorder.end() == 0
    assert not active.exists()
    bag = BagFile(out.with_name("flight_0.bag"))
    count = sum(len(batch.time) for batch in bag.batches())
    assert bag.whole, bag.notes
    assert count >= 3
    assert {connection.topic for connection in bag.connections.values()} <= {"/xtdrone/notes", "/rosout"}
