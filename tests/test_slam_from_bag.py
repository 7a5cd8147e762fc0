"""A user's SLAM on a recorded flight, by the commands of docs/mapping.md.

The bag is written here: a vehicle on an arc. The SLAM is this process: it publishes the true poses as VINS-Fusion
would, of a camera's optical frame, in a rotated frame with another origin.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from conftest import REPOSITORY, START_LIMIT, Graph, poll
from scipy.spatial.transform import Rotation

pytest.importorskip("rospy")

import rosbag
import rospy
from nav_msgs.msg import Odometry
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import Imu

from xtdrone_common.pose_matrices import inverse, pose_of, turned_about_z
from xtdrone_common.pose_messages import pose_message

TRUTH, IMU = "/xtdrone/iris_0/ground_truth/odom", "/iris_0/mavros/imu/data"
RATE, COUNT = 30.0, 90
OPTICAL = pose_of((0.0, 0.0, 0.0), Rotation.from_quat([-0.5, 0.5, -0.5, 0.5]))  # x right, y down, z ahead, in the body
ORIGIN = pose_of((10.0, 5.0, 1.0), turned_about_z(1.57))  # of the SLAM's frame in map: ~start and ~heading of the page
SECTION = "### On a recorded flight"


def true_pose(time: float) -> np.ndarray:
    angle = 0.5 * time
    return pose_of((10.0 + 4.0 * math.sin(angle), 9.0 - 4.0 * math.cos(angle), 1.0 + 0.2 * time), turned_about_z(angle))


def odometry(time: float, pose: np.ndarray) -> Odometry:
    message = Odometry()
    message.header.stamp = rospy.Time.from_sec(time)
    message.pose.pose = pose_message(pose)
    return message


def script() -> str:
    """Return the commands of the page's section, without the SLAM, which is this process."""
    page = (REPOSITORY / "docs" / "mapping.md").read_text(encoding="utf-8")
    block = re.search(r"```\n(.*?)```", page.split(SECTION)[1], re.DOTALL)
    assert block is not None
    assert "YOUR_SLAM &\n" in block[1]
    xtdrone = f"{sys.executable} -m xtdrone_interaction"
    return block[1].replace("YOUR_SLAM &\n", "").replace("./xtdrone", xtdrone)


@pytest.fixture
def folder(graph: Graph, tmp_path: Path) -> Iterator[Path]:
    """A folder with the flight's bag."""
    graph.forget()
    with rosbag.Bag(str(tmp_path / "flight.bag"), "w") as bag:
        for k in range(COUNT):
            time = 10.0 + k / RATE
            message = odometry(time, true_pose(k / RATE))
            bag.write(TRUTH, message, message.header.stamp)
            bag.write(IMU, Imu(header=message.header), message.header.stamp)
    yield tmp_path
    graph.forget()


class Slam:
    """A stand-in for VINS-Fusion, which starts when its results have a subscriber."""

    def __init__(self) -> None:
        self._out = rospy.Publisher("/vins_estimator/camera_pose", Odometry, queue_size=100)
        poll(self._out.get_num_connections, "vins_transfer.py subscribes")
        self._ears = [
            rospy.Subscriber("/clock", Clock, lambda _: None),
            rospy.Subscriber(IMU, Imu, self._on_imu, queue_size=100),
        ]

    def _on_imu(self, message: Imu) -> None:
        camera = inverse(ORIGIN) @ true_pose(message.header.stamp.to_sec() - 10.0) @ OPTICAL
        self._out.publish(odometry(message.header.stamp.to_sec(), camera))

    def close(self) -> None:
        for entry in (self._out, *self._ears):
            entry.unregister()


def test_the_guide_for_recorded_flights_holds(graph: Graph, folder: Path) -> None:
    guide = subprocess.Popen(
        ["bash", "-e", "-c", script()],
        cwd=folder,
        env={**os.environ, **graph.environment},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
    )
    slam = None
    try:
        slam = Slam()
        output, _ = guide.communicate(timeout=START_LIMIT)
    finally:
        with contextlib.suppress(ProcessLookupError):  # they have all ended
            os.killpg(guide.pid, signal.SIGKILL)
        if slam is not None:
            slam.close()
    assert guide.returncode == 0, output
    report = json.loads((folder / "page" / "report.json").read_text())
    first = next(row for row in report["odometry"] if row["alignment"] == "first")
    assert first["source"] == "pose_transfer"
    assert first["poses"] > COUNT / 2, output
    assert first["greatest"] < 0.005
