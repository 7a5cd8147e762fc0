"""Lidar odometry and its supervision, without ROS."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from room_scans import PERIOD, ROOM, room_scan
from scipy.spatial.transform import Rotation

from xtdrone_common.pose_matrices import inverse, move_pose, pose_of, pose_of_vector, predicted_pose, vector_of
from xtdrone_perception.slam.deskewing import deskew, motion_of
from xtdrone_perception.slam.lidar_odometry import LidarOdometry, RegistrationOptions
from xtdrone_perception.slam.lidar_odometry_node import LidarHealthLimits
from xtdrone_perception.slam.odometry_health import Estimate, Fault, Health, OdometryState, fault_of

OPTIONS = RegistrationOptions(spacing=0.5)
GOOD = Estimate(
    pose=np.eye(4), predicted=np.eye(4), count=1000, share=0.9, residual=0.5, weakest=0.1, covariance=np.eye(6)
)


def true_pose(time: float) -> np.ndarray:
    """Return a pose on a loop through the room, with turns."""
    place = (4.0 * np.sin(0.5 * time), 3.0 - 3.0 * np.cos(0.5 * time), 2.0 + 0.3 * np.sin(time))
    return pose_of(place, Rotation.from_rotvec([0.0, 0.0, 0.6 * np.sin(0.7 * time)]))


def fly(seconds: float, room: object = ROOM, start: float = 0.0) -> tuple[LidarOdometry, list, np.ndarray]:
    """Return odometry, registrations, and the last true pose of a flight with an autopilot's estimate of the motion."""
    odometry, found = LidarOdometry(OPTIONS, np.eye(4), true_pose(start + PERIOD)), []
    for k in range(round(seconds / PERIOD)):
        begin, end = true_pose(start + k * PERIOD), true_pose(start + (k + 1) * PERIOD)
        step = inverse(begin) @ end
        velocity = (end[:3, 3] - begin[:3, 3]) / PERIOD
        attitudes = Rotation.from_matrix(np.array([begin[:3, :3], end[:3, :3]]))
        motion = motion_of(np.array([0.0, PERIOD]), attitudes, velocity)
        last = odometry.pose if k else end
        predicted = predicted_pose(last, Rotation.from_matrix(step[:3, :3]) if k else Rotation.identity(),
                                   velocity if k else np.zeros(3), PERIOD)  # fmt: skip
        scan = room_scan(begin, end, k, room)  # type: ignore[arg-type]
        found.append(odometry.register(odometry.points_of(scan, motion), predicted))
        odometry.accept(found[-1])
    return odometry, found, end


def test_poses_and_vectors_are_inverse() -> None:
    pose = pose_of_vector(np.array([1.0, 2.0, 3.0, 0.1, -0.2, 0.3]))
    assert vector_of(pose_of_vector(vector_of(pose))) == pytest.approx(vector_of(pose))
    assert inverse(pose) @ pose == pytest.approx(np.eye(4))


def test_without_skew_points_lie_on_the_walls() -> None:
    """In closed form: at the true motion every point lies on the room's walls; with skew some are far off."""
    begin = true_pose(1.0)
    step = pose_of((0.6, -0.2, 0.1), Rotation.from_rotvec([0.0, 0.0, 0.12]))
    end = begin @ step
    scan = room_scan(begin, end, 0, noise=0.0)
    turns = Rotation.from_rotvec(np.outer(np.linspace(0, 1, 6), vector_of(step)[3:]))
    attitudes = Rotation.from_matrix(begin[:3, :3]) * turns
    motion = motion_of(np.linspace(0.0, PERIOD, 6), attitudes, (end[:3, 3] - begin[:3, 3]) / PERIOD)

    def off(points: np.ndarray) -> np.ndarray:
        world = points @ end[:3, :3].T + end[:3, 3]
        walls = np.concatenate([np.abs(world - np.array(corner)) for corner in (*ROOM, (5, 4, 0), (7, 6.5, 5))], axis=1)
        return walls.min(axis=1)

    assert np.percentile(off(scan.points), 90) > 0.05
    assert off(deskew(scan.points, scan.times, motion)).max() < 0.02


def test_it_finds_its_way_through_a_room_and_knows_how_well() -> None:
    odometry, found, truth = fly(8.0)
    error = inverse(truth) @ odometry.pose
    assert np.linalg.norm(error[:3, 3]) < 0.05
    assert np.linalg.norm(vector_of(error)[3:]) < 0.01
    assert all(fault_of(entry, 0, OPTIONS.least_points, LidarHealthLimits()) is None for entry in found)
    sigma = np.sqrt(np.trace(found[-1].covariance[:3, :3]))
    assert 0.002 < sigma < 0.2


def test_the_same_scans_give_the_same_bits() -> None:
    first, second = fly(1.0)[0].pose, fly(1.0)[0].pose
    assert first.tobytes() == second.tobytes()


@pytest.mark.parametrize(
    ("room", "fault"),
    [
        (None, Fault.DEGENERATE),  # a plain
        (((-500.0, -3.0, 0.0), (500.0, 3.0, 50.0)), Fault.DEGENERATE),  # a corridor without ends
        (((-500.0, -1.5, 0.0), (500.0, 1.5, 3.0)), Fault.DEGENERATE),  # a narrow one
        (((-500.0, -500.0, -400.0), (500.0, 500.0, 400.0)), Fault.BLIND),  # nothing within reach
    ],
)
def test_surroundings_that_do_not_tell_the_position_are_found(room: object, fault: Fault) -> None:
    import room_scans

    block, room_scans._CORNERS = room_scans._CORNERS, ((900.0, 900.0, 900.0), (901.0, 901.0, 901.0))
    try:
        _, found, _ = fly(1.5, room)
    finally:
        room_scans._CORNERS = block
    assert {fault_of(entry, 0, OPTIONS.least_points, LidarHealthLimits()) for entry in found[5:]} == {fault}


@pytest.mark.parametrize(
    ("change", "fault"),
    [
        ({}, None),
        ({"same": 2}, Fault.FROZEN),
        ({"count": 20}, Fault.BLIND),
        ({"share": 0.2}, Fault.UNMATCHED),
        ({"weakest": 0.001}, Fault.DEGENERATE),
        ({"weakest": 0.0087}, None),  # 2000 points on the ground and a few trees, seen at a tilt of 25 degrees
        ({"residual": 9.0}, Fault.RESIDUAL),
        ({"jump": 1.0}, Fault.DIVERGED),
        ({"turn": 0.5}, Fault.DIVERGED),
        ({"is_first": True, "share": 0.0}, None),
    ],
)
def test_each_fault_is_named(change: dict, fault: Fault | None) -> None:
    same, step = change.pop("same", 0), [change.pop("jump", 0.01), 0.0, 0.0, 0.0, 0.0, change.pop("turn", 0.01)]
    found = replace(GOOD, pose=move_pose(np.eye(4), np.array(step)), **change)
    assert fault_of(found, same, 100, LidarHealthLimits()) is fault


def test_a_bad_scan_is_left_out_two_end_the_odometry_and_ten_good_ones_bring_it_back() -> None:
    health = Health(LidarHealthLimits())
    assert health.on_scan(0.1, None)
    assert health.state is OdometryState.GOOD
    assert not health.on_scan(0.2, Fault.RESIDUAL)
    assert health.state is OdometryState.GOOD
    assert health.on_scan(0.3, None)
    assert not health.on_scan(0.4, Fault.RESIDUAL)
    assert not health.on_scan(0.5, Fault.BLIND)
    assert (health.state, health.fault) == (OdometryState.LOST, Fault.BLIND)
    passed = [health.on_scan(0.6 + 0.1 * k, None) for k in range(10)]
    assert passed == [False] * 9 + [True]


def test_silence_is_a_fault() -> None:
    health = Health(LidarHealthLimits())
    health.on_time(5.0)
    assert health.state is OdometryState.WAITING
    health.on_scan(5.0, None)
    health.on_time(5.3)
    assert health.state is OdometryState.GOOD
    health.on_time(5.4)
    assert (health.state, health.fault) == (OdometryState.LOST, Fault.SILENT)
