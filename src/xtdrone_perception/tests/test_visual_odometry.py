"""Visual odometry without ROS: its derivatives, and flights past textured walls with exact pictures."""

from __future__ import annotations

import itertools

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from xtdrone_common.pose_matrices import distance_between, inverse, move_pose, pose_of, rotation_of
from xtdrone_perception.slam.odometry_health import Fault, fault_of
from xtdrone_perception.slam.visual.camera_model import BodyCamera
from xtdrone_perception.slam.visual.corner_tracks import TrackSettings, depth_at
from xtdrone_perception.slam.visual.pose_from_points import NoiseSettings, Sigmas, solve
from xtdrone_perception.slam.visual.visual_odometry import KeyframeSettings, SeenPicture, VisualOdometry
from xtdrone_perception.slam.visual.visual_odometry_node import VisualHealthLimits
from xtdrone_perception.slam.visual.window_adjustment import WindowProblem, adjust

WIDTH, HEIGHT, FOCAL, BASELINE = 320, 240, 260.0, 0.12
CAMERA = BodyCamera(
    np.array([FOCAL, FOCAL]),
    np.array([WIDTH, HEIGHT]) / 2.0 - 0.5,
    pose_of((0.1, 0.0, 0.0), Rotation.from_quat([-0.5, 0.5, -0.5, 0.5])),
)
SIGMAS = Sigmas(np.array([0.4, 0.4, 0.001]), 0.003)
WALL = 5.0  # m, x of a wall across the view
TEXEL = 0.02  # m
NOISE = NoiseSettings()
TEXTURE = cv2.resize(np.random.default_rng(3).integers(0, 255, (200, 200), np.uint8), (800, 800))


def picture(pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return grey values and depths of the wall x = WALL seen from a pose of the body: a homography, in closed form."""
    camera = inverse(pose @ CAMERA.mount)
    corner = np.array([WALL, 400 * TEXEL, 400 * TEXEL])  # the texture goes right (-y) and down (-z)
    across, down = np.array([0.0, -TEXEL, 0.0]), np.array([0.0, 0.0, -TEXEL])
    matrix = np.array([[FOCAL, 0, CAMERA.centre[0]], [0, FOCAL, CAMERA.centre[1]], [0, 0, 1.0]])
    plane = np.stack([camera[:3, :3] @ across, camera[:3, :3] @ down, camera[:3, :3] @ corner + camera[:3, 3]], axis=1)
    grey = cv2.warpPerspective(TEXTURE, matrix @ plane, (WIDTH, HEIGHT), flags=cv2.INTER_LINEAR)
    u, v = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    rays = np.stack([(u - CAMERA.centre[0]) / FOCAL, (v - CAMERA.centre[1]) / FOCAL, np.ones_like(u)], axis=2)
    back = inverse(camera)
    depth = (WALL - back[0, 3]) / (rays @ back[0, :3])
    return grey, depth.astype(np.float32)


def true_pose(k: int) -> np.ndarray:
    """Return a pose on a path along the wall, with turns."""
    t = 0.1 * k
    return pose_of(
        (0.3 * np.sin(t), 0.35 * t, 0.2 * np.sin(0.7 * t)), Rotation.from_euler("zyx", [0.1 * np.sin(t), 0.03, 0])
    )


def fly(is_stereo: bool, count: int = 30, drift: float = 0.0, noise: NoiseSettings = NOISE) -> tuple:
    """Return odometry and estimates of a flight with an autopilot's attitude and rough velocity.

    Args:
        is_stereo: by a pair, not by depths.
        count: of pictures, 0.1 s apart.
        drift: of the autopilot's heading, rad/s.
        noise: as the odometry assumes it.
    """
    base = FOCAL * BASELINE if is_stereo else 0.0
    settings = TrackSettings(corners=120, corner_distance=10.0), noise, KeyframeSettings()
    odometry, found = VisualOdometry(CAMERA, settings, base, true_pose(0)), []
    for k in range(count):
        pose = true_pose(k)
        grey, depth = picture(pose)
        attitude = Rotation.from_rotvec([0.0, 0.0, 0.1 * k * drift]) * rotation_of(pose)
        if is_stereo:
            right = picture(move_pose(pose, np.append(rotation_of(pose).apply([0.0, -BASELINE, 0.0]), np.zeros(3))))[0]
            seen = SeenPicture(grey, attitude, 0.1 * k, right=right, base=base)
        else:
            seen = SeenPicture(grey, attitude, 0.1 * k, depth=depth)
        step = np.eye(4) if k == 0 else inverse(true_pose(k - 1)) @ pose
        step[:3, 3] *= 0.7
        found.append(odometry.register(seen, odometry.pose @ step))
        assert fault_of(found[-1], 0, 20, VisualHealthLimits()) is None
        odometry.accept(found[-1])
    return odometry, found


@pytest.mark.parametrize(("is_stereo", "most"), [(False, 0.02), (True, 0.04)], ids=("depth", "stereo"))
def test_it_finds_its_way_along_a_wall(is_stereo: bool, most: float) -> None:
    odometry, _ = fly(is_stereo)
    assert distance_between(odometry.pose, true_pose(29)) < most
    assert distance_between(true_pose(0), true_pose(29)) > 1.0


def test_an_autopilot_whose_heading_still_settles_does_not_turn_the_way() -> None:
    """The estimated path does not turn although the heading drifts by 0.5 degrees a second at first."""
    ends = [
        distance_between(fly(False, 16, 0.009, noise)[0].pose, true_pose(15))
        for noise in (NOISE, NoiseSettings(turn_drift=0.0, turn_noise=0.0003))
    ]
    assert ends[0] < 0.02
    assert ends[1] > 2.0 * ends[0]


def test_the_same_pictures_give_the_same_bits() -> None:
    assert fly(False, 8)[0].pose.tobytes() == fly(False, 8)[0].pose.tobytes()


def test_without_light_it_is_blind_and_begins_anew_later() -> None:
    odometry, _ = fly(False, 6)
    dark = SeenPicture(
        np.zeros((HEIGHT, WIDTH), np.uint8), Rotation.identity(), 0.6, np.full((HEIGHT, WIDTH), 3.0, np.float32)
    )
    for _ in range(4):
        estimate = odometry.register(dark, odometry.pose)
        assert fault_of(estimate, 0, 20, VisualHealthLimits()) is Fault.BLIND
        odometry.move(estimate.predicted)
    grey, depth = picture(true_pose(6))
    again = odometry.register(SeenPicture(grey, Rotation.identity(), 1.0, depth), odometry.pose)
    assert again.is_first
    assert fault_of(again, 0, 20, VisualHealthLimits()) is None


def with_slopes(measured: np.ndarray) -> np.ndarray:
    """Return measurements (n, 3) with slopes of 0, (n, 5)."""
    return np.column_stack([measured, np.zeros((len(measured), 2))])


def test_a_corner_that_slid_along_a_plane_has_the_planes_depth() -> None:
    """Ground 0.3 m below the camera, seen at a grazing angle: one pixel covers metres."""
    below, focal, middle = 0.3, FOCAL, CAMERA.centre[1]
    _, rows = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    inverse_depth = (rows - middle) / (focal * below)
    depth = np.where(inverse_depth > 0.0, 1.0 / np.where(inverse_depth > 0.0, inverse_depth, 1.0), np.nan)
    true, slid = np.array([[150.2, middle + 20.0]]), np.array([[151.0, middle + 21.3]])
    expected = np.column_stack([true, (true[:, 1] - middle) / (focal * below)])
    found, slopes = depth_at(depth.astype(np.float32), slid)
    residual = CAMERA.residuals(np.column_stack([slid, 1.0 / found, slopes]), expected)
    assert residual == pytest.approx(np.array([[0.8, 1.3, 0.0]]), abs=1e-6)
    assert abs(1.0 / found - expected[0, 2]) > 0.01


def test_derivatives_are_those_of_differences() -> None:
    random = np.random.default_rng(1)
    points = np.column_stack([random.uniform(2, 8, 9), random.uniform(-2, 2, (9, 2))])
    pose = move_pose(np.eye(4), 0.1 * random.standard_normal(6))
    expected, local = CAMERA.measure(pose, points)
    by_pose, by_point = CAMERA.slopes(np.broadcast_to(pose, (9, 4, 4)), local, points)
    for k in range(6):
        step = 1e-6 * np.eye(6)[k]
        change = (CAMERA.measure(move_pose(pose, step), points)[0] - expected) / 1e-6
        assert by_pose[:, :, k] == pytest.approx(change, abs=2e-3)
    slopes = 0.01 * random.standard_normal((9, 2))
    fixed = np.column_stack([expected, slopes])
    by_pose, _ = CAMERA.slopes(np.broadcast_to(pose, (9, 4, 4)), local, points, fixed)
    for k in range(6):
        step = 1e-6 * np.eye(6)[k]
        change = -CAMERA.residuals(fixed, CAMERA.measure(move_pose(pose, step), points)[0]) / 1e-6
        assert by_pose[:, :, k] == pytest.approx(change, abs=2e-3)
    for k in range(3):
        change = (CAMERA.measure(pose, points + 1e-6 * np.eye(3)[k])[0] - expected) / 1e-6
        assert by_point[:, :, k] == pytest.approx(change, abs=2e-3)


def test_a_third_of_wrong_points_does_not_move_the_pose() -> None:
    random = np.random.default_rng(2)
    points = np.column_stack([random.uniform(3, 8, 60), random.uniform(-1.5, 1.5, (60, 2))])
    truth = move_pose(np.eye(4), np.array([0.2, -0.1, 0.05, 0.01, 0.0, 0.02]))
    measured = with_slopes(CAMERA.measure(truth, points)[0])
    measured[:20, :2] += random.uniform(15, 60, (20, 2))
    predicted = move_pose(truth, np.array([0.1, 0.1, -0.1, 0.0, 0.0, 0.0]))
    solved = solve(CAMERA, SIGMAS, 2.5, predicted, points, measured)
    assert solved is not None
    assert solved.inliers.tolist() == [False] * 20 + [True] * 40
    assert distance_between(solved.pose, truth) < 1e-3


def test_adjustment_brings_poses_and_points_back() -> None:
    random = np.random.default_rng(4)
    points = np.column_stack([random.uniform(3, 8, 50), random.uniform(-1.5, 1.5, (50, 2))])
    truth = np.stack([pose_of((0.3 * k, 0.1 * k, 0.0), Rotation.from_euler("z", 0.05 * k)) for k in range(4)])
    frame, point = np.repeat(np.arange(4), 50), np.tile(np.arange(50), 4)
    measured = with_slopes(np.concatenate([CAMERA.measure(pose, points)[0] for pose in truth]))
    turns = tuple(rotation_of(a).inv() * rotation_of(b) for a, b in itertools.pairwise(truth))
    start = np.stack([truth[0], *(move_pose(pose, 0.02 * random.standard_normal(6)) for pose in truth[1:])])
    shaken = points + 0.05 * random.standard_normal(points.shape)
    poses, better = adjust(
        CAMERA, SIGMAS.measured, WindowProblem(turns, np.full(3, 0.003), frame, point, measured), start, shaken
    )
    assert np.abs(poses - truth).max() < 1e-3
    assert np.abs(better - points).max() < 1e-2


def test_depths_on_edges_are_left_out() -> None:
    depth = np.full((8, 8), 2.0, np.float32)
    depth[:, 5:] = 4.0
    depth[6, 1] = np.nan
    found, _ = depth_at(depth, np.array([[2.5, 2.5], [4.5, 2.5], [1.5, 5.5]]))
    assert found[0] == pytest.approx(2.0)
    assert np.isnan(found[1:]).all()
