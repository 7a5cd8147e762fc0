"""The formation flight through the whole stack, from the command to the table: needs the built workspace.

One small flight (six UAVs, one pattern, one process per role) is flown as fast as the machine allows; the tests examine
its results. Figures of the paper's nine UAVs come from ``./xtdrone demo formation`` itself.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from xtdrone_common.fleet import parse_fleet
from xtdrone_coordination.laws.topology import veteran_topology
from xtdrone_coordination.patterns import with_leader
from xtdrone_interaction.command_options import OptionError, check_vehicle_ports
from xtdrone_interaction.missions.formation.record import FormationRecord, read_formation

FLEET = "iris:6"
FLIGHT_LIMIT = 600.0  # s of wall time
START_LIMIT = 180.0
PAPER_TOPOLOGY = [  # section 5.1: row i marks the UAVs that UAV i listens to; by the rule, for origin and T in order
    [0, 0, 0, 0, 0, 0],
    [1, 0, 0, 0, 0, 0],
    [1, 1, 0, 0, 0, 0],
    [0, 1, 1, 0, 0, 0],
    [0, 0, 1, 1, 0, 0],
    [0, 0, 0, 1, 1, 0],
]


def _built() -> bool:
    """Return whether roslaunch and the workspace's packages exist."""
    if shutil.which("roslaunch") is None:
        return False
    import rospkg

    return "xtdrone_sim" in rospkg.RosPack().list() and "xtdrone_coordination" in rospkg.RosPack().list()


pytestmark = [
    pytest.mark.skipif(not _built(), reason="the workspace is not built and sourced"),
    pytest.mark.timeout(FLIGHT_LIMIT + START_LIMIT),
]


def _command(out: Path, *arguments: str) -> list[str]:
    return [
        sys.executable, "-m", "xtdrone_interaction.cli", "demo", "formation", "--n", "6", "--patterns", "T",
        "--processes", "shared", "--headless", "--out", str(out), *arguments,
    ]  # fmt: skip


def _processes_with(text: str) -> list[str]:
    """Return the command lines of all other processes with ``text`` in their environment or command line."""
    found = []
    for entry in Path("/proc").iterdir():
        if not entry.name.isdigit() or int(entry.name) == os.getpid():
            continue
        try:
            command = (entry / "cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace")
            if text in command or text.encode() in (entry / "environ").read_bytes():
                found.append(command)
        except OSError:  # it has ended, or belongs to another user
            continue
    return found


@dataclass(frozen=True)
class Flight:
    """The results of a flight."""

    folder: Path
    output: str
    status: int

    @property
    def report(self) -> dict:
        return json.loads((self.folder / "report.json").read_text(encoding="utf-8"))

    @property
    def record(self) -> FormationRecord:
        return read_formation(self.folder / "flight.bag")


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Flight:
    folder = tmp_path_factory.mktemp("flight") / "out"
    result = subprocess.run(_command(folder), capture_output=True, text=True, timeout=FLIGHT_LIMIT, check=False)
    return Flight(folder, result.stdout + result.stderr, result.returncode)


def test_the_flight_succeeds(flight: Flight) -> None:
    assert flight.status == 0, flight.output
    assert flight.report["outcome"] == "done"
    assert flight.report["shortcomings"] == []


def test_every_pattern_settles_without_a_close_call(flight: Flight) -> None:
    report = flight.report
    assert [r["pattern"] for r in report["reconfigurations"]] == ["origin", "T", "origin"]
    for item in report["reconfigurations"]:
        assert item["settling_time"] is not None
        assert item["steady_error_mean"] < 0.10
        assert item["assigned_distance"] <= 1.01 * item["optimal_distance"] + 0.01
    assert report["least_distance"] > 0.5
    assert report["positions"].startswith("ground truth")


def test_the_papers_topology_flies(flight: Flight) -> None:
    """On the grid, with a slot for each UAV, it is the paper's matrix; later the rule's for the slots."""
    windows = flight.record.windows
    np.testing.assert_array_equal(windows[0].topology, PAPER_TOPOLOGY)
    for window in windows:
        np.testing.assert_array_equal(window.topology, veteran_topology(with_leader(window.offsets)))


def test_all_land_and_disarm(flight: Flight) -> None:
    record = flight.record
    assert record.phases[-1]["phase"] == "land"
    heights = record.track.position[-1, :, 2]
    assert heights.max() < 0.5, heights


def test_the_run_folder_is_complete(flight: Flight) -> None:
    names = {p.name for p in flight.folder.iterdir()}
    assert {"flight.bag", "report.json", "events.jsonl", "formations.png", "distances.png", "logs"} <= names
    assert "response_1_origin_to_T.png" in names
    assert (flight.folder / "flight.mp4").stat().st_size > 50_000 or (flight.folder / "flight.gif").is_file()


def test_nothing_is_left_running_after_the_flight(flight: Flight) -> None:
    assert _processes_with(str(flight.folder)) == []


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])  # SIGTERM: test_cli.py
def test_a_stopped_flight_leaves_nothing_running(tmp_path: Path, number: int) -> None:
    """Ctrl-C in flight ends all processes and leaves a readable bag; so does kill -9.

    The first of these flights also rejects a second one of the same instance.
    """
    out = tmp_path / "out"
    slow = ["--speed", "2"] if number == signal.SIGINT else []  # it still flies when the second has been rejected
    demo = subprocess.Popen(_command(out, *slow), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        if number == signal.SIGINT:
            _wait_for_event(out / "events.jsonl", "start", demo)
            _check_second_is_refused(tmp_path / "second")
        _wait_for_event(out / "events.jsonl", "armed", demo)
        demo.send_signal(number)
        status = demo.wait(START_LIMIT)
    finally:
        demo.kill()
    if number == signal.SIGKILL:
        _wait_until_gone(str(out), START_LIMIT)
    else:
        assert status == 128 + number
    assert _processes_with(str(out)) == []
    record = read_formation(out / "flight.bag")
    assert record.track.time[-1] > 0.0
    check_vehicle_ports(parse_fleet(FLEET))  # the ports are free again


def _check_second_is_refused(out: Path) -> None:
    command = _command(out, "--instance", "0")
    second = subprocess.run(command, capture_output=True, text=True, timeout=START_LIMIT, check=False)
    assert second.returncode == 2
    assert "instance: 0 flies already" in second.stderr
    with pytest.raises(OptionError, match="is taken"):
        check_vehicle_ports(parse_fleet(FLEET))


def test_a_killed_simulator_ends_the_demo_with_a_message(tmp_path: Path) -> None:
    out = tmp_path / "out"
    demo = subprocess.Popen(_command(out), stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    try:
        _wait_for_event(out / "events.jsonl", "armed", demo)
        for entry in Path("/proc").iterdir():
            if entry.name.isdigit() and str(out) in _environment(entry) and "simulator.py" in _command_line(entry):
                os.kill(int(entry.name), signal.SIGKILL)
        output, _ = demo.communicate(timeout=START_LIMIT)
    finally:
        demo.kill()
    assert demo.returncode == 1
    assert "simulator" in output
    assert _processes_with(str(out)) == []


def _environment(process: Path) -> str:
    try:
        return (process / "environ").read_bytes().decode(errors="replace")
    except OSError:
        return ""


def _command_line(process: Path) -> str:
    try:
        return (process / "cmdline").read_bytes().decode(errors="replace")
    except OSError:
        return ""


def _wait_for_event(events: Path, name: str, demo: subprocess.Popen) -> None:
    """Wait until the director has written an event; fail if the demo ends first."""
    end = time.monotonic() + START_LIMIT
    while not (events.is_file() and f'"event": "{name}"' in events.read_text(encoding="utf-8")):
        assert demo.poll() is None, f"the demo ended with status {demo.returncode} before {name!r}"
        assert time.monotonic() < end, f"no event {name!r} within {START_LIMIT} s"
        time.sleep(0.1)


def _wait_until_gone(text: str, limit: float) -> None:
    end = time.monotonic() + limit
    while _processes_with(text) and time.monotonic() < end:
        time.sleep(0.1)
