"""The recorders: of a profile, and of the demos. The bag is complete after a request to end."""

from __future__ import annotations

import contextlib
import ctypes
import os
import re
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest
from conftest import Graph, Stack, poll

pytest.importorskip("rospy")

import rosgraph
import roslib.packages
import rospy
from std_msgs.msg import String

from xtdrone_interaction.bags.ros1bag import BagFile

RECORDER = roslib.packages.find_node("xtdrone_interaction", "recorder")
WRITTEN = 10_000  # bytes of a bag that has more than its header
_PTRACE_DETACH, _PTRACE_SEIZE, _PTRACE_INTERRUPT = 17, 0x4206, 0x4207  # <linux/ptrace.h>
_WALL = 0x40000000  # <linux/wait.h>


@pytest.fixture
def stack(graph: Graph, tmp_path: Path) -> Iterator[Stack]:
    stack = Stack(graph, tmp_path)
    yield stack
    stack.stop()


def _record(stack: Stack, active: Path) -> None:
    """Publish until the recorder has written messages."""

    def recorded() -> bool:
        stack.graph.say("/xtdrone/notes", String("word " * 50_000))  # the recorder packs and writes every 768 kB
        return active.is_file() and active.stat().st_size > WRITTEN

    poll(recorded, "the recorder writes")


def _read(bag: BagFile) -> tuple[int, set[int]]:
    """Return the number of messages, and their times, ns."""
    times = [time for batch in bag.batches() for time in batch.time]
    assert bag.whole, bag.notes
    return len(times), set(times)


def test_record_launch_records_the_topics_of_its_profile(stack: Stack, tmp_path: Path) -> None:
    out = tmp_path / "new folder" / "flight"
    recorder = stack.launch("record.launch", f"bag:={out}", "profile:=light", "split:=100")
    active = out.with_name("flight_0.bag.active")

    _record(stack, active)
    recorder.process.send_signal(signal.SIGINT)
    assert recorder.end() == 0
    assert not active.exists()
    bag = BagFile(out.with_name("flight_0.bag"))
    assert _read(bag)[0] >= 3
    assert {connection.topic for connection in bag.connections.values()} <= {"/xtdrone/notes", "/rosout"}


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_the_demos_recorder_writes_what_comes_before_the_clock(
    stack: Stack, tmp_path: Path, number: signal.Signals
) -> None:
    rosgraph.Master("/system_tests").setParam("/use_sim_time", True)
    file = tmp_path / "new folder" / "flight.bag"
    recorder = stack.start("recorder", [*RECORDER, str(file), "/xtdrone/notes", "/xtdrone/never", "__name:=recorder"])
    _record(stack, file.with_name("flight.bag.active"))
    recorder.process.send_signal(number)
    assert recorder.end() == 0, recorder.output
    assert not file.with_name("flight.bag.active").exists()
    bag = BagFile(file)
    count, times = _read(bag)
    assert count >= 3
    assert times == {1}  # ns; a bag has no time 0
    assert [(c.topic, c.type) for c in bag.connections.values()] == [("/xtdrone/notes", "std_msgs/String")]


def test_a_file_that_cannot_grow_keeps_what_was_recorded(stack: Stack, tmp_path: Path) -> None:
    file, limit = tmp_path / "flight.bag", 2 * WRITTEN // 512
    limited = ["sh", "-c", f'trap "" XFSZ; ulimit -f {limit}; exec "$@"', "sh"]
    recorder = stack.start("recorder", [*limited, *RECORDER, str(file), "/xtdrone/notes"])
    notes = rospy.Publisher("/xtdrone/notes", String, queue_size=10)
    warnings: list[str] = []
    rospy.Subscriber("/recorder/warning", String, lambda message: warnings.append(message.data))

    def warned() -> bool:
        notes.publish(String("word " * 50_000))
        return bool(warnings)

    poll(warned, "the recorder warns at once, while the flight goes on")
    assert warnings[0].startswith(f"{file}: ")
    assert warnings[0].endswith("; the rest of the flight is not recorded")
    assert recorder.process.poll() is None
    recorder.process.send_signal(signal.SIGINT)
    assert recorder.end() == 1, recorder.output
    assert f"recorder: {warnings[0]}" in recorder.output
    assert "flight.bag cannot be recorded: " in recorder.output
    bag = BagFile(file.with_name("flight.bag.active"))
    assert sum(len(batch.time) for batch in bag.batches()) >= 3
    assert not file.exists()


def _trace(request: int, thread: int) -> None:
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.ptrace(request, thread, None, None) != 0:
        raise OSError(ctypes.get_errno(), "ptrace")


@contextlib.contextmanager
def _stalled(thread: int) -> Iterator[None]:
    """Stop one thread of another process, like a disk that blocks."""
    try:
        _trace(_PTRACE_SEIZE, thread)
    except OSError as error:
        pytest.skip(f"ptrace: {os.strerror(error.errno)}")
    _trace(_PTRACE_INTERRUPT, thread)
    os.waitpid(thread, _WALL)
    yield
    _trace(_PTRACE_DETACH, thread)


def test_what_waits_for_a_stalled_disk_has_a_limit(stack: Stack, tmp_path: Path) -> None:
    file = tmp_path / "flight.bag"
    recorder = stack.start("recorder", [*RECORDER, str(file), "/xtdrone/notes", "__name:=recorder", "_buffer:=1"])
    active = file.with_name("flight.bag.active")
    _record(stack, active)
    size = active.stat().st_size
    with _stalled(recorder.process.pid):  # its main thread writes

        def full() -> bool:
            stack.graph.say("/xtdrone/notes", String("word " * 50_000))
            return "messages are dropped until" in recorder.output

        poll(full, "the recorder drops messages")
    stack.graph.say("/xtdrone/notes", String("word " * 500_000))
    poll(lambda: active.stat().st_size > size, "the recorder writes again")
    recorder.process.send_signal(signal.SIGINT)
    assert recorder.end() == 0, recorder.output
    assert len(re.findall(r"the disk does not keep up, [01]\.[0-9] MB wait for it", recorder.output)) == 1
    assert re.search(r"recorder: [1-9]\d* messages were dropped", recorder.output)
    assert _read(BagFile(file))[0] >= 3


@pytest.mark.parametrize(
    ("arguments", "status", "words"),
    [
        (["/proc/nowhere/flight.bag", "/a"], 1, "/proc/nowhere/flight.bag cannot be recorded"),
        (["/tmp/flight.bag"], 2, "Usage: recorder FILE TOPIC..."),
        (["/tmp/flight.bag", "/a", "_buffer:=0"], 1, "~buffer must be a whole number of MB, at least 1"),
        (["/proc/flight.bag", "/a topic"], 1, "cannot be recorded"),
    ],
)
def test_what_cannot_be_recorded_is_named(stack: Stack, arguments: list[str], status: int, words: str) -> None:
    recorder = stack.start("recorder", [*RECORDER, *arguments])
    assert recorder.end() == status
    assert words in recorder.output
