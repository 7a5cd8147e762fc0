"""Poses of boards of tags from exact and noisy corners, and tags found in drawn pictures."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest

from xtdrone_common import rotation
from xtdrone_common.cameras.camera_pose import rotation_matrix
from xtdrone_common.settings import SettingError
from xtdrone_common.tag_boards import LANDING, Tag, TagBoard
from xtdrone_perception.tags.tag_detector import SeenTag, TagDetector, TagDetectorSettings
from xtdrone_perception.tags.tag_poses import (
    CORNER_NOISE,
    Optics,
    board_pose,
    corners_of,
    in_map,
    optical_frame,
    quaternion,
    up_in,
)

MATRIX = np.array([[300.0, 0.0, 320.0], [0.0, 300.0, 240.0], [0.0, 0.0, 1.0]])
PINHOLE = Optics(MATRIX, np.zeros(0))
LENS = Optics(MATRIX, np.array([-0.28, 0.07, 0.0002, 0.0003, 0.0]))
DOWN = np.diag([1.0, -1.0, -1.0])  # a board straight below the camera, x to the right


def pose_of(tilt: tuple[float, float, float], place: tuple[float, float, float]) -> tuple[np.ndarray, np.ndarray]:
    return rotation_matrix(rotation.from_euler(*tilt)) @ DOWN, np.array(place)


def seen(board: TagBoard, turn: np.ndarray, place: np.ndarray, optics: Optics, noise=0.0, rng=None) -> list[SeenTag]:
    tags = []
    for tag in board.tags:
        points = corners_of(tag)
        pixels = cv2.projectPoints(points, cv2.Rodrigues(turn)[0], place, optics.matrix, optics.distortion)[0].reshape(
            4, 2
        )
        tags.append(SeenTag(tag.id, pixels + (rng.normal(0.0, noise, (4, 2)) if noise else 0.0)))
    return tags


@pytest.mark.parametrize("optics", [PINHOLE, LENS])
@pytest.mark.parametrize("board", [LANDING, TagBoard("t", (Tag(7, 0.3),))])
def test_exact_corners_give_the_exact_pose(board: TagBoard, optics: Optics) -> None:
    turn, place = pose_of((0.2, -0.3, 0.7), (0.3, -0.2, 2.0))
    found = board_pose(board, seen(board, turn, place, optics), optics)
    assert found is not None
    assert found.position == pytest.approx(place, abs=1e-5)
    assert found.rotation == pytest.approx(turn, abs=1e-5)
    assert found.error < 1e-3
    assert found.certain


def test_the_covariance_is_that_of_random_errors() -> None:
    rng = np.random.default_rng(1)
    turn, place = pose_of((0.3, 0.2, 0.5), (0.4, 0.1, 2.5))
    errors = []
    for _ in range(150):
        found = board_pose(LANDING, seen(LANDING, turn, place, PINHOLE, CORNER_NOISE, rng), PINHOLE)
        assert found is not None
        small = cv2.Rodrigues(found.rotation @ turn.T)[0].ravel()
        error = np.concatenate([found.position - place, small])
        errors.append(error @ np.linalg.solve(found.covariance, error))
    assert np.mean(errors) == pytest.approx(6.0, abs=0.8)


def test_of_two_poses_the_expected_orientation_decides() -> None:
    rng = np.random.default_rng(2)
    board = TagBoard("t", (Tag(7, 0.3),))
    turn, place = pose_of((0.0, 0.25, 0.0), (0.0, 0.0, 6.0))
    with_it = without = doubtful = 0
    for _ in range(40):
        tags = seen(board, turn, place, PINHOLE, CORNER_NOISE, rng)
        free, led = board_pose(board, tags, PINHOLE), board_pose(board, tags, PINHOLE, turn[:, 2])
        assert free is not None
        assert led is not None
        doubtful += not free.certain
        without += math.acos(min(1.0, free.rotation[:, 2] @ turn[:, 2])) < 0.3
        with_it += math.acos(min(1.0, led.rotation[:, 2] @ turn[:, 2])) < 0.3
    assert doubtful > 10
    assert with_it >= 38 > without


def test_a_board_that_is_not_seen_has_no_pose() -> None:
    assert board_pose(LANDING, [SeenTag(99, np.zeros((4, 2)))], PINHOLE) is None
    assert board_pose(LANDING, [SeenTag(1, np.full((4, 2), 7.0))], PINHOLE) is None


def test_wrong_calibrations_are_named() -> None:
    with pytest.raises(SettingError, match="camera_info K"):
        Optics(np.zeros((3, 3)), np.zeros(5))
    with pytest.raises(SettingError, match="camera_info D"):
        Optics(MATRIX, np.zeros(3))


def drawn(number: int, edge: int, corner: tuple[int, int]) -> np.ndarray:
    """Return a grey picture with a tag as the family's authors print it, its black square at a corner."""
    family = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    picture = np.full((240, 320), 255, np.uint8)
    x, y = corner
    picture[y : y + edge, x : x + edge] = np.rot90(cv2.aruco.generateImageMarker(family, number, edge, borderBits=1), 2)
    return picture


def test_tags_are_found_with_corners_in_order_to_parts_of_a_pixel() -> None:
    detector = TagDetector(TagDetectorSettings())
    [tag] = detector.detect(drawn(12, 80, (100, 60)))
    assert tag.id == 12
    assert tag.corners == pytest.approx(np.array([(100, 60), (180, 60), (180, 140), (100, 140)]), abs=0.3)
    assert detector.detect(np.full((240, 320), 128, np.uint8)) == []
    both = np.minimum(drawn(3, 40, (20, 20)), drawn(3, 80, (150, 100)))
    [larger] = detector.detect(both)
    assert larger.corners[0] == pytest.approx((150, 100), abs=0.5)
    assert TagDetector(TagDetectorSettings(least_edge=60.0)).detect(drawn(3, 40, (20, 20))) == []


def test_a_board_straight_below_lies_below_in_map() -> None:
    level = rotation.from_euler(0.0, 0.0, 0.0)
    camera = optical_frame((1.0, 2.0, 5.0), level, (0.0, 0.0, -0.05), (0.0, 0.5 * math.pi, 0.0))
    turn, place = in_map(
        camera, np.array([[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]]), np.array([0.1, -0.2, 3.0])
    )
    assert place == pytest.approx((1.2, 1.9, 1.95))  # up in the picture is ahead, right is to the right
    assert turn == pytest.approx(np.eye(3), abs=1e-9)
    assert quaternion(turn) == pytest.approx((1.0, 0.0, 0.0, 0.0))
    assert up_in(camera) == pytest.approx((0.0, 0.0, -1.0), abs=1e-9)
