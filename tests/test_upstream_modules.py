"""The modules and programs outside this project that XTDrone's own programs and launch files use."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from roslib.packages import find_node

MODULES = """
import cv2
import cv_bridge
import numpy
import PyKDL
import pyquaternion
import tf
import tf.transformations
import tf2_ros
from cv_bridge.boost.cv_bridge_boost import getCvType

quarter = numpy.pi / 2
turn = pyquaternion.Quaternion(axis=[0, 0, 1], angle=quarter)
wanted = [turn.x, turn.y, turn.z, turn.w]
assert numpy.allclose(tf.transformations.quaternion_from_euler(0, 0, quarter), wanted)
assert numpy.allclose(PyKDL.Rotation.RPY(0, 0, quarter).GetQuaternion(), wanted)

bridge = cv_bridge.CvBridge()
picture = numpy.arange(4 * 6 * 3, dtype=numpy.uint8).reshape(4, 6, 3)
message = bridge.cv2_to_imgmsg(picture, "bgr8")
assert (bridge.imgmsg_to_cv2(message, "bgr8") == picture).all()
assert (bridge.imgmsg_to_cv2(message, "rgb8") == picture[:, :, ::-1]).all()
assert (bridge.imgmsg_to_cv2(message, "mono8") == cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY)).all()
print(cv2.__file__)
print(numpy.__file__)
"""


def test_modules_work_together_on_the_project_s_numpy_and_opencv() -> None:
    run = subprocess.run([sys.executable, "-c", MODULES], capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr
    own = Path(sys.prefix)
    assert [own in Path(line).parents for line in run.stdout.split()] == [True, True]


@pytest.mark.parametrize("package", ["tf", "tf2_ros"])
def test_static_transform_publisher_is_found(package: str) -> None:
    assert find_node(package, "static_transform_publisher")
