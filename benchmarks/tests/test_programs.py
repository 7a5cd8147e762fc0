"""The benchmark programs on their smallest cases."""

from __future__ import annotations

import argparse
import json
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from tiny_networks import write_darknet

from benchmarks.programs import (
    analysis,
    codecs,
    detector,
    drawing,
    effects,
    odometry,
    planning,
    program_frame,
    rays,
    simplified,
)
from xtdrone_interaction.command_options import repository
from xtdrone_interaction.recording.flight_from_bag import read_bag
from xtdrone_sim.air import AIR


def test_a_picture_of_640_by_360_fits_into_each_input():
    assert [detector.input_height(width) for width in (320, 416, 640)] == [192, 256, 384]


def test_the_detector_is_measured_at_the_requested_size(tmp_path: Path):
    write_darknet(tmp_path, width=640, height=384, anchors=[(8, 12)], classes=1,
                  weights=np.zeros((6, 3)), biases=np.zeros(6))  # fmt: skip
    (tmp_path / "tiny.names").write_text("human\n")
    settings = tmp_path / "tiny.yaml"
    settings.write_text("weights: tiny.weights\nconfig: tiny.cfg\nnames: tiny.names\n")
    found = detector.measure(str(settings), 320, 0.01)
    assert (found["width"], found["height"]) == (320, 192)
    assert found["milliseconds"] > 0.0
    assert found["pictures"] >= 1


def test_the_bag_of_the_analysis_holds_nine_vehicles_at_even_steps(tmp_path: Path) -> None:
    (tmp_path / "made.bag").write_bytes(b"".join(analysis.chunks(2_000_000)))
    flight = read_bag([tmp_path / "made.bag"])
    assert len(flight.vehicles) == 9
    assert flight.notes == ["the recorder did not finish it: there is no index; it was read record by record"]
    place = flight.vehicles[8].position
    assert place is not None
    assert (place.value == [1.0, 2.0, 3.0]).all()
    assert abs(place.time[1:] - place.time[:-1] - 0.02).max() < 1e-6
    assert len(place) * 27 == sum(topic.count for topic in flight.topics)


def test_the_analysis_is_measured(tmp_path: Path) -> None:
    row = analysis.measure(1, tmp_path)
    assert row["megabytes_per_second"] > 0
    assert row["messages"] >= 27 * 200
    assert not list(tmp_path.glob("*.bag"))


def test_rays_are_measured() -> None:
    row = rays.measure(1, "scan", 0.01)
    assert row["rays"] == 512
    assert row["real_time_factor"] == pytest.approx(row["million_rays_per_second"] * 1e6 / 5120)


def test_effects_are_measured() -> None:
    row = effects.measure(2, "wind_region", 0.01)
    assert 0.0 < row["effect_microseconds"] < row["microseconds_per_vehicle_step"] * 10.0  # medians, one of few steps
    assert row["real_time_factor"] * row["microseconds_per_vehicle_step"] * 2 == pytest.approx(4000.0)
    assert set(effects.EFFECTS) > set(AIR)


def test_planning_is_measured() -> None:
    row = planning.measure(1, 0.01)
    assert row["plans"] > 5
    assert 0.0 < row["plan_milliseconds"] <= row["plan_p95"]
    assert 0.0 < row["map_milliseconds"] <= row["map_p95"]


@pytest.mark.parametrize("kind", odometry.KINDS)
def test_the_work_on_a_scan_is_measured(kind: str) -> None:
    row = odometry.measure(4, kind, 0.01)
    assert row["rays"] == 4096
    assert 0.0 < row["milliseconds"] <= row["most_milliseconds"]


def test_the_codecs_are_measured() -> None:
    row = codecs.measure("ModelStates", 2, 0.01)
    assert row["bytes"] == 12 + 2 * (4 + 6 + 7 * 8 + 6 * 8)
    assert 0.0 < row["decode"] < row["genpy_decode"]


def test_the_simplified_simulator_is_measured():
    figures = simplified.measure(9, 0.05, repeats=1)
    assert figures["vehicles"] == 9
    assert figures["real_time_factor"] * figures["microseconds_per_vehicle_turn"] == pytest.approx(1e6 / 270.0)


def test_the_drawing_is_measured():
    figures = drawing.measure(20, 0.01)
    assert figures["vehicles"] == 20
    assert figures["pictures_per_second"] > 0.0
    with pytest.raises(ValueError, match="1 vehicles"):
        drawing.measure(1, 1.0)


class _OutOfFuelError(Exception):
    """A measurement failed."""


def _cases(arguments: argparse.Namespace) -> Iterator[program_frame.Row]:
    if arguments.count < 0:
        raise ValueError("count: at least 0")
    for number in range(arguments.count):
        if number == 3:
            raise _OutOfFuelError("out of fuel")
        yield {"number": number, "half": number / 2}


@pytest.mark.parametrize(("count", "status"), [(2, 0), (4, 1), (-1, 2)])
def test_a_program_prints_a_table_and_writes_its_rows(
    count: int, status: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "rows.json"
    monkeypatch.setattr(sys, "argv", ["program", "--count", str(count), "--json", str(file)])
    parser = argparse.ArgumentParser()
    parser.add_argument("--count", type=int)
    columns = (program_frame.Column("number", "{number}"), program_frame.Column("half", "{half:.1f}x"))
    try:
        ended = program_frame.run(parser, _cases, columns, (_OutOfFuelError,))
    except SystemExit as error:
        ended = error.code
    said = capsys.readouterr()
    assert ended == status
    assert file.exists() == (status == 0)
    if status == 0:
        assert json.loads(file.read_text()) == [{"number": 0, "half": 0.0}, {"number": 1, "half": 0.5}]
        assert [line.split() for line in said.out.splitlines()] == [["number", "half"], ["0", "0.0x"], ["1", "0.5x"]]
    assert ("ERROR: out of fuel" in said.err) == (status == 1)
    assert ("count: at least 0" in said.err) == (status == 2)


@pytest.mark.parametrize("name", ["offboard_hover", "formation_speed_meter", "search_speed_meter"])
def test_one_launch_file_starts_each_node(name: str) -> None:
    node = repository() / "benchmarks" / "nodes" / f"{name}.py"
    assert node.stat().st_mode & 0o111
    launches = [file.read_text() for file in (repository() / "launch").glob("bench*.launch")]
    assert sum(f"benchmarks/nodes/{name}.py" in text for text in launches) == 1


def test_a_program_is_run_by_its_path(tmp_path: Path) -> None:
    runner = repository() / "src" / "xtdrone_interaction" / "nodes" / "run_file.py"
    program = tmp_path / "program"
    program.write_text("#!/bin/sh\necho ran $1\nexit 3\n")
    program.chmod(0o755)
    ran = subprocess.run([sys.executable, runner, program, "__name:=n"], capture_output=True, text=True)
    assert (ran.returncode, ran.stdout) == (3, "ran __name:=n\n")
    failed = subprocess.run([sys.executable, runner, tmp_path / "none"], capture_output=True, text=True)
    assert failed.returncode == 1
    assert "No such file or directory" in failed.stderr


def test_no_package_imports_benchmarks_or_validation() -> None:
    imports = re.compile(r"^\s*(?:from|import) (?:benchmarks|validation)\b", re.MULTILINE)
    sources = [file for file in (repository() / "src").rglob("*.py") if imports.search(file.read_text())]
    assert sources == []
