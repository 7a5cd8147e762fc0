"""Recording by profiles: the topics of each, and the arguments of rosbag."""

from __future__ import annotations

import ast
import os
import re
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from xmlrpc.server import SimpleXMLRPCServer

import pytest

from xtdrone_interaction import cli, simulation_services
from xtdrone_interaction.bags.record_by_profile import read_profile, ros_environment, rosbag_arguments
from xtdrone_interaction.command_options import OptionError
from xtdrone_interaction.recording.flight_events import EventsFile

POSE, STATE, IMU = "/iris_0/mavros/local_position/pose", "/mavros/state", "/iris_0/mavros/imu/data_raw"
IMAGE, PACKED = "/typhoon_h480_0/cgo3_camera/image_raw", "/typhoon_h480_0/cgo3_camera/image_raw/compressed"
COMMAND, MAVLINK, BOXES = "/xtdrone/iris_0/cmd_vel_enu", "/mavlink/from", "/uav_0/darknet_ros/bounding_boxes"
TRUTH, CLOUD = "/xtdrone/iris_0/ground_truth/odom", "/iris_0/velodyne_points"
ODOMETRY = "/iris_0/lidar_odometry/odometry"
TAKEN = {
    "light": {POSE, STATE, COMMAND, TRUTH, "/gazebo/model_states", "/rosout"},
    "full": {POSE, STATE, COMMAND, TRUTH, "/gazebo/model_states", "/rosout", IMU, MAVLINK, BOXES, CLOUD, ODOMETRY},
    "cameras": {POSE, STATE, COMMAND, TRUTH, "/gazebo/model_states", "/rosout", IMAGE, PACKED, BOXES},
    "slam": {POSE, STATE, TRUTH, "/gazebo/model_states", "/rosout", IMAGE, IMU, CLOUD, ODOMETRY},
}


@pytest.mark.parametrize("name", TAKEN)
def test_profiles_select_their_topics(name: str) -> None:
    profile = read_profile(name)
    assert {topic for topic in set().union(*TAKEN.values()) if profile.includes(topic)} == TAKEN[name]
    arguments = rosbag_arguments(profile, "/tmp/out")
    given = arguments[-len(profile.topics) :]
    excluded = arguments[arguments.index("-x") + 1] if "-x" in arguments else "(?!)"
    for topic in set().union(*TAKEN.values()):  # rosbag's own selection
        taken = any(re.fullmatch(entry, topic) for entry in given) and not re.fullmatch(excluded, topic)
        assert taken == profile.includes(topic), topic


@pytest.mark.parametrize(
    ("given", "expected"),
    [(["--split", "10"], {"--split", "--size=10"}), (["--duration", "5m"], {"--duration=5m"})],
)
def test_rosbag_is_called_with_the_profile(tmp_path: Path, given: list[str], expected: set[str]) -> None:
    program = tmp_path / "rosbag"
    called = tmp_path / "called"
    code = f"import sys\nopen({str(called)!r}, 'w').write(repr(sys.argv[1:]))\n"
    program.write_text(f"#!{sys.executable}\n{code}")
    program.chmod(0o755)
    out = tmp_path / "new" / "flight"
    pid = os.fork()
    if pid == 0:  # the child becomes rosbag
        os.environ["PATH"] = f"{tmp_path}:{os.environ['PATH']}"
        os._exit(cli.main(["record", "light", "--out", str(out), *given, "__name:=recorder"]))
    assert os.waitpid(pid, 0)[1] == 0
    words = ast.literal_eval(called.read_text())
    assert expected | {"record", "-e", "--lz4", "__name:=recorder", str(out)} <= set(words)
    assert ("--split" in words) == ("--split" in given)  # with it, rosbag would begin a new file after each duration
    assert out.parent.is_dir()


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("topics: [a]\nsize: 3", "'size' is not allowed"),
        ("topics: [a]\ncompression: zip", "compression 'zip' is not allowed; none, lz4, bz2"),
        ("topics: ['(']", "is no regular expression"),
        ("topics: a", "is not a list"),
        ("topics: []", "has no topics"),
        ("topics: [a]\nsplit: 0", "split 0 is not allowed"),
        ("- a", "'list' is not allowed"),
        ("{", "cannot be read"),
    ],
)
def test_profiles_of_ones_own_are_checked(tmp_path: Path, text: str, words: str) -> None:
    (tmp_path / "mine.yaml").write_text(text)
    with pytest.raises(OptionError, match=re.escape(words)):
        read_profile(str(tmp_path / "mine.yaml"))


def test_invalid_arguments_are_reported(capfd: pytest.CaptureFixture[str]) -> None:
    for arguments, words in (
        (["heavy"], "'heavy' is unknown; there are: cameras, full, light"),
        (["light", "--duration", "long"], "'long' is not allowed"),
        (["light", "--split", "0"], "split: 0"),
        (["light", "--split", "10", "--duration", "5"], "split: cannot be combined with --duration"),
        (["light", "/topic"], "'/topic' is not allowed"),
    ):
        assert cli.main(["record", *arguments]) == 2
        assert words in capfd.readouterr().err


@pytest.fixture
def masters() -> Iterator[Callable[[bool], str]]:
    """Return a function that starts a ROS master, with or without a simulator, and returns its URI."""
    started = []

    def start(simulator: bool) -> str:
        server = SimpleXMLRPCServer(("127.0.0.1", 0), logRequests=False)
        services = {"/simulator/get_status": "rosrpc://127.0.0.1:1"} if simulator else {}
        server.register_function(
            lambda _, name: [1, "", services[name]] if name in services else [-1, "unknown", ""], "lookupService"
        )
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
        thread.start()
        started.append((server, thread))
        return f"http://127.0.0.1:{server.server_address[1]}"

    yield start
    for server, thread in started:
        server.shutdown()
        thread.join()
        server.server_close()


@pytest.fixture
def workspace(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Replace the workspace's folder of flights by an empty one, and return it."""
    runs = tmp_path / "runs"
    runs.mkdir()
    monkeypatch.setattr(simulation_services, "RUNS", runs)
    monkeypatch.chdir(tmp_path)
    for name in ("ROS_IP", "ROS_HOSTNAME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("ROS_MASTER_URI", "http://127.0.0.1:1")
    return runs


def test_without_a_master_nothing_is_recorded(workspace: Path, capfd: pytest.CaptureFixture[str]) -> None:
    for arguments, words in (
        (["light"], "no ROS master answers at http://127.0.0.1:1"),
        (["light", "--master", "2"], "none answers at http://127.0.0.1:2"),
    ):
        assert cli.main(["record", *arguments]) == 1
        assert words in capfd.readouterr().err


def test_a_demos_flight_is_found_by_its_folder(workspace: Path, masters: Callable[[bool], str]) -> None:
    flight = masters(True)
    (workspace / "one").mkdir()
    (workspace / "one" / simulation_services.MASTER_FILE).write_text(flight)
    environment, origin = ros_environment("", launched=False)
    assert (environment["ROS_MASTER_URI"], environment["ROS_IP"]) == (flight, "127.0.0.1")
    assert str(workspace / "one") in origin


def test_a_master_without_a_simulator_is_that_of_real_uavs(
    workspace: Path, masters: Callable[[bool], str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ROS_MASTER_URI", masters(False))
    environment, origin = ros_environment("", launched=False)
    assert (environment, origin) == (dict(os.environ), "")


def test_a_launched_recorder_uses_the_master_of_roslaunch(workspace: Path, masters: Callable[[bool], str]) -> None:
    (workspace / "other").mkdir()
    (workspace / "other" / simulation_services.MASTER_FILE).write_text(masters(True))
    assert ros_environment("", launched=True) == (dict(os.environ), "")


def test_a_full_disk_ends_the_events_and_not_the_flight() -> None:
    words: list[str] = []
    events = EventsFile(Path("/dev/full"), words.append)
    for _ in range(3):
        events.write("{}\n")
        events.flush()
    events.close()
    assert words == ["events file /dev/full: No space left on device; no more is written"]
