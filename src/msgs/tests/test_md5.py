"""The MD5 sums of our message types are those that MAVROS, Gazebo and other tools expect.

ROS rejects a connection when the sums of the two ends differ, so types with equal sums are interchangeable.
"""

from __future__ import annotations

import functools
import importlib
import importlib.util
import subprocess
from pathlib import Path
from typing import NamedTuple

import genmsg
import genmsg.gentools
import genmsg.msg_loader
import pytest
import rospkg

PACKAGES_DIR = Path(__file__).resolve().parents[1]
SUMS_FILE = Path(__file__).with_name("md5sums.txt")


class Expected(NamedTuple):
    """One line of md5sums.txt.

    Attributes:
        package: Name of the message package.
        name: Name of the type in its package.
        kind: `msg` or `srv`.
        md5: The sum, 32 hexadecimal digits.
    """

    package: str
    name: str
    kind: str
    md5: str

    @property
    def type_name(self) -> str:
        """The type as ROS writes it, package/Name."""
        return f"{self.package}/{self.name}"


def read_expected() -> list[Expected]:
    """Read md5sums.txt: one `package/Name kind md5` per line; # starts a comment line."""
    lines = [line for line in SUMS_FILE.read_text().splitlines() if line and not line.startswith("#")]
    return [Expected(*line.replace("/", " ").split()) for line in lines]


EXPECTED = read_expected()
ALL_TYPES = pytest.mark.parametrize("expected", EXPECTED, ids=[f"{e.type_name}.{e.kind}" for e in EXPECTED])


@functools.cache
def search_path() -> dict[str, list[str]]:
    """Return the folders with .msg files by package: this workspace's and the ROS installation's."""
    ros = rospkg.RosPack([str(PACKAGES_DIR), *rospkg.get_ros_paths()])
    folders = {package: Path(ros.get_path(package), "msg") for package in ros.list()}
    return {package: [str(folder)] for package, folder in folders.items() if folder.is_dir()}


def source_md5(expected: Expected) -> str:
    """Return the sum that genmsg computes from the definition in the source tree."""
    context = genmsg.MsgContext.create_default()
    path = PACKAGES_DIR / expected.package / expected.kind / f"{expected.name}.{expected.kind}"
    load = genmsg.msg_loader.load_msg_from_file if expected.kind == "msg" else genmsg.msg_loader.load_srv_from_file
    spec = load(context, str(path), expected.type_name)
    genmsg.msg_loader.load_depends(context, spec, search_path())
    return genmsg.gentools.compute_md5(context, spec)


@ALL_TYPES
def test_definition_has_the_expected_sum(expected: Expected) -> None:
    assert source_md5(expected) == expected.md5


def require_built(package: str) -> None:
    """Skip the test if the package's generated Python classes are not on the path."""
    # Without its own __init__.py it is not a generated package but a folder of the source tree on the path.
    spec = importlib.util.find_spec(package)
    if spec is None or spec.origin is None:
        pytest.skip(f"{package} is not built, or the devel space is not sourced")


@ALL_TYPES
def test_generated_class_has_the_expected_sum(expected: Expected) -> None:
    require_built(expected.package)
    module = importlib.import_module(f"{expected.package}.{expected.kind}")
    assert getattr(module, expected.name)._md5sum == expected.md5


def test_every_definition_is_listed() -> None:
    listed = {f"{e.package}/{e.kind}/{e.name}.{e.kind}" for e in EXPECTED}
    files = [*PACKAGES_DIR.glob("*/msg/*"), *PACKAGES_DIR.glob("*/srv/*")]
    found = {str(path.relative_to(PACKAGES_DIR)) for path in files}
    assert found == listed


@pytest.mark.parametrize(
    ("tool", "type_name"),
    [
        ("rosmsg", "mavros_msgs/PositionTarget"),
        ("rossrv", "mavros_msgs/SetMode"),
        ("rosmsg", "gazebo_msgs/ModelStates"),
    ],
)
def test_ros_command_line_prints_the_expected_sum(tool: str, type_name: str) -> None:
    require_built(type_name.split("/")[0])
    answer = subprocess.run([tool, "md5", type_name], capture_output=True, text=True, timeout=120, check=True)
    assert answer.stdout.split() == [next(e.md5 for e in EXPECTED if e.type_name == type_name)]
