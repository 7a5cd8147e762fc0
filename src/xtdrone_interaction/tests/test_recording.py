"""Recording by profiles: which topics each takes, and what rosbag is called with."""

from __future__ import annotations

import ast
import os
import re
import sys
from pathlib import Path

import pytest

from xtdrone_interaction import cli
from xtdrone_interaction.options import OptionError
from xtdrone_interaction.recording import read_profile, rosbag_arguments

POSE, STATE, IMU = "/iris_0/mavros/local_position/pose", "/mavros/state", "/iris_0/mavros/imu/data_raw"
IMAGE, PACKED = "/typhoon_h480_0/cgo3_camera/image_raw", "/typhoon_h480_0/cgo3_camera/image_raw/compressed"
COMMAND, MAVLINK, BOXES = "/xtdrone/iris_0/cmd_vel_enu", "/mavlink/from", "/uav_0/darknet_ros/bounding_boxes"
TAKEN = {
    "light": {POSE, STATE, COMMAND, "/gazebo/model_states", "/rosout"},
    "full": {POSE, STATE, COMMAND, "/gazebo/model_states", "/rosout", IMU, MAVLINK, BOXES},
    "cameras": {POSE, STATE, COMMAND, "/gazebo/model_states", "/rosout", IMAGE, PACKED, BOXES},
}


@pytest.mark.parametrize("name", TAKEN)
def test_profiles_take_what_they_are_for(name: str) -> None:
    profile = read_profile(name)
    assert {topic for topic in set().union(*TAKEN.values()) if profile.takes(topic)} == TAKEN[name]
    arguments = rosbag_arguments(profile, "/tmp/out")
    given = arguments[-len(profile.topics) :]
    excluded = arguments[arguments.index("-x") + 1] if "-x" in arguments else "(?!)"
    for topic in set().union(*TAKEN.values()):  # as rosbag itself decides
        taken = any(re.fullmatch(entry, topic) for entry in given) and not re.fullmatch(excluded, topic)
        assert taken == profile.takes(topic), topic


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
    if pid == 0:  # it becomes rosbag
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


def test_wrong_arguments_are_said(capfd: pytest.CaptureFixture[str]) -> None:
    for arguments, words in (
        (["heavy"], "'heavy' is unknown; there are: cameras, full, light"),
        (["light", "--duration", "long"], "'long' is not allowed"),
        (["light", "--split", "0"], "split: 0"),
        (["light", "--split", "10", "--duration", "5"], "split: not with --duration"),
        (["light", "/topic"], "'/topic' is not allowed"),
    ):
        assert cli.main(["record", *arguments]) == 2
        assert words in capfd.readouterr().err
