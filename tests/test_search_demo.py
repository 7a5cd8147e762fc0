"""The cooperative search through the whole stack, from the command to the report: needs the built workspace.

Two UAVs search a small region; the tests examine its results.
"""

from __future__ import annotations

import itertools
import json
import math
import os
import shutil
import signal
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from xtdrone_autopilot.plans import qgc_plan
from xtdrone_interaction.missions.search.record import SearchRecord, read_search

NAMES = ("typhoon_h480_0", "typhoon_h480_1")
REGION = "region: [[15, -8], [45, -8], [45, 16], [15, 16]]\n"
FLIGHT_LIMIT = 900.0  # s of wall time


def _built() -> bool:
    """Return whether roslaunch and the workspace's packages exist."""
    if shutil.which("roslaunch") is None:
        return False
    import rospkg

    return "xtdrone_perception" in rospkg.RosPack().list()


pytestmark = [
    pytest.mark.skipif(not _built(), reason="the workspace is not built and sourced"),
    pytest.mark.timeout(2 * FLIGHT_LIMIT),
]


def _command(folder: Path, *arguments: str) -> list[str]:
    region = folder.parent / "region.yaml"
    region.write_text(REGION, encoding="utf-8")
    return [
        sys.executable, "-m", "xtdrone_interaction.cli", "demo", "search", "--n", "2", "--region", str(region),
        "--standing", "--seed", "2", "--follow-time", "10", "--headless", "--out", str(folder), *arguments,
    ]  # fmt: skip


def _report(folder: Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "xtdrone_interaction.cli", "report", str(folder / "flight.bag")]
    return subprocess.run(command, capture_output=True, text=True, timeout=FLIGHT_LIMIT, check=False)


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
    def report(self) -> dict[str, Any]:
        return json.loads((self.folder / "report.json").read_text(encoding="utf-8"))

    @property
    def record(self) -> SearchRecord:
        return read_search(self.folder / "flight.bag", NAMES, ("actor_0",))


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Flight:
    folder = tmp_path_factory.mktemp("search") / "out"
    result = subprocess.run(_command(folder), capture_output=True, text=True, timeout=FLIGHT_LIMIT, check=False)
    return Flight(folder, result.stdout + result.stderr, result.returncode)


def test_the_person_is_found_and_followed(flight: Flight) -> None:
    assert (flight.folder / "report.json").is_file(), flight.output
    assert flight.status == 0, flight.output
    record, report = flight.record, flight.report
    assert report["outcome"] == "found"
    (find,) = report["finds"]
    x, y, _ = record.person_at("actor_0", find["time"])
    assert math.dist(find["position"], (x, y)) < 2.0
    assert find["error"] == pytest.approx(math.dist(find["position"], (x, y)))
    assert report["died"] == report["lost"] == report["collisions"] == report["shortcomings"] == []
    (following,) = [event for event in record.events if event["event"] == "follow_ended"]
    assert (following["reason"], following["duration"]) == ("time", pytest.approx(10.0, abs=0.3))


def test_no_picture_is_lost(flight: Flight) -> None:
    """In lockstep, time waits for cameras and detector: two pictures a second from each, none skipped."""
    record = flight.record
    for name in NAMES:
        sights = record.sights[name]
        assert len(sights) > 20
        assert sights[-1].dropped == 0
        gaps = [round(b.time - a.time, 6) for a, b in itertools.pairwise(sights)]
        assert set(gaps) == {0.5}


def test_each_vehicle_flew_its_own_plan(flight: Flight) -> None:
    record = flight.record
    for index, name in enumerate(NAMES):
        plan = qgc_plan.read(flight.folder / "plans" / f"{name}.plan")
        heights = [item.z for item in plan.mission if item.command == 16]
        assert len(heights) >= 2
        assert abs(record.position[:, index, 2].max() - heights[0]) < 3.0


def test_pictures_and_film_are_there(flight: Flight) -> None:
    for name in ("map.png", "views.png"):
        picture = cv2.imread(str(flight.folder / name))
        assert picture.std() > 10.0, name
    film = cv2.VideoCapture(str(flight.folder / "views.mp4"))
    assert film.get(cv2.CAP_PROP_FRAME_COUNT) > 40
    film.release()


def test_the_report_is_made_again(flight: Flight, tmp_path: Path) -> None:
    folder = tmp_path / "copy"
    shutil.copytree(flight.folder, folder)
    (folder / "map.png").unlink()
    again = _report(folder)
    assert again.returncode == 0, again.stdout + again.stderr
    assert json.loads((folder / "report.json").read_text(encoding="utf-8")) == flight.report
    pictures = [cv2.imread(str(where / "map.png")) for where in (folder, flight.folder)]
    assert pictures[0].shape == pictures[1].shape
    assert np.mean(pictures[0] != pictures[1]) < 0.01  # its plans are rounded as QGroundControl's are


def test_nothing_is_left_running(flight: Flight) -> None:
    assert _processes_with(str(flight.folder)) == []


def test_an_interrupted_search_leaves_a_bag_and_no_process(tmp_path: Path) -> None:
    folder = tmp_path / "out"
    with subprocess.Popen(_command(folder), stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as process:
        assert process.stdout is not None
        lines = []
        for line in process.stdout:
            lines.append(line)
            if "searching" in line:
                process.send_signal(signal.SIGINT)
                break
        rest = process.stdout.read()
        assert process.wait(FLIGHT_LIMIT) == 128 + signal.SIGINT, "".join(lines) + rest
    assert _processes_with(str(folder)) == []
    assert read_search(folder / "flight.bag", NAMES, ("actor_0",)).events[0]["event"] == "started"
    again = _report(folder)
    assert again.returncode == 1, again.stdout + again.stderr
    assert "the search was cut short" in again.stdout
    report = json.loads((folder / "report.json").read_text(encoding="utf-8"))
    assert (report["outcome"], report["find"]) == ("cut short", None)
    assert 0.0 <= report["covered"]["fraction"] < 1.0
    assert cv2.imread(str(folder / "map.png")).std() > 10.0
