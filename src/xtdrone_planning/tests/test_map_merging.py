"""Relative poses of maps, their registration and chains, against known transforms."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from toy_yard import pairs, seen, yard

from xtdrone_common.pose_matrices import (
    angle_between,
    distance_between,
    inverse,
    pose_of,
    transform_points,
    turned_about_z,
)
from xtdrone_planning.merging.frame_links import Link, Pairs, link_of
from xtdrone_planning.merging.map_chain import merge_maps, merge_points
from xtdrone_planning.merging.map_registration import Fit, fit_of, surfaces_of
from xtdrone_planning.merging.settings import FitSettings, LinkSettings, NotMergedError

Array = NDArray[np.float64]

FREE = LinkSettings(heading_deviation=3.2)  # no compass
FIT = FitSettings()


def frame(x: float, y: float, z: float, heading: float) -> Array:
    return pose_of((x, y, z), turned_about_z(heading))


HOME = frame(1.0, -2.0, 0.0, 0.0)
TURNED = frame(12.0, 7.0, 0.5, 2.4)
NEAR = frame(3.0, 1.0, 0.3, 0.1)


# relative poses


@pytest.mark.parametrize("other", [NEAR, TURNED])
def test_without_noise_the_relative_pose_is_exact(other: Array) -> None:
    link = link_of(pairs((0, HOME), (1, other), 0, noise=0.0), LinkSettings(heading_deviation=100.0))
    true = inverse(HOME) @ other
    assert distance_between(link.pose, true) < 1e-3
    assert angle_between(link.pose, true) < 1e-4
    assert link.inliers == 1.0


def test_errors_are_within_the_covariance() -> None:
    true = inverse(HOME) @ TURNED
    squares = []
    for seed in range(60):
        noisy = pairs((0, HOME), (1, TURNED), seed, noise=0.3)
        link = link_of(noisy, LinkSettings(heading_deviation=3.2, pose_noise=1e-3, correlation=0.0))
        squares.append(link.contradiction(true, (0.0, 0.0)) ** 2)
    assert 3.0 < np.mean(squares) < 5.0  # chi squared with 4 degrees of freedom, standard deviation 0.37


def test_errors_that_last_widen_the_covariance() -> None:
    noisy = pairs((0, HOME), (1, TURNED), 0)
    each = link_of(noisy, LinkSettings(heading_deviation=3.2, correlation=0.0))
    lasting = link_of(noisy, LinkSettings(heading_deviation=3.2, correlation=5.0))
    assert lasting.deviation == pytest.approx(each.deviation * np.sqrt(10.0), rel=0.02)  # 12 of 120 count


@pytest.mark.parametrize("seed", range(3))
def test_outliers_lose_their_weight(seed: int) -> None:
    noisy = pairs((0, HOME), (1, TURNED), seed, outliers=0.3)
    link = link_of(noisy, FREE)
    true = inverse(HOME) @ TURNED
    assert distance_between(link.pose, true) < 0.15
    assert angle_between(link.pose, true) < 0.02
    assert 0.6 < link.inliers < 0.8


def test_the_reverse_of_a_link_errs_alike() -> None:
    link = link_of(pairs((0, HOME), (1, TURNED), 0), FREE)
    back = link.reversed()
    other = frame(0.2, -0.1, 0.05, 0.02) @ link.pose
    assert back.pose @ link.pose == pytest.approx(np.eye(4), abs=1e-12)
    assert back.deviation == pytest.approx(link.deviation)
    assert back.contradiction(inverse(other), (0.3, 0.1)) == pytest.approx(
        link.contradiction(other, (0.3, 0.1)), rel=0.05
    )


def standing() -> Pairs:
    moving = pairs((0, HOME), (1, NEAR), 0)
    return moving._replace(other=np.tile(moving.other[:1], (120, 1)), seen=np.tile(moving.seen[:1], (120, 1)))


def test_links_that_are_not_known_well_enough_are_refused() -> None:
    noisy = pairs((0, HOME), (1, TURNED), 0)
    few = Pairs(*(part[:5] for part in noisy))
    with pytest.raises(NotMergedError, match="5 relative estimates, at least 10 are needed"):
        link_of(few, FREE)
    with pytest.raises(NotMergedError, match=r"only \d+ % of the relative estimates agree"):
        link_of(pairs((0, HOME), (1, TURNED), 0, outliers=0.8), FREE)
    with pytest.raises(NotMergedError, match=r"deviation of the heading: 3.20 rad, at most 0.25 rad is"):
        link_of(standing(), FREE)
    with pytest.raises(NotMergedError, match=r"deviation of the position: \d.\d\d m, at most 1 m is"):
        link_of(noisy._replace(deviations=np.full(120, 4.0)), FREE)


def test_a_compass_gives_the_heading_of_vehicles_that_hover() -> None:
    link = link_of(standing(), LinkSettings())
    assert link.heading_deviation == pytest.approx(0.2, rel=1e-3)


# registration


def fitted(first: Array, second: Array, true: Array, off: Array, how: FitSettings = FIT) -> Fit:
    """Return the fit from an estimate that is off the truth by a pose, standard deviation 0.4 m and 0.05 rad."""
    link = Link(off @ true, second.mean(axis=0), np.diag([0.4**2] * 3 + [0.05**2]), 1.0, 100)
    return fit_of(surfaces_of(first, how), surfaces_of(second, how), link, how)


@pytest.mark.parametrize("seed", range(3))
def test_a_fit_is_better_than_the_voxels(seed: int) -> None:
    points, true = yard(seed), inverse(HOME) @ TURNED
    first, second = seen(points, (0.0, 25.0), HOME, 1), seen(points, (15.0, 40.0), TURNED, 2)
    fit = fitted(first, second, true, frame(0.4, -0.3, 0.2, 0.03))
    middle = transform_points(inverse(TURNED), np.array([[20.0, 10.0, 1.0]]))
    assert np.linalg.norm(transform_points(fit.pose, middle) - transform_points(true, middle)) < 0.08
    assert angle_between(fit.pose, true) < 0.01
    assert fit.residual < 0.12
    assert 0.2 < fit.overlap < 0.8


@pytest.mark.parametrize("seed", range(4))
def test_maps_that_have_only_the_ground_in_common_are_refused(seed: int) -> None:
    points, true = yard(seed), inverse(HOME) @ NEAR
    apart = seen(points, (0.0, 18.0), HOME, 1), seen(points, (22.0, 40.0), NEAR, 2)
    with pytest.raises(NotMergedError, match="the maps overlap by"):
        fitted(*apart, true, np.eye(4))
    elsewhere = seen(points, (0.0, 25.0), HOME, 1), seen(yard(seed + 100), (0.0, 25.0), NEAR, 2)
    with pytest.raises(NotMergedError, match=r"agree|overlap|away from the relative|apart|tilt"):
        fitted(*elsewhere, true, np.eye(4))


def test_a_fit_far_from_the_relative_estimates_is_refused() -> None:
    points, true = yard(0), inverse(HOME) @ NEAR
    maps = seen(points, (0.0, 25.0), HOME, 1), seen(points, (15.0, 40.0), NEAR, 2)
    narrow = FitSettings(contradiction=1.0)
    with pytest.raises(NotMergedError, match=r"standard deviations away from the relative estimates"):
        fitted(*maps, true, frame(0.9, 0.3, 0.0, 0.0), narrow)
    assert fitted(*maps, true, frame(0.9, 0.3, 0.0, 0.0)).residual < 0.12


def test_a_long_wall_does_not_tell_the_place() -> None:
    u, z = (part.ravel() for part in np.meshgrid(np.arange(0.0, 30.0, 0.1), np.arange(0.0, 4.0, 0.1)))
    wall = np.stack([u, np.full(len(u), 5.0), z], axis=1)
    maps = seen(wall, (0.0, 20.0), np.eye(4), 1), seen(wall, (10.0, 30.0), np.eye(4), 2)
    with pytest.raises(NotMergedError, match="the surfaces do not determine the position"):
        fitted(*maps, np.eye(4), np.eye(4))


def test_an_empty_map_is_refused() -> None:
    with pytest.raises(NotMergedError, match="too few points"):
        fitted(seen(yard(0), (0.0, 40.0), HOME, 1), np.full((5, 3), 1.0), np.eye(4), np.eye(4))


# chains


def test_maps_are_chained_by_the_best_links() -> None:
    """The third vehicle's map overlaps only the second's; the fourth has no link; the fifth is in another yard."""
    frames = [HOME, TURNED, frame(30.0, 2.0, -0.4, -1.2), HOME, NEAR]
    points = yard(2, (60.0, 20.0), 26)
    limits = [(0.0, 24.0), (14.0, 44.0), (34.0, 60.0), (0.0, 20.0)]
    clouds = [seen(points, limit, frames[k], k) for k, limit in enumerate(limits)]
    clouds.append(seen(yard(77), (0.0, 24.0), NEAR, 9))
    ends = [(0, 1), (2, 1), (0, 2), (0, 4)]  # the second of these against the chain's direction
    estimates = {(i, j): pairs((i, frames[i]), (j, frames[j]), i + j) for i, j in ends}
    found = merge_maps(clouds, estimates, FREE, FIT)
    assert {number: placed.through for number, placed in found.placed.items()} == {0: 0, 1: 0, 2: 1}
    for number, place in ((1, [29.0, 10.0, 1.0]), (2, [47.0, 10.0, 1.0])):
        there = transform_points(inverse(frames[number]), np.array([place]))
        off = transform_points(found.placed[number].pose, there) - transform_points(inverse(HOME), np.array([place]))
        assert np.linalg.norm(off) < 0.2
    assert found.reasons[3] == {}
    assert list(found.reasons[4]) == [0]

    whole = merge_points(clouds, found.placed, 0.2)
    true = transform_points(inverse(HOME), points)
    assert np.mean(cKDTree(true).query(whole)[0] < 0.3) > 0.97
    assert np.mean(cKDTree(whole).query(true)[0] < 0.4) > 0.97

    alone = merge_maps(clouds, estimates, FREE, FitSettings(refine="off"))
    assert sorted(alone.placed) == [0, 1, 2, 4]
    tried = merge_maps(clouds, estimates, FREE, FitSettings(refine="tried"))
    assert tried.placed[1].fit is not None
    assert tried.placed[4].fit is None


def test_merging_is_the_same_to_the_last_bit() -> None:
    points = yard(1)
    clouds = [seen(points, (0.0, 25.0), HOME, 1), seen(points, (15.0, 40.0), TURNED, 2)]
    estimates = {(0, 1): pairs((0, HOME), (1, TURNED), 1)}
    first, second = (merge_maps(clouds, estimates, FREE, FIT) for _ in range(2))
    assert (first.placed[1].pose == second.placed[1].pose).all()
    maps = [merge_points(clouds, one.placed, 0.2) for one in (first, second)]
    assert maps[0].tobytes() == maps[1].tobytes()
