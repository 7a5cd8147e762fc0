"""Colour pictures of cameras: lens distortion against OpenCV, noise, compressed pictures, and what is refused."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest

pytest.importorskip("rospy")

import rospy
from numpy.typing import NDArray

from xtdrone_control.lens import Lens, drawing_of
from xtdrone_control.pinhole import Pinhole
from xtdrone_sim.cameras.cameras import Camera
from xtdrone_sim.cameras.drawn_scene import View
from xtdrone_sim.cameras.outputs import camera_info, messages, through_lens
from xtdrone_sim.cameras.rendering import Renderer
from xtdrone_sim.vehicles.camera_and_gimbal_mounts import CameraMount, MountError, read_cameras
from xtdrone_sim.vehicles.vehicle_model import load_vehicle
from xtdrone_sim.vehicles.visual import Pose, Sphere, Visual

STAMP = rospy.Time(3, 500_000_000)
BARREL = [-0.28, 0.07, 0.002, -0.001, 0.004]
LENSES = [BARREL, [0.1, 0.02, -0.001, 0.002, 0.0]]


def mount_of(**changes: Any) -> CameraMount:
    entry = {"name": "eye", "link": "base_link", "width": 320, "height": 240, "hfov": 1.4, **changes}
    return read_cameras([entry], load_vehicle("iris").urdf)[0]


def matrix(pinhole: Pinhole) -> NDArray[np.float64]:
    """Return OpenCV's camera matrix, whose upper left pixel has its centre at (0, 0)."""
    return np.array([[pinhole.fx, 0.0, pinhole.cx - 0.5], [0.0, pinhole.fy, pinhole.cy - 0.5], [0.0, 0.0, 1.0]])


@pytest.mark.parametrize("coefficients", LENSES)
def test_a_lens_distorts_as_opencv_does(coefficients: list[float]) -> None:
    lens = Lens(Pinhole.of_view(320, 240, 1.4), tuple(coefficients))  # type: ignore[arg-type]
    rays = np.random.default_rng(1).uniform(-0.7, 0.7, (200, 2))
    points = np.column_stack([rays, np.ones(200)])
    expected, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), np.eye(3), np.array(coefficients))
    np.testing.assert_allclose(lens.distort(rays), expected[:, 0], atol=1e-12)
    np.testing.assert_allclose(lens.undistort(lens.distort(rays)), rays, atol=1e-5)


@pytest.mark.parametrize("coefficients", LENSES)
def test_a_ball_is_where_its_lens_shows_it(coefficients: list[float]) -> None:
    mount = mount_of(distortion=coefficients, width=640, height=480)
    places = [(-1.3, -0.9, 4.0), (1.0, 0.9, 4.0), (0.2, -0.1, 4.0), (2.4, 0.1, 4.0)]
    for place in places:
        with Renderer("tiny") as renderer:
            renderer.place(renderer.add([Visual(Sphere(0.06), colour=(1.0, 0.0, 0.0, 1.0))]), Pose(place))
            drawn = renderer.draw(mount.drawn, Pose(), 0.1, 100.0).rgb
        shown = through_lens(mount, drawn)
        assert shown.shape == (480, 640, 3)
        weight = np.clip(shown[..., 0].astype(float) - shown[..., 1], 0.0, None)
        rows, columns = np.mgrid[0:480, 0:640]
        middle = ((columns * weight).sum() / weight.sum(), (rows * weight).sum() / weight.sum())
        expected, _ = cv2.projectPoints(
            np.array([place]), np.zeros(3), np.zeros(3), matrix(mount.pinhole), np.array(coefficients)
        )
        assert middle == pytest.approx(tuple(expected[0, 0]), abs=0.5)


def test_a_barrel_lens_draws_a_wider_view_and_fills_its_edges() -> None:
    mount = mount_of(distortion=BARREL)
    assert mount.drawn.width > mount.pinhole.width
    assert mount.drawn.fx == mount.pinhole.fx
    (view,) = Camera("iris_0", mount).views
    assert isinstance(view, View)
    assert view.pinhole == mount.drawn
    white = np.full((mount.drawn.height, mount.drawn.width, 3), 255, np.uint8)
    assert through_lens(mount, white).min() == 255
    drawing = drawing_of(mount.lens)  # type: ignore[arg-type]
    assert drawing.columns.min() >= 0.0
    assert drawing.columns.max() <= mount.drawn.width - 1


def test_the_coefficients_are_in_camera_info() -> None:
    info = camera_info(Camera("iris_0", mount_of(distortion=BARREL)))
    assert (info.distortion_model, list(info.D)) == ("plumb_bob", BARREL)
    assert info.K[0] == info.P[0] == mount_of().pinhole.fx
    assert list(camera_info(Camera("iris_0", mount_of())).D) == [0.0] * 5


def pictures_of(mount: CameraMount, stamp: rospy.Time = STAMP, eyes: int = 1) -> dict[str, Any]:
    grey = bytes([128]) * (3 * mount.drawn.width * mount.drawn.height)
    wanted = [
        f"{part}image_raw{tail}"
        for part in (["left/", "right/"] if eyes == 2 else [""])
        for tail in ("", "/compressed")
    ]
    return messages(Camera("iris_0", mount), stamp, [grey] * eyes, wanted)


def test_noise_of_pictures_has_its_deviation_and_repeats_for_its_time() -> None:
    mount = mount_of(image_noise=0.02, kind="stereo", baseline=0.1)
    made = pictures_of(mount, eyes=2)
    left, right = (np.frombuffer(made[f"{side}/image_raw"].data, np.uint8).astype(float) for side in ("left", "right"))
    assert left.mean() == pytest.approx(128.0, abs=0.1)
    assert left.std() == pytest.approx(np.hypot(0.02 * 255.0, 12**-0.5), rel=0.01)  # with that of rounding
    assert abs(np.corrcoef(left, right)[0, 1]) < 0.02
    assert pictures_of(mount, eyes=2)["left/image_raw"].data == made["left/image_raw"].data
    assert pictures_of(mount, rospy.Time(4), eyes=2)["left/image_raw"].data != made["left/image_raw"].data


def test_a_compressed_picture_is_the_raw_one() -> None:
    mount = mount_of()
    columns = np.linspace(0, 255, mount.pinhole.width).astype(np.uint8)
    picture = np.zeros((mount.pinhole.height, mount.pinhole.width, 3), np.uint8)
    picture[..., 0], picture[..., 2] = columns, 255 - columns
    made = messages(Camera("iris_0", mount), STAMP, [picture.tobytes()], ["image_raw", "image_raw/compressed"])
    raw, small = made["image_raw"], made["image_raw/compressed"]
    assert small.format == "rgb8; jpeg compressed bgr8"
    assert small.header == raw.header
    decoded = cv2.cvtColor(cv2.imdecode(np.frombuffer(small.data, np.uint8), cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB)
    assert np.abs(decoded.astype(int) - picture).mean() < 3.0
    assert len(small.data) < len(raw.data) / 10


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"image_noise": 1.5}, "image_noise: 1.5 is not allowed, 0 to 1"),
        (
            {"distortion": [0.1, 0.2]},
            "distortion: \\[0.1, 0.2\\] is not allowed, a list of 5 numbers: k1, k2, p1, p2, k3",
        ),
        ({"distortion": [11, 0, 0, 0, 0]}, "distortion: 11 is not allowed, -10 to 10"),
        ({"distortion": ["a", 0, 0, 0, 0]}, "distortion: 'a' is not allowed"),
        ({"distortion": [-2, 0, 0, 0, 0]}, "is not allowed, coefficients with a ray for each pixel"),
        ({"distortion": BARREL, "kind": "stereo", "baseline": 0.1}, "field 'distortion' is not known"),
    ],
)
def test_what_is_refused(changes: dict[str, Any], words: str) -> None:
    with pytest.raises(MountError, match=words):
        mount_of(**changes)
