"""Films of flights as rviz shows them, without a screen: contents of the pictures, and rejections."""

from __future__ import annotations

import json
import math
import os
import resource
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import roslib.packages
import yaml
from conftest import Graph

from xtdrone_interaction.rviz.films import record_view
from xtdrone_interaction.rviz.films.film_options import as_words, film_settings
from xtdrone_interaction.rviz.films.view_nodes import CrashError

NAMES = ("iris_0", "typhoon_h480_0", "iris_1")  # the second one has joints, which the bag does not contain
MIDDLES = (0.0, 0.09, 0.0)  # m above base_link, centre of the visible part of each
STEP = 0.04  # s, a multiple of the simulator's step
COUNT = 16  # poses, and so frames
SIZE = (960, 540)  # larger than a window's initial size
DISTANCE, PITCH, YAW = 9.0, 0.6, 0.8  # the view's
FIELD = math.pi / 4.0  # rad, vertical, rviz's own
BACKGROUND = (232, 236, 242)
LIMIT = 560.0  # s of wall time for one film


def place(number: int, time: float) -> np.ndarray:
    """Return a vehicle's position: far enough from the others, and fast enough that a frame's delay would be seen."""
    x = 2.5 * (number - 1)
    return np.array([x, 3.0 * (time - 1.3) * (-1.0) ** number, 0.4 * number])


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recorded flight; the recorder's times are wrong, as is possible."""
    import rosbag
    import rospy
    from geometry_msgs.msg import PoseStamped

    path = tmp_path_factory.mktemp("recorded") / "flight.bag"
    with rosbag.Bag(str(path), "w") as file:
        for k in range(COUNT):
            time = 1.0 + STEP * k
            for number, name in enumerate(NAMES):
                message = PoseStamped()
                message.header.stamp = rospy.Time.from_sec(time)
                message.header.frame_id = "map"
                p, q = message.pose.position, message.pose.orientation
                (p.x, p.y, p.z), q.w = place(number, time), 1.0
                noted = rospy.Time.from_sec(0.7 + 0.2 * (k // 5))
                file.write(f"/{name}/mavros/local_position/pose", message, noted)
    return path


@pytest.fixture(scope="module")
def view(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A view of the robot models alone: every pixel off the background is a vehicle."""
    robots = [
        {
            "Class": "rviz/RobotModel",
            "Name": name,
            "Enabled": True,
            "Robot Description": f"/{name}/robot_description",
            "TF Prefix": name,
            "Update Interval": 0,
        }
        for name in NAMES
    ]
    orbit = {
        "Class": "rviz/Orbit",
        "Distance": DISTANCE,
        "Focal Point": {"X": 0, "Y": 0, "Z": 0},
        "Near Clip Distance": 0.05,
        "Pitch": PITCH,
        "Yaw": YAW,
        "Target Frame": "map",
    }
    window = {"Class": "rviz/Image", "Name": "Front", "Enabled": True, "Image Topic": "/front"}
    manager = {
        "Displays": [*robots, window],
        "Global Options": {"Background Color": "; ".join(map(str, BACKGROUND)), "Fixed Frame": "map"},
        "Views": {"Current": orbit},
    }
    path = tmp_path_factory.mktemp("view") / "models.rviz"
    path.write_text(yaml.safe_dump({"Visualization Manager": manager}), encoding="utf-8")
    return path


def project(point: np.ndarray) -> np.ndarray:
    """Return the pixel, x and y, at which the view's camera sees a point, m ENU."""
    away = np.array([math.cos(YAW) * math.cos(PITCH), math.sin(YAW) * math.cos(PITCH), math.sin(PITCH)])
    ahead = -away
    right = np.cross(ahead, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    relative = point - DISTANCE * away
    focal = 0.5 * SIZE[1] / math.tan(0.5 * FIELD)
    depth = relative @ ahead
    return np.array([
        0.5 * SIZE[0] + focal * (relative @ right) / depth,
        0.5 * SIZE[1] + focal * (relative @ np.cross(ahead, right)) / depth,
    ])  # fmt: skip


def record(*arguments: Any, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run ``xtdrone record-view``."""
    command = [sys.executable, "-m", "xtdrone_interaction", "record-view", *map(str, arguments)]
    return subprocess.run(
        command, env={**os.environ, **environment}, capture_output=True, text=True, timeout=LIMIT, check=False
    )


@pytest.fixture(scope="module")
def made(bag: Path, view: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """A folder with film.mp4 and its frames, and the output on standard error."""
    folder = tmp_path_factory.mktemp("film")
    size = "x".join(map(str, SIZE))
    done = record(view, "--bag", bag, "--fps", "25", "--size", size, "--out", folder / "film.mp4",
                  "--frames", folder / "frames")  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    return folder, done.stderr


@pytest.fixture
def film(made: tuple[Path, str]) -> Path:
    """The folder."""
    return made[0]


def test_only_a_display_with_a_separate_panel_is_omitted(made: tuple[Path, str]) -> None:
    said = [line for line in made[1].splitlines() if line.startswith("rviz: ")]
    words = "display 'Front' of class rviz/Image has a panel of its own, beside the view; it is left out"
    assert said == [f"rviz: {words}"]


def test_vehicles_are_seen_where_they_are_in_each_frame_and_nothing_is_seen_elsewhere(film: Path) -> None:
    files = sorted((film / "frames").iterdir())
    assert len(files) >= COUNT
    for k, file in enumerate(files[:COUNT]):
        picture = cv2.imread(str(file))[..., ::-1].astype(int)
        assert picture.shape == (SIZE[1], SIZE[0], 3)
        seen = np.abs(picture - BACKGROUND).max(axis=2) > 12
        rows, columns = np.nonzero(seen)
        pixels = np.stack([columns, rows], axis=1) + 0.5
        middles = [np.add(place(number, 1.0 + STEP * k), [0.0, 0.0, middle]) for number, middle in enumerate(MIDDLES)]
        places = np.array([project(middle) for middle in middles])
        distances = np.linalg.norm(pixels[:, None] - places, axis=2)
        nearest = distances.argmin(axis=1)
        assert distances.min(axis=1).max() < 45.0, f"frame {k}: something is where no vehicle is"
        for number in range(len(NAMES)):
            own = pixels[nearest == number]
            assert len(own) > 150, f"frame {k}: {NAMES[number]} is not seen at {places[number]}"
            # A frame later it is 5 to 9 pixels away.
            assert np.linalg.norm(own.mean(axis=0) - places[number]) < 2.5, (k, number, own.mean(axis=0), places)


def test_the_film_has_the_frames(film: Path) -> None:
    capture = cv2.VideoCapture(str(film / "film.mp4"))
    assert capture.get(cv2.CAP_PROP_FPS) == pytest.approx(25.0)
    frames = []
    while (read := capture.read())[0]:
        frames.append(read[1])
    files = sorted((film / "frames").iterdir())
    assert len(frames) == len(files)
    for frame, file in zip(frames, files, strict=True):
        assert np.abs(frame.astype(int) - cv2.imread(str(file))).mean() < 3.0


def test_nothing_is_left(film: Path) -> None:
    assert sorted(path.name for path in film.iterdir()) == ["film.mp4", "frames"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["sideways"], "view: 'sideways' is neither an .rviz file nor one of vehicle, formation, search"),
        (["formation", "--bag", "nowhere.bag"], "bag: nowhere.bag does not exist"),
        (["formation", "--out", "film.avi"], "out: 'film.avi' is not allowed; a film ends with .mp4"),
        (["formation", "--out", "nowhere/film.mp4"], "nowhere is no folder"),
        (["formation", "--size", "1280"], "size: '1280' is not allowed; WIDTHxHEIGHT"),
        (["formation", "--fps", "60"], "60 frames a simulated second are not allowed; 1 to 50"),
        (["formation", "--faster", "0"], "--faster: '0' is not allowed, above 0"),
        (["formation", "--from", "9", "--to", "3"], "from, to: 9 s is not before 3 s"),
        (["formation", "--", "--n", "3"], "'--n': options of a demo are for --demo only"),
    ],
)
def test_invalid_values_are_reported(
    arguments: list[str],
    message: str,
    capfd: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
) -> None:
    from xtdrone_interaction import cli

    monkeypatch.chdir(tmp_path)
    try:
        status = cli.main(["record-view", *arguments])
    except SystemExit as ended:  # argparse
        status = int(str(ended.code))
    assert status == 2
    assert message in capfd.readouterr().err
    assert not list(tmp_path.iterdir())


def test_options_after_two_dashes_are_the_demos(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:

    monkeypatch.chdir(tmp_path)
    settings = film_settings(["search", "--demo", "formation", "--faster", "2", "--", "--n", "3", "--headless"])
    assert settings.demo_options == ("--n", "3", "--headless")
    assert (settings.view, settings.demo, settings.rate) == ("search", "formation", 15.0)


def test_a_file_other_than_a_bag_is_reported(tmp_path: Path) -> None:
    (tmp_path / "flight.bag").write_text("no bag", encoding="utf-8")
    done = record("formation", "--bag", tmp_path / "flight.bag")
    assert done.returncode == 1
    assert "flight.bag cannot be read" in done.stderr
    assert not (tmp_path / "formation.mp4").exists()


def test_an_interval_outside_the_bag_is_reported(bag: Path, tmp_path: Path) -> None:
    done = record("formation", "--bag", bag, "--from", 30, "--out", tmp_path / "film.mp4")
    assert done.returncode == 2
    assert "from, to: the flight has no data in that interval; " in done.stderr
    assert "has 1.0 to 1.6 s" in done.stderr


def test_a_film_whose_drawing_crashes_is_drawn_once_again(bag: Path, view: Path, tmp_path: Path) -> None:
    """The first drawing node dies by SIGSEGV; its core is kept where the system lets it have one."""
    real, crashed = roslib.packages.find_node("xtdrone_rviz", "rviz_offscreen")[0], tmp_path / "crashed"
    overlay = tmp_path / "overlay"
    stand_in = overlay / "lib" / "xtdrone_rviz" / "rviz_offscreen"
    stand_in.parent.mkdir(parents=True)
    (overlay / ".catkin").touch()
    stand_in.write_text(
        f'#!/bin/sh\n[ -e {crashed} ] && exec {real} "$@"\ntouch {crashed}\nkill -SEGV $$\n', encoding="utf-8"
    )
    stand_in.chmod(0o755)
    prefix = f"{overlay}:{os.environ['CMAKE_PREFIX_PATH']}"
    out = tmp_path / "film.mp4"
    run = record(view, "--bag", bag, "--out", out, "--to", 1.1, CMAKE_PREFIX_PATH=prefix)
    assert run.stderr.count("rviz_offscreen has crashed (SIGSEGV); ") == 1, run.stderr
    assert run.stderr.count("the film is drawn once again") == 1
    assert (run.returncode, out.exists()) == (0, True), run.stderr
    with_core = Path("/proc/sys/kernel/core_pattern").read_text(encoding="utf-8").strip() == "core"
    if with_core and resource.getrlimit(resource.RLIMIT_CORE)[1]:
        assert f"core: {out.with_suffix('.core')}" in run.stderr
        assert out.with_suffix(".core").stat().st_size > 0


def test_the_second_drawing_has_the_settings_of_the_first(tmp_path: Path) -> None:
    (tmp_path / "flight.bag").touch()
    words = f"search --bag {tmp_path}/flight.bag --fps 12.5 --faster 3 --size 640x480 --rough".split()
    words += ["--from", "1.25", "--to", "7", "--world", "outdoor", "--frames", f"{tmp_path}/frames"]
    for given in (words, words[:3]):
        first = film_settings(given)
        (tmp_path / "frames").mkdir(exist_ok=True)
        (tmp_path / "frames" / "0.png").touch()  # of the first drawing
        assert film_settings(as_words(first)) == replace(first, again=True)
        shutil.rmtree(tmp_path / "frames")


def test_a_film_whose_second_drawing_crashes_is_given_up(
    bag: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def crash(*_: Any) -> None:
        raise CrashError("it has crashed")

    monkeypatch.setattr(record_view, "film_bag", crash)
    monkeypatch.setattr(record_view, "check_tools", lambda: None)
    drawn: list[bool] = []

    def draw(command: list[str]) -> int:
        settings = film_settings(command[command.index("record-view") + 1 :])
        drawn.append(settings.again)
        return record_view._run(settings)

    monkeypatch.setattr(record_view, "_fly", draw)
    assert record_view._run(film_settings(["search", "--bag", str(bag)])) == 1
    assert drawn == [True]
    assert capsys.readouterr().err.count("it has crashed") == 2


def test_no_frame_is_no_film_even_where_an_older_one_is(bag: Path, tmp_path: Path) -> None:
    nowhere = {"Displays": [{"Class": "rviz/Grid"}], "Global Options": {"Fixed Frame": "elsewhere"}}
    config = tmp_path / "nowhere.rviz"
    config.write_text(yaml.safe_dump({"Visualization Manager": nowhere}), encoding="utf-8")
    (tmp_path / "film.mp4").write_text("older", encoding="utf-8")
    done = record(config, "--bag", bag, "--fps", 25, "--size", "64x64", "--out", tmp_path / "film.mp4")
    assert done.returncode == 1
    assert "no frame was drawn" in done.stderr
    assert "TF does not know the fixed frame 'elsewhere'" in done.stderr
    assert (tmp_path / "film.mp4").read_text(encoding="utf-8") == "older"


def test_the_benchmark_films_vehicles_that_circle(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "benchmarks.programs.rviz", "--vehicles", "2", "--width", "320",
               "--height", "180", "--rough", "--seconds", "0.5", "--json", tmp_path / "row.json"]  # fmt: skip
    done = subprocess.run(command, capture_output=True, text=True, timeout=LIMIT, check=False)
    assert done.returncode == 0, done.stderr
    (row,) = json.loads((tmp_path / "row.json").read_text(encoding="utf-8"))
    assert row["frames"] > 0
    assert row["frames_per_second"] == pytest.approx(row["frames"] / row["elapsed"])
    assert {"rviz_offscreen", "ffmpeg", "robot_tf", "swarm_markers"} <= row["cpu_per_frame"].keys()


@pytest.mark.parametrize(
    ("file", "arguments", "count"),
    [
        ("multi_vehicle.launch", ["vehicles:=iris:2"], 3),
        ("multi_vehicle.launch", ["vehicles:=iris:2,typhoon_h480", "tf:=true", "mavros_nodes:=per_uav"], 5),
        ("formation.launch", ["n:=6", "processes:=shared"], 7),
        ("search.launch", ["n:=2"], "/mavros,/cameras,/communication,/yolo,/yolo_human_tracking,/search_mission"
                                    ",/robot_tf,/swarm_markers"),
    ],
)  # fmt: skip
def test_launch_files_start_rviz_and_time_waits_for_its_nodes(
    file: str, arguments: list[str], count: int | str
) -> None:
    launch = str(Path(__file__).parents[1] / "launch" / file)

    def ask(question: str) -> str:
        command = ["roslaunch", question, launch, *arguments, "rviz:=true"]
        return subprocess.run(command, capture_output=True, text=True, timeout=LIMIT, check=True).stdout

    nodes = ask("--nodes").split()
    assert [nodes.count(name) for name in ("/robot_tf", "/swarm_markers", "/rviz")] == [1, 1, 1]
    assert yaml.safe_load(ask("--dump-params"))["/simulator/participants"] == count


def test_rviz_without_a_screen_suggests_record_view(graph: Graph) -> None:
    graph.forget_parameters()
    import roslib.packages

    environment = {**os.environ, **graph.environment}
    environment.pop("DISPLAY", None)
    program = str(roslib.packages.find_node("xtdrone_interaction", "rviz_view.py")[0])
    done = subprocess.run(
        [program, "formation"], env=environment, capture_output=True, text=True, timeout=LIMIT, check=False
    )
    assert done.returncode == 1
    assert "there is no screen, DISPLAY is not set; without one ./xtdrone record-view" in done.stderr
    environment["DISPLAY"] = ":7797"
    done = subprocess.run(
        [program, "sideways"], env=environment, capture_output=True, text=True, timeout=LIMIT, check=False
    )
    assert done.returncode == 2
    assert "parameter /xtdrone/fleet is not set" in done.stderr


def test_without_xvfb_the_message_names_the_package(bag: Path, tmp_path: Path) -> None:
    (tmp_path / "ffmpeg").symlink_to(shutil.which("ffmpeg") or "")
    done = record("formation", "--bag", bag, "--out", tmp_path / "film.mp4", PATH=str(tmp_path))
    assert done.returncode == 1
    assert "Xvfb: not found; install it (Debian: apt-get install xvfb)" in done.stderr


# ---- the node itself


def drawer() -> str:
    import roslib.packages

    return str(roslib.packages.find_node("xtdrone_rviz", "rviz_offscreen")[0])


def run_drawer(graph: Graph, config: Path, *arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
    command = [drawer(), f"_config:={config}", *arguments]
    environment = {**os.environ, **graph.environment, **environment}
    return subprocess.run(command, env=environment, capture_output=True, text=True, timeout=LIMIT, check=False)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("Visualization Manager: [", "cannot be read"),
        ("Background\\ ColorR=0.1\nFixed\\ Frame=/map\n", "is no .rviz file of rviz 1.x"),
        ("Panels: []\n", "it has no 'Visualization Manager'"),
        ("Visualization Manager:\n  Tools: []\n", "has no list 'Displays'"),
        (
            "Visualization Manager:\n  Displays:\n    - Class: rviz_default_plugins/Grid\n      Name: Grid\n",
            "is of ROS 2's rviz (it has a rviz_default_plugins/Grid)",
        ),
    ],
    ids=["broken", "old", "something-else", "no-displays", "ros2"],
)
def test_an_invalid_configuration_is_reported(graph: Graph, tmp_path: Path, text: str, message: str) -> None:
    config = tmp_path / "bad.rviz"
    config.write_text(text, encoding="utf-8")
    done = run_drawer(graph, config)
    assert done.returncode == 2, done.stderr
    assert f"configuration {config}: " in done.stderr
    assert message in done.stderr


@pytest.mark.parametrize(
    ("argument", "status", "message"),
    [
        ("_rate:=0", 2, "/rviz_offscreen/rate: '0' is not allowed, a number from 0.1 to 50"),
        ("_width:=high", 2, "/rviz_offscreen/width: 'high' is not allowed, a whole number from 64 to 4096"),
        ("_antialiasing:=2", 2, "/rviz_offscreen/antialiasing: '2' is not allowed, true or false"),
        ("_film:=/tmp/film.gif", 2, "'/tmp/film.gif' is not allowed, it ends with .mp4"),
        ("_frames:=/nowhere", 2, "~frames: /nowhere is no folder"),
        ("_film:=/nowhere/film.mp4", 1, "film /nowhere/film.mp4: cannot be written: No such file or directory"),
        ("_display:=:7797", 1, "~display: no X server answers at ':7797'"),
    ],
)
def test_an_invalid_parameter_is_reported(graph: Graph, view: Path, argument: str, status: int, message: str) -> None:
    graph.forget_parameters()
    done = run_drawer(graph, view, argument)
    graph.forget_parameters()
    assert done.returncode == status
    assert message in done.stderr


def test_without_a_master_the_node_reports_it() -> None:
    environment = {**os.environ, "ROS_MASTER_URI": "http://127.0.0.1:1"}
    done = subprocess.run([drawer()], env=environment, capture_output=True, text=True, timeout=LIMIT, check=False)
    assert done.returncode == 1
    assert "no ROS master at http://127.0.0.1:1" in done.stderr


def test_the_node_itself_misses_xvfb_by_name(graph: Graph, view: Path) -> None:
    done = run_drawer(graph, view, PATH="/nowhere")
    assert done.returncode == 1
    assert "Xvfb: cannot be started: No such file or directory; install it" in done.stderr
