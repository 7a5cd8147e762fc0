"""Exposures that take time: the width of a blurred edge against closed form, poses between scenes, times."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rospy")

import rospy
from geometry_msgs.msg import Point, Quaternion
from geometry_msgs.msg import Pose as PoseMessage
from xtdrone_msgs.msg import SceneState

from xtdrone_common.frames import to_xyzw
from xtdrone_common.rotation import from_euler, yaw_of
from xtdrone_sim.cameras.camera_worker import DrawingProcess, Drawn
from xtdrone_sim.cameras.drawn_scene import View
from xtdrone_sim.cameras.shutter import RecentScenes, exposure_times, mean_of, middle_us
from xtdrone_sim.rays.live_rays import scene_of
from xtdrone_sim.vehicles.mounts.camera_and_gimbal_mounts import CameraMount, MountError, read_cameras
from xtdrone_sim.vehicles.vehicle_model import load_vehicle

LINK = "iris_0::base_link"
RATE = 2.5  # rad/s
POST = """<sdf version="1.6"><world name="post"><model name="wall"><static>true</static><link name="wall">
<visual name="left"><pose>6 5 0 0 0 0</pose><geometry><box><size>1 10 20</size></box></geometry>
<material><diffuse>1 1 1 1</diffuse></material></visual>
<visual name="right"><pose>6 -5 0 0 0 0</pose><geometry><box><size>1 10 20</size></box></geometry>
<material><diffuse>0 0 0 1</diffuse></material></visual></link></model></world></sdf>"""


def mount_of(**changes: Any) -> CameraMount:
    entry = {"name": "eye", "link": "base_link", "width": 320, "height": 16, "hfov": 1.0, **changes}
    return read_cameras([entry], load_vehicle("iris").urdf)[0]


def turning(time_us: int, rate: float = RATE) -> SceneState:
    """Return the scene of a vehicle at the origin that turns left and faces ahead at 0.5 s."""
    turn = Quaternion(*to_xyzw(from_euler(0.0, 0.0, rate * (1e-6 * time_us - 0.5))))
    scene = SceneState(links=[LINK], poses=[PoseMessage(Point(0.0, 0.0, 1.0), turn)])
    scene.header.stamp = rospy.Time(0, 1000 * time_us)
    return scene


def history(longest: float, rate: float = RATE) -> RecentScenes:
    recent = RecentScenes(longest, scene_of)
    for time_us in range(0, 560_000, 20_000):
        recent.add(time_us, turning(time_us, rate))
    return recent


def test_an_edge_is_blurred_over_the_way_of_its_picture(tmp_path: Any) -> None:
    mount = mount_of(exposure=0.03, exposure_pictures=31)
    (tmp_path / "post.world").write_text(POST)
    closed_us = 515_000  # in the middle the camera looks at the edge
    scenes = [history(0.03).at(time) for time in exposure_times(mount, closed_us)]
    view = View(LINK, mount.pinhole, 0.1, 100.0)
    process = DrawingProcess(Drawn(str(tmp_path / "post.world"), "iris:1", "tiny"))
    try:
        blurred, sharp = (
            np.frombuffer(process.draw(some, view) or b"", np.uint8).reshape(16, 320, 3)[4, :, 0].astype(float)
            for some in (scenes, scenes[15:16])
        )
    finally:
        process.close()
    width = mount.pinhole.fx * RATE * 0.03
    assert width > 20.0
    for picture, expected in ((blurred, width * math.sqrt((1.0 - 31**-2) / 12.0)), (sharp, 0.0)):
        share = -np.diff(picture) / (picture[0] - picture[-1])
        places = np.arange(319) + 1.0  # of the borders between pixels
        middle = (share * places).sum()
        assert middle == pytest.approx(160.0, abs=0.5)
        assert math.sqrt((share * (places - middle) ** 2).sum()) == pytest.approx(expected, abs=0.02 * width)


def test_poses_between_scenes() -> None:
    recent = history(0.03)
    for time_us in (447_123.4, 500_000.0, 515_000.0, 540_000.0):
        yaw = yaw_of(recent.at(time_us).links[LINK].orientation)
        assert yaw == pytest.approx(RATE * (1e-6 * time_us - 0.5), abs=1e-6)
    assert recent.at(9e9) == scene_of(turning(540_000))
    kept = recent.at(0.0).links[LINK].orientation  # older scenes are dropped
    assert RATE * -0.5 < yaw_of(kept) < RATE * -0.07
    recent.clear()
    with pytest.raises(ValueError, match="scenes: none has been received yet"):
        recent.at(0.0)


def test_the_stamp_is_the_middle_of_the_exposure() -> None:
    mount = mount_of(exposure=0.01, exposure_pictures=5)
    times = exposure_times(mount, 100_000)
    assert times == [91_000.0, 93_000.0, 95_000.0, 97_000.0, 99_000.0]
    assert middle_us(mount, 100_000) == times[2] == 95_000
    assert exposure_times(mount_of(), 100_000) == [100_000.0]


def test_the_mean_is_rounded() -> None:
    pictures = [np.full((2, 2, 3), value, np.uint8) for value in (0, 255, 255)]
    assert set(mean_of(pictures).ravel()) == {170}
    assert mean_of(pictures[:1]) is pictures[0]


def test_at_rest_a_picture_is_not_changed() -> None:
    recent = history(0.03, 0.0)
    scenes = [recent.at(time) for time in exposure_times(mount_of(exposure=0.02), 500_000)]
    assert all(scene == scenes[0] for scene in scenes)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"exposure": 0.6}, "exposure: 0.6 is not allowed, 0 to 0.5 s"),
        ({"exposure": -0.1}, "exposure: -0.1 is not allowed, 0 to 0.5 s"),
        ({"exposure_pictures": 4}, "exposure_pictures: 4 is not allowed, an odd number from 1 to 63"),
        ({"exposure_pictures": 65}, "exposure_pictures: 65 is not allowed, 1 to 63"),
        ({"exposure_pictures": 2.5}, "exposure_pictures: 2.5 is not allowed, an odd number from 1 to 63"),
        ({"exposure": 0.01, "kind": "depth"}, "field 'exposure' is not known"),
    ],
)
def test_what_is_refused(changes: dict[str, Any], words: str) -> None:
    with pytest.raises(MountError, match=words):
        mount_of(**changes)
