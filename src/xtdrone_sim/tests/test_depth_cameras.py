"""Depth cameras and stereo pairs: depth against rays and closed form, disparity, messages, and rejections."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rospy")

import rospy
from sensor_msgs.msg import PointField

from xtdrone_common.cameras.pinhole import Pinhole
from xtdrone_common.poses import Pose, compose, rotate
from xtdrone_common.rotation import from_euler
from xtdrone_sim.cameras.camera_messages import measure_depths, messages, noise_of, topics_of
from xtdrone_sim.cameras.cameras_of_fleet import Camera, cameras_of
from xtdrone_sim.cameras.drawn_scene import DrawnScene, View
from xtdrone_sim.cameras.rendering import Renderer, RendererError
from xtdrone_sim.rays.scene import RayScene, SceneAt
from xtdrone_sim.tf.vehicle_frames import RobotFrames
from xtdrone_sim.vehicles.mounts.camera_and_gimbal_mounts import MountError, read_cameras
from xtdrone_sim.vehicles.vehicle_model import CameraMount, load_vehicle
from xtdrone_worlds.shapes.visual import Box, Sphere, Visual
from xtdrone_worlds.worlds.catalogue import generate

EYE = "eye::link"
STAMP = rospy.Time(3, 500_000_000)


@pytest.fixture(params=["tiny", "egl"])
def renderer(request: pytest.FixtureRequest) -> Any:
    try:
        made = Renderer(request.param)
    except RendererError as error:
        pytest.skip(str(error))
    with made:
        yield made


def depth_of(camera: Camera, depth: float) -> bytes:
    """Return a picture of one colour and one depth, as the drawing process sends it."""
    p = camera.mount.pinhole
    rgb = np.full((p.height, p.width, 3), (10, 20, 30), np.uint8)
    return rgb.tobytes() + np.full((p.height, p.width), depth, np.float32).tobytes()


def made_camera(**changes: Any) -> Camera:
    values: dict[str, Any] = {
        "name": "depth_camera", "link": "base_link", "pinhole": Pinhole.of_view(64, 48, 1.2), "rate": 10.0,
        "near": 0.05, "far": 100.0, "frame_id": "optical", "kind": "rgbd", "range_min": 0.2, "range_max": 10.0,
    }  # fmt: skip
    return Camera("iris_0", CameraMount(**(values | changes)))


def test_depths_of_a_wall_and_a_sphere_are_those_of_closed_form(renderer: Renderer) -> None:
    wall = renderer.add([Visual(Box((6.0, 6.0, 0.2)))])
    renderer.place(wall, Pose((0.0, 0.0, 5.1)))
    centre, radius = np.array([0.3, 0.2, 3.0]), 0.5
    ball = renderer.add([Visual(Sphere(radius))])
    renderer.place(ball, Pose((0.3, 0.2, 3.0)))
    pinhole = Pinhole.of_view(320, 240, 1.0)
    depth = renderer.draw(pinhole, Pose(), 0.05, 100.0, depth=True).depth
    assert depth is not None
    x, y = np.meshgrid(np.arange(320) + 0.5, np.arange(240) + 0.5)
    rays = pinhole.rays(np.column_stack([x.ravel(), y.ravel()])).reshape(240, 320, 3)
    along, across = rays @ centre, (rays * rays).sum(axis=2)
    inside = along**2 - across * (centre @ centre - radius**2)
    on_ball = (along - np.sqrt(np.maximum(inside, 0.0))) / across
    assert np.abs(depth[inside < -0.1] - 5.0).max() < 1e-3
    assert np.abs(depth - on_ball)[inside > 0.1].max() < 0.02  # the sphere is drawn by flat triangles


def test_depths_in_a_building_are_those_of_rays(renderer: Renderer) -> None:
    world = generate("indoor:seed=7,ceiling=true")
    eye = Pose((22.5, 5.3, 1.4), from_euler(0.05, 0.1, 0.3))
    pinhole = Pinhole.of_view(160, 120, 1.4)
    view = View(EYE, pinhole, 0.05, 100.0, Pose((0.1, 0.0, 0.05), from_euler(0.0, 0.1, 0.0)), depth=True)
    depth = DrawnScene(renderer, world).draw(SceneAt({EYE: eye}, {}), view).depth
    assert depth is not None
    camera = compose(eye, view.pose)
    rows, columns = np.mgrid[4:120:7, 4:160:7]
    optical = pinhole.rays(np.column_stack([columns.ravel() + 0.5, rows.ravel() + 0.5]))
    ahead = np.column_stack([optical[:, 2], -optical[:, 0], -optical[:, 1]])
    lengths = np.linalg.norm(ahead, axis=1)
    directions = np.array([rotate(camera.orientation, tuple(one)) for one in ahead / lengths[:, None]])
    origins = np.tile(np.array(camera.position), (len(directions), 1))
    ranges = RayScene(world.models).cast(origins, directions, 100.0).ranges
    error = np.abs(depth[rows, columns].ravel() - ranges / lengths)
    assert np.quantile(error, 0.9) < 0.005
    assert np.mean(error > 0.05) < 0.05  # pixels at edges


def test_disparity_of_known_points(renderer: Renderer) -> None:
    mount = made_camera(kind="stereo", baseline=0.12, pinhole=Pinhole.of_view(752, 480, 1.5708), frame_id="left").mount
    places = [(2.0, 0.3, 0.2), (3.0, -0.8, -0.4), (4.5, 1.9, -0.9)]
    balls = [renderer.add([Visual(Sphere(0.15))]) for _ in places]
    for ball, place in zip(balls, places, strict=True):
        renderer.place(ball, Pose(place))
    optical = Pose(orientation=(0.5, -0.5, 0.5, -0.5))
    left, right = (
        renderer.draw(mount.pinhole, compose(pose, optical), 0.1, 100.0, labels=True).labels for _, pose in mount.eyes
    )
    assert left is not None
    assert right is not None
    for ball, (x, _, _) in zip(balls, places, strict=True):
        (row_a, column_a), (row_b, column_b) = (np.argwhere(one == ball).mean(axis=0) for one in (left, right))
        outline = x / (x * x - 0.15**2)  # the centre of a sphere's outline is that of a point nearer than its centre
        assert column_a - column_b == pytest.approx(mount.pinhole.fx * 0.12 * outline, abs=0.1)
        assert row_a == pytest.approx(row_b, abs=0.1)


def test_messages_of_an_rgbd_camera() -> None:
    camera = made_camera()
    p = camera.mount.pinhole
    made = messages(camera, STAMP, [depth_of(camera, 4.0)], list(topics_of(camera.mount)))
    assert made.pop("color/image_raw/compressed").header.stamp == STAMP
    assert set(made) == {
        "depth/image_raw", "depth/camera_info", "depth/points", "color/image_raw", "color/camera_info",
    }  # fmt: skip
    assert {(m.header.stamp, m.header.frame_id) for m in made.values()} == {(STAMP, "iris_0/optical")}
    depth, colour, cloud = made["depth/image_raw"], made["color/image_raw"], made["depth/points"]
    assert (depth.encoding, depth.step, len(depth.data)) == ("32FC1", 256, 256 * 48)
    assert set(np.frombuffer(depth.data, np.float32)) == {4.0}
    assert (colour.encoding, bytes(colour.data[:3])) == ("rgb8", bytes((10, 20, 30)))
    assert [(f.name, f.offset, f.datatype) for f in cloud.fields] == [
        (name, 4 * k, PointField.FLOAT32) for k, name in enumerate(("x", "y", "z", "rgb"))
    ]
    points = np.frombuffer(cloud.data, np.float32).reshape(p.height, p.width, 4)
    x, y = np.meshgrid(np.arange(p.width) + 0.5, np.arange(p.height) + 0.5)
    rays = p.rays(np.column_stack([x.ravel(), y.ravel()])).reshape(p.height, p.width, 3)
    np.testing.assert_allclose(points[..., :3], 4.0 * rays, atol=1e-5)
    assert set(points[..., 3].view(np.uint32).ravel()) == {10 << 16 | 20 << 8 | 30}


@pytest.mark.parametrize("depth", [0.1, 11.0, math.inf])
def test_what_is_out_of_range_has_no_depth(depth: float) -> None:
    for encoding, dtype in (("32FC1", np.float32), ("16UC1", np.uint16)):
        camera = made_camera(encoding=encoding, noise=0.01)
        image = messages(camera, STAMP, [depth_of(camera, depth)], ["depth/image_raw"])["depth/image_raw"]
        values = np.frombuffer(image.data, dtype)
        assert np.isnan(values).all() if encoding == "32FC1" else not values.any()


def test_millimetres_are_rounded() -> None:
    camera = made_camera(encoding="16UC1")
    image = messages(camera, STAMP, [depth_of(camera, 2.3456)], ["depth/image_raw"])["depth/image_raw"]
    assert set(np.frombuffer(image.data, np.uint16)) == {2346}


def test_noise_grows_with_the_square_and_repeats_for_its_time() -> None:
    camera = made_camera(noise=0.004, pinhole=Pinhole.of_view(320, 240, 1.0))
    for depth in (1.0, 3.0, 6.0):
        plane = np.full((240, 320), depth, np.float32)
        values = measure_depths(camera.mount, plane, noise_of(camera, STAMP))
        assert values.std() == pytest.approx(0.004 * depth * depth, rel=0.02)
        assert values.mean() == pytest.approx(depth, abs=0.001 * depth * depth)
        np.testing.assert_array_equal(values, measure_depths(camera.mount, plane, noise_of(camera, STAMP)))
        assert (values != measure_depths(camera.mount, plane, noise_of(camera, rospy.Time(4)))).any()


def test_a_stereo_pair_has_its_baseline_in_the_right_matrix() -> None:
    (camera,) = cameras_of(fleet("iris_stereo_camera"))
    made = messages(camera, STAMP, [b"", b""], ["left/camera_info", "right/camera_info"])
    left, right = made["left/camera_info"], made["right/camera_info"]
    assert left.K[0] == pytest.approx(376.0, abs=0.01)
    assert (left.P[3], right.P[3]) == (0.0, pytest.approx(-376.0 * 0.12, abs=0.01))
    assert left.header.frame_id == right.header.frame_id
    assert [view.pose.position for view in camera.views] == [(0.1, 0.06, 0.0), (0.1, -0.06, 0.0)]


def fleet(model: str) -> Any:
    from xtdrone_common.fleet import parse_fleet

    return parse_fleet(f"{model}:1")


def test_upstream_s_models_have_upstream_s_topics_and_frames() -> None:
    wanted = {
        "iris_realsense_camera": {
            "realsense/depth_camera/depth/image_raw", "realsense/depth_camera/depth/points",
            "realsense/depth_camera/color/image_raw", "stereo_camera/left/image_raw", "stereo_camera/right/camera_info",
        },
        "iris_downward_camera": {"camera/image_raw", "camera/camera_info"},
        "iris_zhihang": {"realsense/depth_camera/depth/camera_info", "camera/image_raw"},
        "typhoon_h480_stereo": {"cgo3_camera/image_raw", "stereo_camera/left/image_raw"},
    }  # fmt: skip
    for model, topics in wanted.items():
        cameras = cameras_of(fleet(model))
        assert topics <= {f"{camera.mount.name}/{topic}" for camera in cameras for topic in topics_of(camera.mount)}
        frames = {frame.child for frame in RobotFrames("x", load_vehicle(model)).fixed}
        assert {f"x/{frame}" for camera in cameras for frame, _ in camera.mount.eyes} <= frames


def test_a_camera_that_looks_down_has_the_nose_at_the_top() -> None:
    (camera,) = cameras_of(fleet("iris_downward_camera"))
    turn = compose(camera.views[0].pose, Pose(orientation=(0.5, -0.5, 0.5, -0.5))).orientation
    assert rotate(turn, (0.0, 0.0, 1.0)) == pytest.approx((0.0, 0.0, -1.0), abs=1e-6)
    assert rotate(turn, (0.0, -1.0, 0.0)) == pytest.approx((1.0, 0.0, 0.0), abs=1e-6)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"kind": "lidar"}, "kind: 'lidar' is not allowed, rgb, depth, rgbd or stereo"),
        ({"kind": "stereo"}, "field 'baseline' is missing"),
        ({"kind": "stereo", "baseline": 0}, "baseline: 0 is not allowed, 0.001 to 10 m"),
        ({"baseline": 0.1}, "field 'baseline' is not known"),
        ({"kind": "depth", "range_min": 3, "range_max": 2}, "range_max: 2 is not allowed, 3 to 1000 m"),
        ({"kind": "depth", "encoding": "8UC1"}, "encoding: '8UC1' is not allowed, 32FC1 or 16UC1"),
        ({"kind": "depth", "noise": -1}, "noise: -1 is not allowed, 0 to 1 1/m"),
        ({"position": [1, 2]}, "position: \\[1, 2\\] is not allowed, a list of 3 numbers"),
        ({"rpy": [0, 0, 7]}, "rpy: 7 is not allowed"),
        ({"name": "../image"}, "name: '../image' is not allowed"),
        ({"link": "nose"}, "link 'nose' does not exist"),
    ],
)
def test_what_is_refused(changes: dict[str, Any], words: str) -> None:
    entry = {"name": "eye", "link": "base_link", "width": 64, "height": 48, "hfov": 1.0, **changes}
    with pytest.raises(MountError, match=words):
        read_cameras([entry], load_vehicle("iris").urdf)


def test_two_cameras_of_one_name_are_refused() -> None:
    entries = [{"name": "eye", "link": "base_link", "width": 64, "height": 48, "hfov": hfov} for hfov in (1.0, 2.0)]
    with pytest.raises(MountError, match="cameras: name 'eye' is given 2 times"):
        read_cameras(entries, load_vehicle("iris").urdf)


def test_pictures_of_a_colour_camera_are_drawn_without_depth(tmp_path: Path) -> None:
    (camera,) = cameras_of(fleet("typhoon_h480"))
    assert [view.depth for view in camera.views] == [False]
    assert list(topics_of(camera.mount)) == ["image_raw", "image_raw/compressed", "camera_info"]
