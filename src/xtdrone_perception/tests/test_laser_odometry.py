"""Odometry by a 2D laser without ROS, in a room in closed form."""

from __future__ import annotations

import numpy as np
import pytest
from room_scans import ROOM, ranges
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import LaserScan

from xtdrone_common.clouds import read_scan
from xtdrone_common.pose_matrices import distance_between, inverse, move_pose, pose_of
from xtdrone_perception.slam.deskewing import motion_of
from xtdrone_perception.slam.laser.laser_odometry import LaserEstimate, LaserOdometry, LaserSweep, ScanMatchSettings
from xtdrone_perception.slam.laser.scan_matching import normals_of
from xtdrone_perception.slam.odometry_health import Fault, HealthLimits, fault_of

ANGLES = np.linspace(-np.pi, np.pi, 512, endpoint=False)
RAYS = np.stack([np.cos(ANGLES), np.sin(ANGLES), 0.0 * ANGLES], axis=1)


def true_pose(k: int) -> np.ndarray:
    """Return a pose on a loop through the room, tilted as in flight."""
    t = 0.1 * k
    place = (3.0 * np.sin(0.4 * t), 2.0 - 2.0 * np.cos(0.4 * t), 1.5 + 0.2 * np.sin(t))
    return pose_of(place, Rotation.from_euler("zyx", [0.5 * np.sin(0.5 * t), 0.06 * np.sin(t), 0.05 * np.cos(t)]))


def sweep(pose: np.ndarray, seed: int, table: float = 0.0, room: object = ROOM) -> LaserSweep:
    """Return a scan without motion, above a table (its height, m)."""
    found = ranges(np.broadcast_to(pose[:3, 3], RAYS.shape), RAYS @ pose[:3, :3].T, room)  # type: ignore[arg-type]
    found = found + 0.01 * np.random.default_rng(seed).standard_normal(len(found))
    attitude = Rotation.from_matrix(pose[:3, :3])
    still = motion_of(np.array([0.0, 0.1]), Rotation.concatenate([attitude, attitude]), np.zeros(3))
    below = (pose[2, 3] - table) / pose[2, 2]
    return LaserSweep(RAYS * found[:, None], np.zeros(len(found)), still, attitude, float(below))


def fly(count: int, table_from: int = 10_000) -> tuple[LaserOdometry, list[LaserEstimate]]:
    odometry, found = LaserOdometry(ScanMatchSettings(), true_pose(0)), []
    for k in range(count):
        pose = true_pose(k)
        step = np.eye(4) if k == 0 else inverse(true_pose(k - 1)) @ pose
        step[:3, 3] *= 0.8
        scan = sweep(pose, k, 0.7 if k >= table_from else 0.0)
        found.append(odometry.register(scan, odometry.pose @ step))
        odometry.accept(found[-1])
    return odometry, found


def test_it_finds_its_way_through_a_room() -> None:
    odometry, found = fly(100)
    assert distance_between(odometry.pose, true_pose(99)) < 0.03
    assert all(fault_of(entry, 0, 60, HealthLimits()) is None for entry in found)
    sigma = np.sqrt(np.diag(found[-1].covariance))
    assert (sigma[[0, 1]] < 0.02).all()


def test_a_table_below_moves_the_ground_and_not_the_vehicle() -> None:
    odometry, found = fly(30, table_from=15)
    assert found[-1].floor == pytest.approx(0.7, abs=0.03)
    assert odometry.pose[2, 3] == pytest.approx(true_pose(29)[2, 3], abs=0.03)


def test_the_same_scans_give_the_same_bits() -> None:
    assert fly(12)[0].pose.tobytes() == fly(12)[0].pose.tobytes()


def test_a_corridor_without_ends_is_named() -> None:
    room = ((-500.0, -2.0, 0.0), (500.0, 2.0, 9.0))
    odometry = LaserOdometry(ScanMatchSettings(), np.eye(4))
    pose = pose_of((0.0, 0.0, 1.5), Rotation.identity())
    odometry.accept(odometry.register(sweep(pose, 0, room=room), pose))
    found = odometry.register(sweep(pose, 1, room=room), move_pose(pose, np.array([0.05, 0, 0, 0, 0, 0])))
    assert fault_of(found, 0, 60, HealthLimits()) is Fault.DEGENERATE


def test_normals_stand_on_lines_and_corners_have_none() -> None:
    line = np.stack([np.arange(0.0, 2.0, 0.1), np.full(20, 3.0)], axis=1)
    normals = normals_of(line)[4:-4]
    assert np.abs(normals[:, 1]) == pytest.approx(np.ones(12))
    assert np.isnan(normals_of(np.array([[0.0, 0.0], [5.0, 0.0], [0.0, 5.0]]))).all()


def test_scans_are_read_and_wrong_ones_are_named() -> None:
    message = LaserScan(angle_min=0.0, angle_increment=np.pi / 2, time_increment=0.01, range_min=0.5, range_max=20.0)
    message.ranges = [1.0, np.inf, 2.0, 0.1]
    scan = read_scan(message)
    assert scan.points == pytest.approx(np.array([[1.0, 0.0], [-2.0, 0.0]]))
    assert scan.times.tolist() == [0.0, 0.02]
    message.time_increment = 9.0
    with pytest.raises(ValueError, match=r"time_increment 9\.0: not finite, or longer than 1 s"):
        read_scan(message)
    message.ranges = [1.0]
    with pytest.raises(ValueError, match="ranges: 1 are not allowed, 2 to 100000"):
        read_scan(message)
