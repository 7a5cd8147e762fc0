"""The example of a detector of one's own finds a red square, and where it lies."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rospy")

from geometry_msgs.msg import Point, Pose, PoseStamped, Quaternion
from sensor_msgs.msg import CameraInfo, Image

import xtdrone_lockstep as lockstep

EXAMPLE = Path(__file__).resolve().parents[1] / "examples" / "red_object.py"


@pytest.fixture
def example() -> Any:
    spec = importlib.util.spec_from_file_location("red_object", EXAMPLE)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def picture(column: int, row: int) -> np.ndarray:
    """Return a grey image with a red square of 11 px about a pixel."""
    rgb = np.full((240, 320, 3), 100, np.uint8)
    rgb[row - 5 : row + 6, column - 5 : column + 6] = (200, 20, 30)
    return rgb


def test_the_middle_of_the_largest_red_area_is_found(example: Any) -> None:
    rgb = picture(200, 80)
    rgb[10:12, 10:12] = (250, 0, 0)
    assert example.find_red(rgb) == pytest.approx((200.0, 80.0))
    assert example.find_red(np.full((240, 320, 3), 100, np.uint8)) is None


def test_the_object_lies_where_the_ray_meets_the_ground(
    example: Any, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The image's right is the vehicle's right; it faces east, 10.05 m above the ground."""
    callbacks: dict[str, Callable[[Any], None]] = {}
    monkeypatch.setattr(lockstep, "Subscriber", lambda topic, kind, call, **_: callbacks.update({topic: call}))
    monkeypatch.setattr(lockstep, "add_reset_hook", lambda hook: None)
    node = example.RedObject("iris_0")
    pose = PoseStamped(pose=Pose(Point(3.0, 1.0, 10.05), Quaternion(0.0, 0.0, 0.0, 1.0)))
    rgb = picture(200, 120)
    image = Image(height=240, width=320, encoding="rgb8", step=960, data=rgb.tobytes())
    callbacks["/iris_0/camera/image_raw"](image)
    assert node.place is None  # without a pose
    callbacks["/iris_0/mavros/local_position/pose"](pose)
    callbacks["/iris_0/camera/camera_info"](CameraInfo(width=320, height=240, K=[200, 0, 160, 0, 200, 120, 0, 0, 1]))
    callbacks["/iris_0/camera/image_raw"](image)
    assert node.place == pytest.approx([3.0, -1.0, 0.0], abs=0.1)
    node.step()
    assert capsys.readouterr().out.startswith("iris_0: red object at (3.0, -1.0) m")
