"""End of a flight's supervision, without processes."""

from __future__ import annotations

import errno
import io
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace

import pytest
import rosbag
import rospy
from rich.console import Console
from std_msgs.msg import String

from xtdrone_common.files import replacing
from xtdrone_interaction.bags.ros1bag import BagFile
from xtdrone_interaction.launching import supervised_launch
from xtdrone_interaction.monitoring.ended_nodes import EndedNodes


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> SimpleNamespace:
    clock = SimpleNamespace(now=100.0)
    monkeypatch.setattr(supervised_launch.time, "monotonic", lambda: clock.now)
    return clock


def made(folder: Path) -> supervised_launch.Watch:
    tree = SimpleNamespace(wait=lambda _: False)
    feed = SimpleNamespace(take=lambda _: [], lost=False)
    display = SimpleNamespace(note=lambda _: None, standstill=lambda _: None)
    return supervised_launch.Watch(
        tree, SimpleNamespace(out=folder, arguments={}, vital=()), feed, display, EndedNodes(folder / "roslaunch.log")
    )


def test_time_in_which_the_watcher_itself_was_stopped_does_not_count(clock: SimpleNamespace, tmp_path: Path) -> None:
    watch = made(tmp_path)
    for _ in range(40):
        clock.now += 0.5
        watch.poll(starting=False)
    assert watch.stalled_time == pytest.approx(20.0)
    clock.now += 3600.0
    watch.poll(starting=False)
    assert watch.stalled_time == pytest.approx(20.0)


@pytest.mark.parametrize(("node", "ends"), [("mavros", True), ("follower_2", False)])
def test_a_flight_ends_when_a_required_node_is_dropped(
    clock: SimpleNamespace, tmp_path: Path, node: str, ends: bool
) -> None:
    line = (
        f"[WARN] [17.5, 66.2]: simulator: participant /{node} was silent for 60.1 s (hang limit 60 s); dropped, ...\n"
    )
    (tmp_path / "roslaunch.log").write_text(line)
    flight = SimpleNamespace(last_events=("done",), start_limit=60.0, vital=())
    watch = made(tmp_path)
    looks = iter(range(3))
    watch.running = lambda: next(looks, None) is not None  # type: ignore[method-assign]
    flight.events = lambda: [{"event": "done"}]
    if ends:
        with pytest.raises(supervised_launch.DemoError, match="cannot continue: mavros was dropped by the simulator"):
            supervised_launch._watch(watch, flight)
    else:
        supervised_launch._watch(watch, flight)


def test_what_ends_a_recording_is_shown_at_once_and_comes_first_at_the_end(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Also on a full disk, where the file of events is cut off and no report can be written."""
    warning = "/full/flight.bag: No space left on device; the rest of the flight is not recorded"
    watch = made(tmp_path)
    shown: list[str] = []
    watch.display = SimpleNamespace(note=shown.append, standstill=lambda _: None)  # type: ignore[assignment]
    told = [[{"kind": "warning", "text": warning}], [{"kind": "events", "message": {"event": "done"}}]]
    watch._feed.take = lambda _: told.pop(0)  # type: ignore[method-assign]
    watch.running = lambda: bool(told)  # type: ignore[method-assign]
    watch.finish = lambda: None  # type: ignore[method-assign]

    @contextmanager
    def watching(*_: object) -> Iterator[supervised_launch.Watch]:
        yield watch
        (tmp_path / "roslaunch.log").write_text("[recorder-5] process has died [pid 7, exit code -9, cmd x].\n")
        watch.ended_nodes.update(3.0)

    monkeypatch.setattr(supervised_launch, "watching", watching)
    monkeypatch.setattr(supervised_launch, "EndedNodes", lambda _: watch.ended_nodes)
    (tmp_path / "events.jsonl").write_text('{"event": "armed"}\n{"eve')
    flight = supervised_launch.Flight(
        file="a.launch", arguments={}, out=tmp_path, master_port=11311, headless=True, bag="flight.bag",
        start_limit=60.0, progress_topic="/p", events_topic="/e", last_events=("done",), show_event=lambda *_: None,
    )  # fmt: skip
    console = Console(file=io.StringIO(), width=200)

    def conclude(_: EndedNodes) -> int:
        console.print("the table")
        with replacing(tmp_path / "report.json"):
            raise OSError(errno.ENOSPC, "No space left on device")

    assert supervised_launch.run_flight(flight, console, conclude) == 1
    assert shown[0] == f"  [red]{warning}[/red]"
    lines = console.file.getvalue().splitlines()  # type: ignore[attr-defined]
    places = [
        next(i for i, line in enumerate(lines) if words in line)
        for words in (warning, "recorder has died (SIGKILL) at 3.0 s", "the table", "report.json: No space left")
    ]
    assert places == sorted(places), lines


@pytest.mark.parametrize("limit", ["unlimited", "2"])  # in 512 bytes
def test_a_bag_without_an_index_keeps_its_messages_also_on_a_full_disk(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, limit: str
) -> None:
    bag, active, program = tmp_path / "flight.bag", tmp_path / "flight.bag.active", tmp_path / "rosbag"
    with rosbag.Bag(str(tmp_path / "whole.bag"), "w", chunk_threshold=1000) as whole:
        for second in range(1, 100):
            whole.write("/notes", String("word " * 20), rospy.Time(second))
        whole.flush()
        shutil.copy(whole.filename, active)
    recorded = active.read_bytes()
    program.write_text(f'#!/bin/sh\ntrap "" XFSZ\nulimit -f {limit}\nexec {shutil.which("rosbag")} "$@"\n')
    program.chmod(0o700)
    monkeypatch.setattr(supervised_launch.shutil, "which", lambda _: str(program))
    supervised_launch._mend_bag(bag, dict(os.environ))
    file = BagFile(bag)
    assert sum(len(batch.time) for batch in file.batches()) >= 90
    assert bool(file.notes) is (limit != "unlimited")  # notes on a missing index
    assert limit == "unlimited" or bag.read_bytes() == recorded
    assert {path.name for path in tmp_path.iterdir()} == {"flight.bag", "whole.bag", "rosbag"}


@pytest.mark.parametrize(("home", "moved"), [("/proc/self", True), ("", False)])
def test_nodes_run_where_they_can_when_the_home_cannot_be_written_to(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, home: str, moved: bool
) -> None:
    monkeypatch.delenv("ROS_HOME", raising=False)
    monkeypatch.setenv("HOME", home or str(tmp_path))
    environment = supervised_launch.Launch("a.launch", {}, tmp_path, 11311, headless=True).environment()
    assert environment.get("ROS_HOME") == (str(tmp_path / "logs") if moved else None)
