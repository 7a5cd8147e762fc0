"""The soak's short form through the whole stack: every kind of event, a good verdict, and no process left running."""

from __future__ import annotations

import csv
import json
import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from conftest import poll

pytest.importorskip("rospy")

from validation.soak import soak_script
from xtdrone_common.fleet import parse_fleet
from xtdrone_interaction.command_options import OptionError, check_vehicle_ports

SEED, COUNT = 1, 3
LIMIT = 900.0  # s of wall time, on a machine that is busy otherwise
START_LIMIT = 240.0
_MARK = "XTDRONE_TEST_SOAK"  # environment variable by which a soak's processes are found

pytestmark = pytest.mark.timeout(LIMIT + 2 * START_LIMIT)


def _ports_free() -> bool:
    try:
        check_vehicle_ports(parse_fleet(f"iris:{COUNT}"))
    except OptionError:
        return False
    return True


def _start(out: Path, *arguments: str) -> subprocess.Popen[str]:
    poll(_ports_free, "the vehicles' ports are free", START_LIMIT)
    return subprocess.Popen(
        [sys.executable, "-m", "validation", "soak", "--n", str(COUNT), "--seed", str(SEED), *arguments,
         "--out", str(out)],
        env={**os.environ, _MARK: str(out)}, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
    )  # fmt: skip


def _left(out: Path) -> list[str]:
    """Return the command lines of a soak's processes that still run."""
    found = []
    for entry in Path("/proc").iterdir():
        try:
            if entry.name.isdigit() and f"{_MARK}={out}".encode() in (entry / "environ").read_bytes():
                found.append((entry / "cmdline").read_bytes().replace(b"\0", b" ").decode())
        except OSError:  # it has ended, or is another user's
            continue
    return found


@pytest.fixture(scope="module")
def soaked(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, int, str]:
    out = tmp_path_factory.mktemp("soak") / "short"
    soak = _start(out, "--short")
    try:
        said, _ = soak.communicate(timeout=LIMIT)
    finally:
        soak.kill()
    return out, soak.returncode, said


def _report(out: Path) -> dict[str, Any]:
    content: dict[str, Any] = json.loads((out / "report.json").read_text())
    return content


def test_a_short_soak_is_good(soaked: tuple[Path, int, str]) -> None:
    out, status, said = soaked
    assert status == 0, said
    report = _report(out)
    assert report["failures"] == []
    counts = report["counts"]
    events = [event for episode in soak_script.generate_short(SEED, COUNT) for event in episode.events]
    for action in {event.action for event in events}:
        assert counts["actions"][action] == sum(event.action == action for event in events), action
    assert counts["latest_event"] < 5.0  # s; only nodes outside the lockstep overshoot
    assert counts["flights"] >= 0.9 * counts["expected"] > 0
    assert counts["words_without_listener"] == 0


def test_every_log_and_bag_of_it_was_read(soaked: tuple[Path, int, str]) -> None:
    out, _, _ = soaked
    assert _report(out)["counts"]["messages"] > 1000
    assert list((out / "ulog").rglob("*.ulg")) == []
    assert list((out / "bags").iterdir()) == []


def test_its_samples_have_figures_of_every_process(soaked: tuple[Path, int, str]) -> None:
    out, _, _ = soaked
    with (out / "samples.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    times = [float(row["soak_time"]) for row in rows]
    assert times == sorted(times)
    assert len(rows) == len(list(soak_script.generate_short(SEED, COUNT)))
    for row in rows:
        assert float(row["simulator_rss"]) > float(row["rosout_anonymous"]) > 1.0
        assert row["participants"] == "1"  # the MAVROS layer: the others have left
    assert (out / "soak.png").stat().st_size > 10_000


def test_nothing_of_it_is_left_running(soaked: tuple[Path, int, str]) -> None:
    assert _left(soaked[0]) == []


def test_a_stopped_soak_reports_its_progress(tmp_path: Path) -> None:
    out = tmp_path / "stopped"
    soak = _start(out, "--hours", "1")
    samples = out / "samples.csv"
    try:
        poll(lambda: samples.is_file() and samples.read_text().count("\n") >= 2, "a sample", LIMIT)
        soak.send_signal(signal.SIGINT)
        said, _ = soak.communicate(timeout=START_LIMIT)
    finally:
        soak.kill()
    assert soak.returncode == 128 + signal.SIGINT, said
    assert _report(out)["failures"][-1] == "stopped by SIGINT"
    assert _left(out) == []
