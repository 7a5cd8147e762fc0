"""Errors of odometry: closed forms, alignment, and the formats of evo."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from xtdrone_interaction.metrics.odometry_errors import (
    Trajectory,
    aligned,
    errors,
    trajectory_of,
    umeyama,
    write_kitti,
    write_tum,
)
from xtdrone_interaction.recording.series_in_bounded_memory import Series

TIME = np.linspace(0.0, 20.0, 201)


def straight(scale: float = 1.0, start: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Trajectory:
    """Return 2 m/s east times ``scale``, level."""
    position = np.array(start) + np.outer(2.0 * scale * TIME, [1.0, 0.0, 0.0])
    return Trajectory(TIME, position, np.tile([1.0, 0.0, 0.0, 0.0], (len(TIME), 1)))


def curved() -> Trajectory:
    """Return a curve with turns."""
    position = np.stack([5 * np.sin(0.3 * TIME), TIME, 0.5 * np.cos(TIME)], axis=1)
    x, y, z, w = Rotation.from_euler("ZYX", np.stack([0.1 * TIME, 0.05 * np.sin(TIME), 0 * TIME], axis=1)).as_quat().T
    return Trajectory(TIME, position, np.stack([w, x, y, z], axis=1))


def test_a_scale_of_one_percent_is_a_drift_of_one_percent() -> None:
    found = errors(straight(1.01), straight())
    assert found is not None
    assert found.way == pytest.approx(40.0)
    assert found.end == pytest.approx(0.4)
    assert found.drift == pytest.approx(1.0)
    assert found.greatest == pytest.approx(0.4)
    assert found.ate == pytest.approx(np.sqrt(np.mean((0.02 * TIME) ** 2)))
    assert found.rpe_percent == pytest.approx(1.0, rel=0.03)  # over the poses nearest to 10 m
    assert found.rpe_turn == pytest.approx(0.0, abs=1e-6)


def test_alignment_by_the_first_pose_takes_out_place_and_heading() -> None:
    turn = Rotation.from_euler("z", 0.7)
    moved = curved().moved(turn, np.array([3.0, -4.0, 1.0]))
    for alignment in ("first", "umeyama"):
        found = errors(moved, curved(), alignment)
        assert found is not None
        assert found.greatest < 1e-9
        assert found.rpe == pytest.approx(0.0, abs=1e-9)
    as_it_is = errors(moved, curved(), "none")
    assert as_it_is is not None
    assert as_it_is.ate > 1.0
    assert as_it_is.rpe == pytest.approx(0.0, abs=1e-9)  # relative errors are independent of the frame


@pytest.mark.parametrize("seed", range(5))
def test_umeyama_gives_back_any_motion(seed: int) -> None:
    rng = np.random.default_rng(seed)
    points, shift, turn = rng.standard_normal((30, 3)), rng.standard_normal(3), Rotation.random(random_state=seed)
    found, moved = umeyama(points, turn.apply(points) + shift)
    assert (found.inv() * turn).magnitude() < 1e-6
    assert moved == pytest.approx(shift)


def test_times_are_brought_together_by_interpolation() -> None:
    late = Trajectory(TIME[5:-5] + 0.03, straight().at(TIME[5:-5] + 0.03).position, straight().quaternion[5:-5])
    found = errors(late, straight())
    assert found is not None
    assert found.greatest < 1e-9


def test_too_little_is_no_result_and_a_wrong_alignment_is_named() -> None:
    short = Trajectory(TIME[:2], straight().position[:2], straight().quaternion[:2])
    assert errors(short, straight()) is None
    assert errors(straight(), short) is None
    with pytest.raises(ValueError, match="alignment: 'best' is not allowed, first, umeyama, none"):
        aligned(straight(), straight(), "best")


def test_invalid_poses_are_left_out() -> None:
    value = np.tile([1.0, 2.0, 3.0, 0.0, 0.0, 0.0, 1.0], (4, 1))
    value[1, 0], value[2, 6] = np.nan, 0.0
    found = trajectory_of(Series(np.arange(4.0), value))
    assert found.time.tolist() == [0.0, 3.0]
    assert found.quaternion[0].tolist() == [1.0, 0.0, 0.0, 0.0]


def test_files_are_as_evo_reads_them(tmp_path: Path) -> None:
    write_tum(curved(), tmp_path / "a.tum")
    write_kitti(curved(), tmp_path / "a.kitti")
    tum, kitti = np.loadtxt(tmp_path / "a.tum"), np.loadtxt(tmp_path / "a.kitti")
    assert tum.shape == (201, 8)
    assert kitti.shape == (201, 12)
    matrices = kitti.reshape(-1, 3, 4)
    assert matrices[:, :, 3] == pytest.approx(tum[:, 1:4])
    assert Rotation.from_quat(tum[:, 4:]).as_matrix() == pytest.approx(matrices[:, :, :3], abs=1e-6)
