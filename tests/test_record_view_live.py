"""A film of a running flight, and the pictures' topics; the remaining processes when a part of it dies."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from conftest import START_LIMIT, Graph, Program, Stack, poll

pytest.importorskip("rospy")

import rosgraph
from geometry_msgs.msg import PoseStamped, Twist, Vector3
from sensor_msgs.msg import CameraInfo, Image

NAMES = ("iris_0", "iris_1")
BACKGROUND = (232, 236, 242)
RATE = 25  # Hz
END_LIMIT = 120.0  # wall s
PROGRAMS = ("rviz_offscreen", "Xvfb", "ffmpeg", "robot_tf", "swarm_markers")


@pytest.fixture
def stack(graph: Graph, tmp_path: Path) -> Iterator[Stack]:
    """Two vehicles in the air on the simplified simulator."""
    graph.forget()
    graph.forget_parameters()
    stack = Stack(graph, tmp_path, "iris:2")
    try:
        stack.run("simulator", "xtdrone_swarm", "simplified_simulator", "iris", "2", "_airborne:=true", "_speed:=1")
        poll(
            lambda: rosgraph.Master("/system_tests").hasParam("/lockstep/uri"), "the simulator's lockstep", START_LIMIT
        )
        yield stack
    finally:
        stack.stop()


def record(stack: Stack, folder: Path) -> Program:
    """Film the flight into film.mp4 of a folder, and wait until a frame has been drawn."""
    robots = [
        {
            "Class": "rviz/RobotModel",
            "Enabled": True,
            "Robot Description": f"/{name}/robot_description",
            "TF Prefix": name,
        }
        for name in NAMES
    ]
    orbit = {"Class": "rviz/Orbit", "Distance": 12.0, "Pitch": 0.7, "Yaw": 4.0, "Target Frame": "iris_0/base_link"}
    manager = {
        "Displays": robots,
        "Global Options": {"Background Color": "; ".join(map(str, BACKGROUND)), "Fixed Frame": "map"},
        "Views": {"Current": orbit},
    }
    view, frames = stack.folder / "models.rviz", folder / "frames"
    view.write_text(yaml.safe_dump({"Visualization Manager": manager}), encoding="utf-8")
    command = [sys.executable, "-m", "xtdrone_interaction", "record-view", str(view), "--master", str(stack.graph.port),
               "--fps", str(RATE), "--size", "640x360", "--out", str(folder / "film.mp4"),
               "--frames", str(frames)]  # fmt: skip
    program = stack.start("record-view", command)
    poll(lambda: list(frames.glob("*.png")) or not program.alive, "the first frame", START_LIMIT)
    assert program.alive, program.output
    return program


def frames_of(film: Path) -> int:
    """Return the number of readable frames of a film."""
    capture = cv2.VideoCapture(str(film))
    count = 0
    while capture.read()[0]:
        count += 1
    return count


def left(stack: Stack) -> list[str]:
    """Return the film's programs that still run."""
    return [command for command in stack.processes().values() if any(name in command for name in PROGRAMS)]


def kill(stack: Stack, program: str) -> None:
    """Kill the process that runs ``program``."""
    found = [pid for pid, command in stack.processes().items() if Path(command.split(" ")[0]).name == program]
    assert len(found) == 1, (program, stack.processes())
    os.kill(found[0], signal.SIGKILL)


def test_topics_show_the_vehicles_where_they_are_and_the_film_ends_with_the_flight(graph: Graph, stack: Stack) -> None:
    program = record(stack, stack.folder)
    places = [graph.hear(f"/{name}/mavros/local_position/pose", PoseStamped) for name in NAMES]
    kinds = {"image": Image, "camera_info": CameraInfo, "camera_pose": PoseStamped}
    ears = [graph.hear(f"/rviz_offscreen/{topic}", kind) for topic, kind in kinds.items()]
    graph.say("/xtdrone/iris_1/cmd_vel_flu", Twist(linear=Vector3(1.0, 0.0, 0.0)))
    stack.wait(lambda: all(len(ear.messages) > 10 for ear in ears), "ten pictures")
    compared = 0
    for image in ears[0].messages[-10:]:
        stamp = image.header.stamp
        info, camera, *poses = (
            next((m for m in ear.messages if m.header.stamp == stamp), None) for ear in (*ears[1:], *places)
        )
        if any(message is None for message in (info, camera, *poses)):
            continue  # it arrived before the subscription
        assert (image.header.frame_id, camera.header.frame_id, image.encoding) == ("map", "map", "rgb8")
        assert (image.width, image.height) == (info.width, info.height) == (640, 360)
        picture = np.frombuffer(image.data, np.uint8).reshape(360, 640, 3).astype(int)
        rows, columns = np.nonzero(np.abs(picture - BACKGROUND).max(axis=2) > 12)
        pixels = np.stack([columns, rows], axis=1) + 0.5
        expected = np.array([seen_at(pose, camera, info) for pose in poses])
        distances = np.linalg.norm(pixels[:, None] - expected, axis=2)
        assert distances.min(axis=1).max() < 40.0
        for number in range(len(NAMES)):
            own = pixels[distances.argmin(axis=1) == number]
            assert len(own) > 60
            assert np.linalg.norm(own.mean(axis=0) - expected[number]) < 2.5
        compared += 1
    assert compared >= 3
    stack.programs["simulator"].process.send_signal(signal.SIGINT)
    assert program.end(END_LIMIT) == 0, program.output
    assert frames_of(stack.folder / "film.mp4") == len(list((stack.folder / "frames").glob("*.png")))
    assert not left(stack)


def seen_at(pose: PoseStamped, camera: PoseStamped, info: CameraInfo) -> np.ndarray:
    """Return the pixel at which a camera sees a vehicle."""
    q = camera.pose.orientation
    x, y, z, w = q.x, q.y, q.z, q.w
    rotation = np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ])  # fmt: skip
    p, c = pose.pose.position, camera.pose.position
    ray = rotation.T @ [p.x - c.x, p.y - c.y, p.z - c.z]
    return np.array([info.K[2] + info.K[0] * ray[0] / ray[2], info.K[5] + info.K[4] * ray[1] / ray[2]])


def test_the_flight_continues_without_the_film(stack: Stack, tmp_path: Path) -> None:
    def interrupt() -> None:
        stack.programs["record-view"].process.send_signal(signal.SIGINT)

    endings: dict[str, tuple[Callable[[], None], int, str, bool]] = {  # exit status, text, whether a film exists
        "ctrl-c": (interrupt, 130, "stopped by SIGINT", True),
        "no-xvfb": (partial(kill, stack, "Xvfb"), 1, "rviz_offscreen has failed (status 1)", True),
        "no-ffmpeg": (partial(kill, stack, "ffmpeg"), 1, "ffmpeg has ended", False),
        "no-node": (partial(kill, stack, "rviz_offscreen"), 1, "rviz_offscreen has failed (status -9)", False),
    }
    for name, (end, status, words, film) in endings.items():
        folder = tmp_path / name
        folder.mkdir()
        program = record(stack, folder)
        end()
        assert program.end(END_LIMIT) == status, (name, program.output)
        assert words in program.output, name
        assert ("partial film: " in program.output) == (name == "no-node"), name
        assert (frames_of(folder / "film.mp4") > 0) == film, name
        poll(lambda: not left(stack), "nothing of the film is left", END_LIMIT)
        stack.pass_time(0.2)
