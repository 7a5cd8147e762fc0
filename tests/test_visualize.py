"""visualize.py beside a flight on the simplified simulator: films miss no frame, the window delays no node."""

from __future__ import annotations

import json
import os
import signal
import subprocess
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from conftest import START_LIMIT, Graph, Program, Stack, poll
from PIL import ImageGrab

pytest.importorskip("rospy")

from gazebo_msgs.msg import ModelStates
from geometry_msgs.msg import Point, Pose, PoseStamped
from std_msgs.msg import Float32MultiArray, Int32MultiArray, String

from xtdrone_coordination.patterns import Patterns, with_leader
from xtdrone_swarm.view import palette
from xtdrone_swarm.view.view_of_ros_flight import MODEL_STATES, ObservedFlight, pattern_name, pose_topic

NAMES = ("iris_0", "iris_1", "iris_2")
FPS = 10.0


# ---- drawing of the topics ----


def poses(points: np.ndarray) -> list[Pose]:
    return [Pose(position=Point(*map(float, p))) for p in points]


def take(flight: ObservedFlight, source: str, topic: str, message) -> None:
    flight.handlers(source)[topic][1](message)


@pytest.mark.parametrize("source", [MODEL_STATES, pose_topic("iris_0")])
def test_a_flight_is_known_from_its_topics(source: str) -> None:
    flight = ObservedFlight(NAMES)
    assert flight.frame(1.0) is None
    places = np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0], [7.0, 8.0, 9.0]])
    if source == MODEL_STATES:
        message = ModelStates(name=["ground_plane", *NAMES[::-1]], pose=[Pose(), *poses(places[::-1])])
        take(flight, source, MODEL_STATES, message)
    else:
        for name, pose in zip(NAMES, poses(places), strict=True):
            take(flight, source, pose_topic(name), PoseStamped(pose=pose))
    offsets = Patterns(3).offsets("triangle")
    pattern = Float32MultiArray(data=offsets.T.ravel().tolist())
    take(flight, source, "/xtdrone/formation_pattern", pattern)
    take(flight, source, "/xtdrone/communication_topology", Int32MultiArray(data=[0, 0, 0, 1, 0, 0, 1, 1, 0]))
    frame = flight.frame(1.5, "2 x")
    assert frame is not None
    assert (frame.positions == places).all()
    assert frame.slots == pytest.approx(places[0] + with_leader(offsets))
    assert frame.edges.tolist() == [[1, 0], [2, 0], [2, 1]]
    assert (frame.time, frame.title, frame.note) == (1.5, "triangle", "2 x")
    for empty in (Float32MultiArray(), Float32MultiArray(data=[1.0] * 3)):  # withdrawn; of another fleet
        take(flight, source, "/xtdrone/formation_pattern", empty)
        assert flight.frame(2.0).slots is None


def test_a_pattern_is_known_by_its_slots_whoever_has_which() -> None:
    patterns = Patterns(9)
    for name in ("cube", "pyramid", "triangle"):
        shuffled = np.random.default_rng(1).permutation(patterns.offsets(name)).astype(np.float32).astype(float)
        assert pattern_name(with_leader(shuffled)) == name
    assert pattern_name(with_leader(patterns.offsets("cube") + 0.3)) == ""


# ---- beside a flight ----


@pytest.fixture
def stack(graph: Graph, tmp_path: Path) -> Iterator[Stack]:
    graph.forget()
    stack = Stack(graph, tmp_path, "iris:3")
    yield stack
    stack.stop()
    graph.forget()


@pytest.fixture
def display() -> Iterator[str]:
    """An X server without a screen."""
    read, write = os.pipe()
    command = ["Xvfb", "-displayfd", str(write), "-screen", "0", "960x720x24", "-nolisten", "tcp", "-noreset"]
    server = subprocess.Popen(command, pass_fds=[write], stderr=subprocess.DEVNULL)
    os.close(write)
    with os.fdopen(read) as pipe:
        number = pipe.readline().strip()
    assert number, "Xvfb did not start"
    yield f":{number}"
    server.terminate()
    server.wait()


def fly(stack: Stack, *arguments: str) -> None:
    stack.launch("simplified.launch", "n:=3", "airborne:=true", *arguments)
    import rosgraph

    master = rosgraph.Master("/visualize_tests")
    poll(lambda: master.hasParam("/lockstep/wait"), "roslaunch sets its parameters")


def frames_of(path: Path) -> int:
    command = ["ffprobe", "-v", "error", "-count_frames", "-show_streams", "-of", "json", str(path)]
    found = json.loads(subprocess.run(command, capture_output=True, check=True, text=True).stdout)
    return int(found["streams"][0]["nb_read_frames"])


def test_a_film_has_every_frame_of_simulated_time(stack: Stack, tmp_path: Path) -> None:
    film = tmp_path / "flight.mp4"
    fly(stack, "speed:=0", "until:=3", "participants:=visualize")
    node = stack.run("visualize", "xtdrone_swarm", "visualize.py", "iris", "3", f"_film:={film}", f"_fps:={FPS:g}")
    assert node.end() == 0, node.output
    assert frames_of(film) == 1 + 3.0 * FPS, node.output  # one of the first tick, common to all
    assert stack.programs["roslaunch"].end() == 0
    assert not list(tmp_path.glob(".*part*"))


def test_a_film_that_is_ended_by_ctrl_c_is_complete(stack: Stack, tmp_path: Path) -> None:
    film = tmp_path / "flight.gif"
    fly(stack, "speed:=0", "participants:=visualize")
    node = stack.run("visualize", "xtdrone_swarm", "visualize.py", "iris", "3", f"_film:={film}", f"_fps:={FPS:g}")
    stack.wait(lambda: stack.time > 2.0, "time passes", wall=START_LIMIT)
    node.process.send_signal(signal.SIGINT)
    assert node.end() == 0, node.output
    assert frames_of(film) >= 2.0 * FPS
    stack.pass_time(1.0)  # the other nodes fly on


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_the_window_shows_the_flight_and_holds_nothing_up(
    stack: Stack, display: str, monkeypatch: pytest.MonkeyPatch, number: signal.Signals
) -> None:
    monkeypatch.setenv("DISPLAY", display)
    node = stack.run("visualize", "xtdrone_swarm", "visualize.py", "iris", "3")
    fly(stack, "speed:=0", "participants:=leader,followers_1_2")
    stack.run("leader", "xtdrone_coordination", "leader.py", "iris", "3")
    stack.run("followers_1_2", "xtdrone_coordination", "follower.py", "iris", "all", "3")
    stack.wait(lambda: stack.time > 1.0, "time passes", wall=START_LIMIT)
    stack.graph.say("/xtdrone/leader/cmd", String(data="triangle"))
    colours = np.round(255.0 * palette(3)).astype(int)

    def shown() -> bool:
        picture = np.array(ImageGrab.grab(xdisplay=display)).astype(int)
        return all((np.abs(picture - colour).max(axis=2) < 60).sum() > 30 for colour in colours)

    poll(shown, f"the window shows all vehicles; {node.output}")
    node.process.send_signal(signal.SIGSTOP)
    try:
        stack.pass_time(20.0)
    finally:
        node.process.send_signal(signal.SIGCONT)
    assert node.alive, node.output
    node.process.send_signal(number)
    assert node.end() == 0, node.output
    assert "Traceback" not in node.output


# ---- the simulator's own window ----


def window_processes(stack: Stack) -> list[int]:
    return [pid for pid, command in stack.processes().items() if "-m xtdrone_swarm.view iris 3" in command]


def start_simulator(stack: Stack, *arguments: str) -> Program:
    stack.graph.forget_parameters()
    node = stack.run("simulator", "xtdrone_swarm", "simplified_simulator", "iris", "3", *arguments)
    stack.wait(lambda: stack.time > 0.5, "time passes", wall=START_LIMIT)
    return node


def window_is_shown(display: str) -> bool:
    """Return whether the screen has anything but the black background."""
    return bool(np.array(ImageGrab.grab(xdisplay=display)).max() > 100)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_the_simulator_opens_a_window_on_a_display_and_closes_it(
    stack: Stack, display: str, monkeypatch: pytest.MonkeyPatch, number: signal.Signals
) -> None:
    monkeypatch.setenv("DISPLAY", display)
    node = start_simulator(stack, "_airborne:=true")
    poll(lambda: window_is_shown(display), f"the window is shown; {node.output}")
    assert len(window_processes(stack)) == 1
    node.process.send_signal(number)
    assert node.end() == (0 if number == signal.SIGINT else -signal.SIGKILL), node.output
    poll(lambda: not window_processes(stack), "the window is closed")


def test_closing_the_window_ends_nothing_else(stack: Stack, display: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DISPLAY", display)
    start_simulator(stack, "_view:=true", "_airborne:=true")
    poll(lambda: window_is_shown(display), "the window is shown")
    os.kill(window_processes(stack)[0], signal.SIGINT)
    poll(lambda: not window_is_shown(display), "the window is closed")
    stack.pass_time(1.0)


def test_no_window_without_a_request_or_a_display(stack: Stack, display: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    node = start_simulator(stack, "_speed:=0")
    assert window_processes(stack) == []
    node.process.send_signal(signal.SIGINT)
    assert node.end() == 0
    monkeypatch.setenv("DISPLAY", display)
    start_simulator(stack, "_speed:=0", "_view:=false")
    assert window_processes(stack) == []


def test_a_window_that_is_asked_for_needs_a_display(stack: Stack, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    stack.graph.forget_parameters()
    node = stack.run("simulator", "xtdrone_swarm", "simplified_simulator", "iris", "3", "_view:=true")
    assert node.end() == 1
    assert "~view: there is no display (DISPLAY is not set); a film needs none, see visualize.py" in node.output


def test_a_formation_flight_with_a_window(stack: Stack, display: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DISPLAY", display)
    stack.launch(
        "formation.launch", "simulator:=simplified", "n:=3", "patterns:=triangle", "processes:=shared", "view:=true",
        "speed:=0", "bag:=none",
    )  # fmt: skip
    poll(lambda: window_is_shown(display), "the window is shown")
    assert stack.programs["roslaunch"].end(200.0) == 0
    assert not window_is_shown(display)


def test_a_formation_flight_with_a_film(stack: Stack, tmp_path: Path) -> None:
    film = tmp_path / "last.png"
    launch = stack.launch(
        "formation.launch", "simulator:=simplified", "n:=3", "patterns:=triangle", "processes:=shared", "speed:=0",
        "bag:=none", f"view:={film}", f"out:={tmp_path}",
    )  # fmt: skip
    assert launch.end(200.0) == 0, launch.output
    events = [json.loads(line) for line in (tmp_path / "events.jsonl").read_text().splitlines()]
    assert events[-1]["event"] == "done"
    assert film.stat().st_size > 10_000


# ---- bad input ----


@pytest.mark.parametrize(
    ("arguments", "status", "words"),
    [
        (["iris"], 2, "2 arguments are needed, 1 were given"),
        (["iris", "0"], 2, "number of vehicles: '0' is not allowed"),
        (["zeppelin", "3"], 2, "unknown vehicle 'zeppelin'"),
        (["iris", "3"], 1, "there is no display (DISPLAY is not set); a film needs none"),
        (["iris", "3", "_film:=/nowhere/a.mp4"], 2, "the folder /nowhere does not exist"),
        (["iris", "3", "_film:=/tmp/a.avi"], 2, "unknown ending '.avi'"),
        (["iris", "3", "_film:=/tmp/a.mp4", "_fps:=fast"], 2, "'fast' frames per second are not allowed"),
        (["iris", "3", "_trails:=-1"], 2, "~trails: -1 is not allowed"),
    ],
)
def test_impossible_values_are_reported(
    stack: Stack, monkeypatch: pytest.MonkeyPatch, arguments: list[str], status: int, words: str
) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    node = stack.run("visualize", "xtdrone_swarm", "visualize.py", *arguments)
    assert node.end() == status, node.output
    assert words in node.output
    assert "Traceback" not in node.output
