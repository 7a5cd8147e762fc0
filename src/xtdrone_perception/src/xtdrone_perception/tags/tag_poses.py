"""Pose of a board of tags from the corners in an image.

The initial pose is from IPPE, the closed form for coplanar points (T. Collins and A. Bartoli, Infinitesimal plane-based
pose estimation, IJCV 2014), which gives two poses: seen from afar, a plane tilted towards the observer or away has
almost the same image. Both are refined to the minimum reprojection error (Levenberg-Marquardt). If the errors do not
discriminate, the expected orientation decides.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from xtdrone_common import rotation
from xtdrone_common.cameras.camera_pose import LINK_FROM_OPTICAL, CameraPose, rotation_matrix
from xtdrone_common.rotation import Quaternion, Vector
from xtdrone_common.settings import SettingError
from xtdrone_common.tag_boards import Tag, TagBoard
from xtdrone_perception.tags.tag_detector import SeenTag

Array = NDArray[np.float64]

CORNER_NOISE = 0.3  # px, standard deviation of a refined corner, each axis
_COUNTS = (0, 4, 5, 8)  # of OpenCV's distortion coefficients
_SAME = 1e-3  # rad
_CLEAR = 3.0  # ratio of squared errors above which the better pose is accepted


@dataclass(frozen=True)
class Optics:
    """Projection of a camera.

    Attributes:
        matrix: K of sensor_msgs/CameraInfo, (3, 3), pixels.
        distortion: its D in OpenCV's order, plumb_bob (4 or 5) or rational_polynomial (8); empty without a lens.
    """

    matrix: Array
    distortion: Array

    def __post_init__(self) -> None:
        """Check the values.

        Raises:
            SettingError: no focal lengths, numbers not finite, or a wrong number of coefficients.
        """
        if not (np.isfinite(self.matrix).all() and self.matrix[0, 0] > 0.0 and self.matrix[1, 1] > 0.0):
            raise SettingError("camera_info K", self.matrix.ravel().tolist(), "finite, with focal lengths above 0")
        if len(self.distortion) not in _COUNTS or not np.isfinite(self.distortion).all():
            raise SettingError("camera_info D", self.distortion.tolist(), "0, 4, 5 or 8 finite coefficients")


@dataclass(frozen=True)
class BoardPose:
    """Pose of a board in a camera's optical frame (x right, y down, z ahead).

    Attributes:
        rotation: Rotation from the board's frame, (3, 3).
        position: Position of the board's origin, (3,) m.
        covariance: Covariance of position, m, and of small turns about the optical frame's axes, rad, (6, 6).
        error: root mean square of the reprojection error per corner, pixels.
        tags: ids of the tags seen.
        certain: whether the alternative pose has a clearly larger error.
    """

    rotation: Array
    position: Array
    covariance: Array
    error: float
    tags: tuple[int, ...]
    certain: bool


def board_pose(
    board: TagBoard, seen: Sequence[SeenTag], optics: Optics, expected_normal: Array | None = None
) -> BoardPose | None:
    """Return the pose of a board; None if none of its tags is seen, or no pose explains the corners.

    Args:
        board: the tags and their positions.
        seen: tags of the image.
        optics: Optics of the camera.
        expected_normal: normal of the board in the optical frame, (3,), e.g. of a horizontal board; decides between two
            poses with similar errors.
    """
    there = {tag.id: tag for tag in board.tags}
    used = [tag for tag in seen if tag.id in there]
    if not used:
        return None
    points = np.concatenate([corners_of(there[tag.id]) for tag in used])
    pixels = np.concatenate([tag.corners for tag in used])
    found = _candidates(points, pixels, optics)
    if not found:
        return None
    certain = len(found) < 2 or found[1][0] > _CLEAR * max(found[0][0], CORNER_NOISE**2)
    if expected_normal is not None and not certain:
        found.sort(key=lambda candidate: -float(cv2.Rodrigues(candidate[1])[0][:, 2] @ expected_normal))
    square, turn, place = found[0]
    covariance = _covariance(points, turn, place, optics, max(CORNER_NOISE, float(np.sqrt(0.5 * square))))
    rotation = np.asarray(cv2.Rodrigues(turn)[0], float)
    return BoardPose(
        rotation, place.ravel(), covariance, float(np.sqrt(square)), tuple(tag.id for tag in used), bool(certain)
    )


def corners_of(tag: Tag) -> Array:
    """Return the corners of a tag on its board, (4, 3) m: upper left, upper right, lower right, lower left."""
    half = 0.5 * tag.size
    return np.array([(tag.x + x * half, tag.y + y * half, 0.0) for x, y in ((-1, 1), (1, 1), (1, -1), (-1, -1))])


def _candidates(points: Array, pixels: Array, optics: Optics) -> list[tuple[float, Array, Array]]:
    """Return mean squared error, px^2, rotation vector and position of one or two poses, the better one first."""
    try:
        _, turns, places, _ = cv2.solvePnPGeneric(
            points, pixels, optics.matrix, optics.distortion, flags=cv2.SOLVEPNP_IPPE
        )
    except cv2.error:
        return []
    found = []
    for turn, place in zip(turns, places, strict=True):
        if not (np.isfinite(turn).all() and np.isfinite(place).all()):
            continue
        turn, place = cv2.solvePnPRefineLM(points, pixels, optics.matrix, optics.distortion, turn, place)
        shown = cv2.projectPoints(points, turn, place, optics.matrix, optics.distortion)[0].reshape(-1, 2)
        square = float(np.mean(np.sum((shown - pixels) ** 2, axis=1)))
        if np.isfinite(square) and float(place[2, 0]) > 0.0:
            found.append((square, np.asarray(turn, float), np.asarray(place, float)))
    found.sort(key=lambda candidate: candidate[0])
    return found[:1] if len(found) == 2 and _same(found[0][1], found[1][1]) else found


def _same(one: Array, other: Array) -> bool:
    """Return whether two rotation vectors are the same rotation, e.g. when both refinements end in one minimum."""
    between = cv2.Rodrigues(one)[0] @ cv2.Rodrigues(other)[0].T
    return bool(np.linalg.norm(cv2.Rodrigues(between)[0]) < _SAME)


def _covariance(points: Array, turn: Array, place: Array, optics: Optics, noise: float) -> Array:
    """Return the covariance of position and turn from independent errors of the corners, px, to first order."""
    jacobian = cv2.projectPoints(points, turn, place, optics.matrix, optics.distortion)[1]
    by_turn = jacobian[:, :3] @ np.linalg.inv(_left_jacobian(turn.ravel()))  # from rotation vector to small turns
    columns = np.hstack([jacobian[:, 3:6], by_turn])
    return np.asarray(noise**2 * np.linalg.pinv(columns.T @ columns))


def _left_jacobian(vector: Array) -> Array:
    """Return the left Jacobian: from changes of a rotation vector to small rotations about fixed axes (J. Sola, 2018,
    eq. 145)."""
    angle = float(np.linalg.norm(vector))
    x, y, z = vector
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    if angle < 1e-6:
        return np.asarray(np.eye(3) + 0.5 * cross)
    a, b = (1.0 - np.cos(angle)) / angle**2, (angle - np.sin(angle)) / angle**3
    return np.asarray(np.eye(3) + a * cross + b * cross @ cross)


def optical_frame(position: Vector, attitude: Quaternion, offset: Vector, rpy: Vector) -> CameraPose:
    """Return the pose of a camera's optical frame in ``map``.

    Args:
        position: Position of base_link in ``map``, m, ENU.
        attitude: Attitude of base_link (FLU) in ``map``, a unit quaternion (w, x, y, z).
        offset: Offset of the camera from base_link, m, FLU.
        rpy: Roll, pitch and yaw of the camera's link (FLU) in base_link, rad; (0, pi / 2, 0) looks down.
    """
    x, y, z = rotation_matrix(attitude) @ np.asarray(offset, float) + np.asarray(position, float)
    link = rotation.multiply(attitude, rotation.from_euler(*rpy))
    return CameraPose((float(x), float(y), float(z)), rotation.multiply(link, LINK_FROM_OPTICAL))


def in_map(camera: CameraPose, turn: Array, place: Array) -> tuple[Array, Array]:
    """Transform rotation, (3, 3), and position, (3,) m, from the optical frame to ``map``."""
    out = rotation_matrix(camera.orientation)
    return out @ turn, out @ place + np.asarray(camera.position)


def up_in(camera: CameraPose) -> Array:
    """Return the upward direction in the optical frame, (3,)."""
    return np.asarray(rotation_matrix(camera.orientation)[2])


def quaternion(turn: Array) -> Quaternion:
    """Return the quaternion (w, x, y, z) of a rotation matrix (3, 3)."""
    x, y, z = ((float(a), float(b), float(c)) for a, b, c in turn.T)
    return rotation.from_axes(x, y, z)
