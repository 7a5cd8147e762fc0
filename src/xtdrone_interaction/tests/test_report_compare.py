"""Runs on the same axes: differences in closed form, common quantities, invalid runs."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from bags import RADIUS, TURN, helix, make_flight

from xtdrone_interaction import cli
from xtdrone_interaction.compare_cli import names_of
from xtdrone_interaction.metrics.comparison import CompareError, aligned, compare, matched, read_run
from xtdrone_interaction.missions.formation.report import find_formation


def table(path: Path, time: np.ndarray, places: np.ndarray, vehicle: str = "") -> Path:
    head, end = ("time,x,y,z,vehicle", f",{vehicle}") if vehicle else ("time,x,y,z", "")
    rows = [f"{t!r},{x!r},{y!r},{z!r}{end}" for t, (x, y, z) in zip(time.tolist(), places.tolist(), strict=True)]
    path.write_text("\n".join([head, *rows]))
    return path


def test_runs_are_aligned_and_their_difference_is_that_of_the_motions(tmp_path: Path) -> None:
    """The same helix agrees in a bag with dates, and in a table whose vehicle is ahead by an angle."""
    make_flight(tmp_path / "a.bag", ("/uav0", "/uav1"), 20.0, start=1.7e9)
    make_flight(tmp_path / "b.bag", ("/uav0", "/uav1"), 25.0)
    runs = [read_run(tmp_path / f"{name}.bag", name, find_formation) for name in "ab"]
    found, words = aligned(matched(runs, None), "motion")
    assert "first motion" in words
    rows = compare(found)
    assert rows[1]["difference_greatest"] < 1e-4
    assert rows[0]["greatest_speed"] == pytest.approx(np.hypot(RADIUS * TURN, 0.2), rel=1e-2)
    assert rows[0]["least_distance"] == pytest.approx(10.0)

    time = np.arange(0.0, 30.0, 0.05)
    ahead = 0.1
    reference = table(tmp_path / "reference.csv", time, helix(time + ahead) - [0.0, 0.0, 0.2 * ahead])
    runs = matched([read_run(reference, "reference"), read_run(tmp_path / "b.bag", "b")], "uav0")
    found, _ = aligned(runs, "none")
    (_, row) = compare(found)
    assert row["difference_rms"] == pytest.approx(2 * RADIUS * np.sin(TURN * ahead / 2), rel=1e-2)
    with pytest.raises(CompareError, match="the arming time of run 'reference' is unknown"):
        aligned(runs, "armed")


def test_speed_is_known_to_the_last_place(tmp_path: Path) -> None:
    """The last interval counts even where equal steps add up to more than the last time."""
    for count in range(50, 90):
        time = 2.468 + 0.1 * np.arange(count)
        run = read_run(table(tmp_path / "track.csv", time, np.outer(time, [3.0, 4.0, 0.0])), "track")
        for shift in (0.0, 0.137, 2.564):
            (row,) = compare([run.from_time(shift)])
            assert row["greatest_speed"] == pytest.approx(5.0), (count, shift)


def test_the_page_of_two_formation_flights(flight_bag: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    assert cli.main(["compare", str(flight_bag), str(flight_bag), "--names", "one,two", "--out", str(out)]) == 0
    figures = json.loads((out / "report.json").read_text())
    assert [row["name"] for row in figures] == ["one", "two"]
    assert figures[1]["difference_greatest"] == 0.0
    page = (out / "report.html").read_text()
    assert "Settled after" in page
    assert (out / "positions_iris_8.png").is_file()
    assert (out / "difference.png").is_file()


def test_incomparable_files_are_reported(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    make_flight(tmp_path / "a.bag", ("/uav0", "/uav1"), 2.0)
    make_flight(tmp_path / "b.bag", ("/uav2", "/uav3"), 2.0)
    a, b = str(tmp_path / "a.bag"), str(tmp_path / "b.bag")
    (tmp_path / "empty.csv").write_text("time,x,y,z\n")
    (tmp_path / "odd.csv").write_text("time,x,y\n1,2,3\n")
    (tmp_path / "words.csv").write_text("time,x,y,z\n1,2,3,four\n")
    for arguments, status, words in (
        ([a], 2, "1 runs are not allowed; 2 to"),
        ([a, b, "--names", "one"], 2, "2 different comma-separated names"),
        ([a, b], 1, "no vehicle is in all runs (a.bag has uav0, uav1; b.bag has uav2, uav3)"),
        ([a, b, "--vehicle", "uav0"], 1, "'b.bag' has no vehicle 'uav0'; it has uav2, uav3"),
        ([a, str(tmp_path / "no.bag")], 1, "does not exist"),
        ([a, str(tmp_path / "empty.csv")], 1, "no positions"),
        ([a, str(tmp_path / "odd.csv")], 1, "no column 'z'"),
        ([a, str(tmp_path / "words.csv")], 1, "cannot be read as a table"),
    ):
        assert cli.main(["compare", *arguments, "--out", str(tmp_path / "out")]) == status, arguments
        assert words in capfd.readouterr().err, arguments


def test_runs_have_distinct_names() -> None:
    assert names_of([Path("/runs/1/flight.bag"), Path("/runs/2/flight.bag")], None) == ["1/flight.bag", "2/flight.bag"]
    assert names_of([Path("/a.bag"), Path("/a.bag")], None) == ["1: a.bag", "2: a.bag"]
    logs = [Path(f"/log/iris_{number}/2020-01-01/00_00_00.ulg") for number in range(2)]
    assert names_of(logs, None) == ["iris_0", "iris_1"]
    assert names_of([Path("/a.bag"), Path("/b.ulg")], " x, y") == ["x", "y"]
