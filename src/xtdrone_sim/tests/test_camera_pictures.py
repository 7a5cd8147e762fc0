"""Colour pictures of cameras: lens distortion against OpenCV, noise, compressed pictures, and rejections."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest

pytest.importorskip("rospy")

import rospy
from numpy.typing import NDArray

from xtdrone_common.cameras import Equidistant, PlumbBob, drawing_of
from xtdrone_common.cameras.pinhole import Pinhole
from xtdrone_common.poses import OPTICAL_FRAME, Pose, compose, conjugate
from xtdrone_sim.cameras.camera_messages import camera_info, messages, topics_of
from xtdrone_sim.cameras.cameras_of_fleet import Camera
from xtdrone_sim.cameras.drawn_scene import View
from xtdrone_sim.cameras.lens_and_noise import through_lens
from xtdrone_sim.cameras.rendering import Renderer
from xtdrone_sim.vehicles.mounts.camera_and_gimbal_mounts import CameraMount, MountError, read_cameras
from xtdrone_sim.vehicles.vehicle_model import load_vehicle
from xtdrone_worlds.shapes.visual import Sphere, Visual

STAMP = rospy.Time(3, 500_000_000)
BARREL = [-0.28, 0.07, 0.002, -0.001, 0.004]
LENSES = [BARREL, [0.1, 0.02, -0.001, 0.002, 0.0]]
FISHEYES = [[0.003, 0.0007, -0.002, 0.0002], [-0.02, 0.01, 0.0, 0.0]]
FORWARD = Pose(orientation=conjugate(OPTICAL_FRAME.orientation))  # a camera that looks along z, with y down


def mount_of(**changes: Any) -> CameraMount:
    entry = {"name": "eye", "link": "base_link", "width": 320, "height": 240, "hfov": 1.4, **changes}
    return read_cameras([entry], load_vehicle("iris").urdf)[0]


def matrix(pinhole: Pinhole) -> NDArray[np.float64]:
    """Return OpenCV's camera matrix, whose upper left pixel has its centre at (0, 0)."""
    return np.array([[pinhole.fx, 0.0, pinhole.cx - 0.5], [0.0, pinhole.fy, pinhole.cy - 0.5], [0.0, 0.0, 1.0]])


def balls_seen(mount: CameraMount, place: tuple[float, float, float]) -> tuple[float, float]:
    """Return the pixel at which a camera at the origin shows a small ball, in OpenCV's convention."""
    assert mount.lens is not None
    camera = Camera("iris_0", mount)
    with Renderer("tiny") as renderer:
        renderer.place(renderer.add([Visual(Sphere(0.06), colour=(1.0, 0.0, 0.0, 1.0))]), Pose(place))
        pictures = [
            renderer.draw(view.pinhole, compose(compose(FORWARD, view.pose), OPTICAL_FRAME), 0.1, 100.0).rgb
            for view in camera.views
        ]
    shown = through_lens(mount.lens, np.concatenate(pictures))
    weight = np.clip(shown[..., 0].astype(float) - shown[..., 1], 0.0, None)
    rows, columns = np.indices(weight.shape)
    return (columns * weight).sum() / weight.sum(), (rows * weight).sum() / weight.sum()


@pytest.mark.parametrize("coefficients", LENSES)
def test_a_lens_distorts_as_opencv_does(coefficients: list[float]) -> None:
    lens = PlumbBob(Pinhole.of_view(320, 240, 1.4), tuple(coefficients))
    rays = np.random.default_rng(1).uniform(-0.7, 0.7, (200, 2))
    points = np.column_stack([rays, np.ones(200)])
    expected, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), np.eye(3), np.array(coefficients))
    np.testing.assert_allclose(lens.distort(rays), expected[:, 0], atol=1e-12)
    np.testing.assert_allclose(lens.undistort(lens.distort(rays)), rays, atol=1e-5)


@pytest.mark.parametrize("coefficients", FISHEYES)
def test_a_fisheye_lens_distorts_as_opencv_does(coefficients: list[float]) -> None:
    lens = Equidistant.of_view(512, 512, 2.9, tuple(coefficients))
    rng = np.random.default_rng(1)
    points = np.column_stack([rng.uniform(-3.0, 3.0, (200, 2)), np.ones(200)])
    pixels, _ = cv2.fisheye.projectPoints(
        points[:, None], np.zeros(3), np.zeros(3), matrix(lens.pinhole), np.array(coefficients)
    )
    rays = lens.rays(pixels[:, 0] + 0.5)
    np.testing.assert_allclose(rays, points / np.linalg.norm(points, axis=1)[:, None], atol=1e-9)


def test_beyond_its_circle_a_fisheye_lens_shows_nothing() -> None:
    lens = Equidistant.of_view(512, 512, 3.4, (0.0, 0.0, -0.001, 0.0))
    rays = lens.rays(np.array([[256.0, 256.0], [0.0, 256.0], [0.0, 0.0]]))
    np.testing.assert_allclose(rays[0], (0.0, 0.0, 1.0), atol=1e-12)
    np.testing.assert_allclose(np.arccos(rays[1, 2]), 1.7, atol=1e-9)  # half of the view, at the edge
    assert np.isnan(rays[2]).all() == (lens.widest < np.hypot(1.0, 1.0) * 1.7)


@pytest.mark.parametrize("coefficients", LENSES)
def test_a_ball_is_where_its_lens_shows_it(coefficients: list[float]) -> None:
    mount = mount_of(distortion=coefficients, width=640, height=480)
    for place in [(-1.3, -0.9, 4.0), (0.2, -0.1, 4.0), (2.4, 0.1, 4.0)]:
        expected, _ = cv2.projectPoints(
            np.array([place]), np.zeros(3), np.zeros(3), matrix(mount.pinhole), np.array(coefficients)
        )
        assert balls_seen(mount, place) == pytest.approx(tuple(expected[0, 0]), abs=0.5)


@pytest.mark.parametrize("hfov", [1.6, 3.6])
@pytest.mark.parametrize("coefficients", FISHEYES)
def test_a_ball_is_where_a_fisheye_lens_shows_it(coefficients: list[float], hfov: float) -> None:
    mount = mount_of(distortion_model="equidistant", distortion=coefficients, width=400, height=400, hfov=hfov)
    assert len(Camera("iris_0", mount).views) == (1 if hfov < 2.0 else 6)
    meeting = 0.5 * np.pi / hfov if hfov > 2.0 else 0.5  # of two faces
    for part, side in ((0.05, 2.0), (meeting, 0.1), (0.97, 5.5)):
        angle = part * 0.5 * hfov
        place = 2.0 * np.array([np.sin(angle) * np.cos(side), np.sin(angle) * np.sin(side), np.cos(angle)])
        square = angle**2
        k1, k2, k3, k4 = coefficients
        far = angle * (1 + k1 * square + k2 * square**2 + k3 * square**3 + k4 * square**4)
        expected = far * mount.pinhole.fx * np.array([np.cos(side), np.sin(side)]) + 199.5
        assert balls_seen(mount, tuple(place)) == pytest.approx(tuple(expected), abs=0.5)


@pytest.mark.parametrize("lens", [{"distortion": LENSES[0]}, {"distortion": None}])
def test_a_rectified_picture_is_that_of_opencv(lens: dict[str, Any]) -> None:
    if lens["distortion"] is None:
        lens = {"distortion_model": "equidistant", "distortion": FISHEYES[0], "hfov": 2.6}
    mount = mount_of(**lens)
    camera = Camera("iris_0", mount)
    view = camera.views[0].pinhole
    rows, columns = np.indices((view.height, view.width))
    face = np.stack([(127 + 100 * np.sin(0.04 * rows + k) * np.cos(0.05 * columns)) for k in range(3)], axis=2)
    pictures = [face.astype(np.uint8).tobytes()] * len(camera.views)
    made = messages(camera, STAMP, pictures, ["image_raw", "image_rect_color", "camera_info"])
    raw, ours = (
        np.frombuffer(made[topic].data, np.uint8).reshape(240, 320, 3) for topic in ("image_raw", "image_rect_color")
    )
    inner, d = matrix(mount.pinhole), np.array(made["camera_info"].D)
    if made["camera_info"].distortion_model == "equidistant":
        theirs = cv2.fisheye.undistortImage(raw, inner, d, Knew=inner)
    else:
        theirs = cv2.undistort(raw, inner, d)
    whole = (theirs > 0).all(axis=2) & (ours > 0).all(axis=2)
    assert whole.mean() > 0.9
    middle = whole & (np.abs(np.indices((240, 320)) - np.array([120, 160])[:, None, None]) < 60).all(axis=0)
    assert np.abs(theirs.astype(int) - ours)[middle].mean() < 2.0


def test_a_barrel_lens_draws_a_wider_view_and_fills_its_edges() -> None:
    mount = mount_of(distortion=BARREL)
    assert mount.lens is not None
    (view,) = Camera("iris_0", mount).views
    assert isinstance(view, View)
    drawn = view.pinhole
    assert drawn.width > mount.pinhole.width
    assert drawn.fx == mount.pinhole.fx
    white = np.full((drawn.height, drawn.width, 3), 255, np.uint8)
    assert through_lens(mount.lens, white).min() == 255
    drawing = drawing_of(mount.lens)
    assert drawing.columns.min() >= 0.0
    assert drawing.columns.max() <= drawn.width - 1


def test_the_coefficients_are_in_camera_info() -> None:
    info = camera_info(Camera("iris_0", mount_of(distortion=BARREL)))
    assert (info.distortion_model, list(info.D)) == ("plumb_bob", BARREL)
    assert info.K[0] == info.P[0] == mount_of().pinhole.fx
    assert list(camera_info(Camera("iris_0", mount_of())).D) == [0.0] * 5
    fisheye = Camera("iris_0", mount_of(distortion_model="equidistant", distortion=FISHEYES[0], hfov=3.4))
    info = camera_info(fisheye)
    assert (info.distortion_model, list(info.D)) == ("equidistant", FISHEYES[0])
    assert info.K[0] == info.P[0] == fisheye.mount.pinhole.fx


def test_stereo_pairs_and_rgbd_cameras_have_lenses_and_rectified_pictures() -> None:
    pair = Camera("iris_0", mount_of(distortion=BARREL, kind="stereo", baseline=0.1))
    assert [view.pose.position[1] for view in pair.views] == [0.05, -0.05]
    right = camera_info(pair, right=True)
    assert (list(right.D), right.P[3]) == (BARREL, -pair.mount.pinhole.fx * 0.1)
    assert {"left/image_rect_color", "right/image_rect_color"} < set(topics_of(pair.mount))
    assert "left/image_rect_color" not in topics_of(mount_of(kind="stereo", baseline=0.1))

    both = Camera("iris_0", mount_of(distortion=BARREL, kind="rgbd"))
    plain, lens = both.views
    assert (plain.pinhole, plain.depth, lens.depth) == (both.mount.pinhole, True, False)
    size = plain.pinhole.width * plain.pinhole.height
    pictures = [bytes([10]) * 3 * size + np.full(size, 2.0, np.float32).tobytes()]
    pictures.append(bytes([200]) * (3 * lens.pinhole.width * lens.pinhole.height))
    made = messages(both, STAMP, pictures, list(topics_of(both.mount)))
    assert list(made["color/camera_info"].D) == BARREL
    assert not any(made["depth/camera_info"].D)
    assert set(made["color/image_raw"].data) == {200}
    assert set(made["color/image_rect_color"].data) == {10}
    assert np.frombuffer(made["depth/points"].data, np.uint32)[3] == 0x0A0A0A


def pictures_of(mount: CameraMount, stamp: rospy.Time = STAMP, eyes: int = 1) -> dict[str, Any]:
    grey = bytes([128]) * (3 * mount.pinhole.width * mount.pinhole.height)
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
    assert left.std() == pytest.approx(np.hypot(0.02 * 255.0, 12**-0.5), rel=0.01)  # including the noise of rounding
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
        ({"distortion": BARREL, "kind": "depth"}, "field 'distortion' is not known"),
        ({"distortion_model": "fisheye"}, "distortion_model: 'fisheye' is not allowed, plumb_bob or equidistant"),
        (
            {"distortion_model": "equidistant", "distortion": BARREL},
            "is not allowed, a list of 4 numbers: k1, k2, k3, k4",
        ),
        ({"distortion_model": "equidistant"}, "distortion: it must be given with distortion_model"),
        (
            {"distortion_model": "equidistant", "distortion": [-0.3, 0, 0, 0], "hfov": 3.0},
            "beyond 1.05 rad from the axis the distances from the middle do not grow",
        ),
        (
            {"distortion_model": "equidistant", "distortion": [10, 10, 10, 10], "hfov": 3.0},
            "it needs views of .* pixels, at most 964",
        ),
    ],
)
def test_what_is_refused(changes: dict[str, Any], words: str) -> None:
    with pytest.raises(MountError, match=words):
        mount_of(**changes)
