"""The command ``demo simplified``: rejections, and a whole flight in one process."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from PIL import ImageGrab

from xtdrone_interaction import cli, command_options
from xtdrone_interaction.launching import supervised_launch
from xtdrone_interaction.missions.formation import cli as formation_cli
from xtdrone_interaction.missions.formation import simplified as simplified_demo
from xtdrone_interaction.missions.formation.cli import FormationSettings
from xtdrone_interaction.missions.formation.figures import frames as frames_of
from xtdrone_interaction.missions.formation.record import FormationRecord
from xtdrone_interaction.recording.positions import FleetTrack
from xtdrone_interaction.recording.recorded_flight import Change

DEMO = ["demo", "simplified"]
PATIENCE = 120.0  # s; bounds a broken test
ALONE = [*DEMO, "--without-ros"]


@pytest.fixture(autouse=True)
def no_display(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Disable the window, and direct results into the test's folder."""
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    monkeypatch.chdir(tmp_path)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--n", "1"], "'1' is not allowed, a whole number from 2 to 10000"),
        (["--n", "many"], "'many' is not allowed"),
        (["--type", "zeppelin"], "vehicle type: 'zeppelin' is unknown; there are: "),
        (["--patterns", "cube,heart"], "pattern 'heart' is unknown for 9 vehicles; there are: "),
        (["--patterns", ","], "--patterns: ',' is not allowed"),
        (["--pattern-file", "/nowhere.yaml"], "pattern file /nowhere.yaml"),
        (["--model", "third-order"], "model 'third-order' is not known; first-order, second-order"),
        (["--model", "/nowhere.yaml"], "/nowhere.yaml"),
        (["--speed", "nan"], "--speed: 'nan' is not allowed"),
        (["--seed", "-1"], "--seed: '-1' is not allowed"),
        (["--follower", "mine.py"], "follower: mine.py does not exist"),
        (["--leader", "mine.py"], "leader: 'mine.py' is no FILE.py[:CLASS]"),
        (["--loss", "1.5"], "--loss: '1.5' is not allowed, 0 to 1"),
        (["--loss", "much"], "--loss: 'much' is not allowed, 0 to 1"),
        (["--range", "0"], "--range: '0' is not allowed, above 0 m"),
        (["--delay", "nan"], "--delay: 'nan' is not allowed, 0 to 60 s"),
        (["--film", "flight.avi"], "unknown ending '.avi'"),
        (["--film", "/nowhere/flight.gif"], "the folder /nowhere does not exist"),
        (["--n", "300", "--compare"], "comparison: 300 vehicles are not allowed in full physics, 250 at most"),
        (["--compare-with", "/nowhere.bag"], "comparison: /nowhere.bag does not exist"),
    ],
)
def test_invalid_values_are_reported(
    arguments: list[str], message: str, capfd: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    assert _status([*ALONE, *arguments]) == 2
    assert message in capfd.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_a_film_that_cannot_be_written_is_reported(capfd: pytest.CaptureFixture[str]) -> None:
    short = ["--n", "2", "--patterns", "origin", "--no-compare", "--headless"]
    assert _status([*ALONE, *short, "--film", "/proc/flight.png"]) == 1
    assert "Error: film /proc/flight.png: cannot be written" in " ".join(capfd.readouterr().out.split())


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--n", "300"], "'300' is not allowed on ROS, 2 to 250; --without-ros flies more"),
        (["--loss", "0.1"], "loss: --loss is available in one process only; add --without-ros"),
        (["--range", "20"], "range: --range is available in one process only; add --without-ros"),
    ],
)
def test_options_unavailable_on_ros_are_reported(
    arguments: list[str], message: str, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(command_options, "_taken", lambda number, kind: False)
    assert _status([*DEMO, *arguments]) == 2
    assert message in capfd.readouterr().err


def test_ros_gets_the_window_and_the_classes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The launch file receives them, with absolute paths."""
    monkeypatch.setattr(command_options, "_taken", lambda number, kind: False)
    monkeypatch.setattr(supervised_launch.shutil, "which", lambda program: program)
    flown: list[FormationSettings] = []
    monkeypatch.setattr(simplified_demo, "run_ros_demo", lambda demo, console: flown.append(demo) or 1)
    monkeypatch.setattr(formation_cli, "fly", lambda demo, console: flown.append(demo) or 1)
    (tmp_path / "mine.py").write_text(FOLLOWER + "\nfrom xtdrone_coordination.leader import Leader\n" + LEADER)
    classes = ["--follower", "mine.py:Brisk", "--leader", "mine.py:Mine"]
    assert cli.main([*DEMO, *classes]) == 1
    assert cli.main(["demo", "formation", *classes]) == 1
    with virtual_display() as display:
        monkeypatch.setenv("DISPLAY", display)
        assert cli.main([*DEMO]) == 1
        assert cli.main([*DEMO, "--headless"]) == 1
    given = [formation_cli.flight(settings).command() for settings in flown]
    for command in given[:2]:
        assert f"follower_class:={tmp_path}/mine.py:Brisk" in command
        assert f"leader_class:={tmp_path}/mine.py:Mine" in command
    assert ["view:=true" in command for command in given] == [False, False, True, False]
    assert [settings.speed for settings in flown] == [0.0, 0.0, 10.0, 0.0]


def _status(arguments: list[str]) -> int:
    try:
        return cli.main(arguments)
    except SystemExit as error:  # argparse
        return int(error.code or 0)


def test_a_recorded_flight_is_compared_with(
    tmp_path: Path, flight_bag: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    arguments = ["--patterns", "cube,pyramid,triangle", "--film", "none", "--compare-with", str(flight_bag)]
    assert cli.main([*ALONE, *arguments, "--out", "out"]) == 0
    comparison = json.loads((tmp_path / "out" / "report.json").read_text())["comparison"]
    assert comparison["with"] == str(flight_bag)
    assert [p["pattern"] for p in comparison["patterns"]] == ["origin", "cube", "pyramid", "triangle"]
    assert 0.05 < comparison["rms"] < 2.0  # the followers of the synthetic flight are faster
    assert (tmp_path / "out" / "comparison_1_origin_to_cube.png").is_file()
    assert "RMS difference over all" in capfd.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--n", "6", "--patterns", "T"], "6 vehicles cannot be compared with 9 vehicles"),
        (["--patterns", "triangle"], "patterns origin, triangle, origin cannot be compared with origin, cube, "),
    ],
)
def test_another_flight_than_the_recorded_one_is_rejected_before_it_is_flown(
    tmp_path: Path, flight_bag: Path, capfd: pytest.CaptureFixture[str], arguments: list[str], message: str
) -> None:
    assert _status([*ALONE, "--compare-with", str(flight_bag), *arguments]) == 2
    assert message in capfd.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_the_report_of_a_flight_without_ros_is_made_again(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    arguments = ["--n", "4", "--patterns", "cube", "--film", "none", "--out", "out"]
    assert cli.main([*ALONE, *arguments]) == 0
    first = json.loads((tmp_path / "out" / "report.json").read_text())
    for picture in (tmp_path / "out").glob("*.png"):
        picture.unlink()
    capfd.readouterr()
    assert cli.main(["report", "out/flight.npz"]) == 0
    assert "fly through each other" in capfd.readouterr().out
    assert (tmp_path / "out" / "formations.png").is_file()
    assert json.loads((tmp_path / "out" / "report.json").read_text()) == {**first, "died": []}


def test_with_a_display_the_flight_is_in_a_window_which_closes_at_its_end(tmp_path: Path) -> None:
    """The flight runs in its own process: Tk ends a process when a display closes on which it had a window."""
    arguments = ["--n", "4", "--patterns", "cube", "--no-compare", "--speed", "20", "--out", "out"]
    with virtual_display() as display:
        flight = subprocess.Popen(
            [sys.executable, "-m", "xtdrone_interaction.cli", *ALONE, *arguments],
            env={**os.environ, "DISPLAY": display}, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
        )  # fmt: skip
        shown = False
        while flight.poll() is None and not shown:
            shown = max(high for _, high in ImageGrab.grab(xdisplay=display).getextrema()) > 100
        output, _ = flight.communicate(timeout=120)
        assert max(high for _, high in ImageGrab.grab(xdisplay=display).getextrema()) == 0
    assert shown
    assert flight.returncode == 0, output
    assert not list((tmp_path / "out").glob("flight.mp4"))
    assert json.loads((tmp_path / "out" / "report.json").read_text())["outcome"] == "done"


@contextlib.contextmanager
def virtual_display() -> Iterator[str]:
    """Run an X server without a screen."""
    read, write = os.pipe()
    command = ["Xvfb", "-displayfd", str(write), "-screen", "0", "960x720x24", "-nolisten", "tcp", "-noreset"]
    server = subprocess.Popen(command, pass_fds=[write], stderr=subprocess.DEVNULL)
    os.close(write)
    try:
        with os.fdopen(read) as pipe:
            number = pipe.readline().strip()
        assert number, "Xvfb did not start"
        yield f":{number}"
    finally:
        server.terminate()
        server.wait()


FOLLOWER = """
from xtdrone_coordination.follower import Follower

class Brisk(Follower):
    def control_law(self, position, peers):
        return [1.2 * u for u in super().control_law(position, peers)]
"""


LEADER = """
class Mine(Leader):
    pass
"""


def test_a_flight_with_ones_own_follower(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """Report, pictures, comparison and film exist; the class is the user's in both simulators."""
    (tmp_path / "brisk.py").write_text(FOLLOWER)
    out = tmp_path / "out"
    arguments = ["--n", "6", "--patterns", "T", "--follower", "brisk.py", "--film", "last.png", "--out", str(out)]
    assert cli.main([*ALONE, *arguments]) == 0
    report = json.loads((out / "report.json").read_text())
    assert report["outcome"] == "done"
    assert report["settings"]["follower"] == "brisk:Brisk"
    assert report["settings"]["simulator"] == "simplified"
    assert [p["pattern"] for p in report["comparison"]["patterns"]] == ["origin", "T", "origin"]
    assert 0.0 < report["comparison"]["rms"] < 0.15
    assert (out / "comparison_1_origin_to_T.png").is_file()
    assert (out / "formations.png").is_file()
    assert (out / "flight.npz").is_file()
    assert (tmp_path / "last.png").stat().st_size > 10_000
    said = capfd.readouterr().out
    assert "Simplified against full physics" in said
    assert str(out / "report.json") in said


def test_a_follower_that_raises_is_reported_with_its_line(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "typo.py").write_text(FOLLOWER.replace("super().control_law(", "super().contrl_law("))
    arguments = ["--n", "3", "--patterns", "circle", "--follower", "typo.py", "--film", "none", "--no-compare"]
    assert cli.main([*ALONE, *arguments, "--out", "out"]) == 1
    said = " ".join(capfd.readouterr().out.split())
    assert "AttributeError: 'super' object has no attribute 'contrl_law'" in said
    assert "typo.py, line" in said
    assert not (tmp_path / "out").exists(), "nothing has come into it"


def test_a_missing_follower_file_is_reported(capfd: pytest.CaptureFixture[str]) -> None:
    assert cli.main([*ALONE, "--follower", "nowhere.py"]) == 2
    assert "follower: nowhere.py does not exist" in capfd.readouterr().err


def test_a_flight_that_misses_its_figures_ends_with_1(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "lazy.py").write_text(
        FOLLOWER.replace("[1.2 * u for u in super().control_law(position, peers)]", "0.0, 0.0, 0.0")
    )
    arguments = ["--n", "6", "--patterns", "T", "--follower", "lazy.py", "--film", "none", "--no-compare"]
    assert cli.main([*ALONE, *arguments, "--out", "out"]) == 1
    assert "Missed: pattern 'T' did not settle" in " ".join(capfd.readouterr().out.split())
    assert "comparison" not in json.loads((tmp_path / "out" / "report.json").read_text())


def test_ctrl_c_ends_it_with_130(tmp_path: Path) -> None:
    flight = subprocess.Popen(
        [sys.executable, "-m", "xtdrone_interaction.cli", *ALONE, "--speed", "0.5", "--out", str(tmp_path / "out")],
        stdout=subprocess.PIPE, text=True, env={**os.environ, "PYTHONUNBUFFERED": "1"},
    )  # fmt: skip
    assert flight.stdout is not None
    for line in flight.stdout:
        if "takeoff" in line:
            break
    flight.send_signal(signal.SIGINT)
    output, _ = flight.communicate(timeout=PATIENCE)
    assert flight.returncode == 130
    assert "stopped by SIGINT" in output


def test_pacing_makes_up_for_a_picture_but_not_for_a_pause(monkeypatch: pytest.MonkeyPatch) -> None:
    wall = 100.0
    monkeypatch.setattr(simplified_demo.time, "monotonic", lambda: wall)
    pacing = simplified_demo._Pacing(10.0)
    assert pacing.ahead(0.0) == 0.0
    wall += 0.1  # a picture was drawn: a second of flight is due
    assert pacing.ahead(0.5) == pytest.approx(-0.05)
    assert pacing.ahead(1.2) == pytest.approx(0.02)
    wall += 60.0  # a pause
    assert pacing.ahead(1.2) == pytest.approx(0.0)
    assert pacing.ahead(2.2) == pytest.approx(0.1)
    assert simplified_demo._Pacing(0.0).ahead(5.0) == 0.0


def test_help_shows_each_default_once_as_typed(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        cli.main([*DEMO, "--help"])
    said = " ".join(capsys.readouterr().out.split())
    assert "(default: cube,pyramid,triangle)" in said
    assert not any(word in said for word in ("None", "False", "['"))


def test_a_film_is_made_of_a_record_that_misses_a_topology() -> None:
    times = np.arange(0.0, 9.0, 0.1)
    slots = [np.array([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]]), np.array([[0.0, 1.0, 0.0], [0.0, -1.0, 0.0]])]
    links = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]])
    events = [
        {"event": "phase", "time": 1.0, "phase": "pattern one", "pattern": "one"},
        {"event": "assigned", "time": 1.0, "pattern": "one", "offsets": slots[0].tolist()},
        {"event": "phase", "time": 5.0, "phase": "pattern two", "pattern": "two"},
        {"event": "assigned", "time": 5.0, "pattern": "two", "offsets": slots[1].tolist()},
        {"event": "done", "time": 9.0},
    ]
    record = FormationRecord(
        ("iris_0", "iris_1", "iris_2"),
        FleetTrack("made up", times, np.zeros((len(times), 3, 3))),
        None,
        [Change(1.0, slots[0]), Change(5.0, slots[1])],
        [Change(5.1, links)],
        events,
    )
    frames = list(frames_of(record))
    assert frames[0].edges is None
    assert len(frames[-1].edges) == 2
