"""Precision, recall and average precision against an example worked by hand."""

import math

import numpy as np
import pytest

from xtdrone_perception.detection.scoring import (
    LabelledPicture,
    at_threshold,
    average_precision,
    best_threshold,
    match,
    overlaps,
)


def scene(found, truth, counts=None):
    found = np.array(found, float).reshape(-1, 5)
    truth = np.array(truth, float).reshape(-1, 4)
    return LabelledPicture(
        found[:, :4], found[:, 4], truth, np.ones(len(truth), bool) if counts is None else np.array(counts)
    )


A, B, C = (0, 0, 10, 20), (50, 0, 60, 20), (100, 0, 110, 40)
GROUND = (200, 100, 210, 120)


def test_overlap_of_two_boxes():
    union, own = overlaps(np.array([A]), np.array([(5, 0, 15, 20), B]))
    assert union[0] == pytest.approx([100 / 300, 0.0])
    assert own[0] == pytest.approx([0.5, 0.0])


def test_by_hand():
    # most probable first: A right, ground false, B right, A again false; C never detected
    first = scene([(*A, 0.9), (*A, 0.5), (*GROUND, 0.8)], [A])
    second = scene([(*B, 0.7)], [B, C])
    matches = match([first, second])
    assert matches.right.tolist() == [True, False, True, False]
    assert matches.there == 3
    # recall 1/3 at precision 1, recall 2/3 at precision 2/3
    assert average_precision(matches) == pytest.approx(1 / 3 + (1 / 3) * (2 / 3))
    assert at_threshold(matches, 0.7) == pytest.approx((2 / 3, 2 / 3, 0.5))
    assert at_threshold(matches, 0.95) == (1.0, 0.0, 0.0)
    assert best_threshold(matches) == 0.7


def test_box_must_overlap_by_half():
    nearly = (0, 0, 10, 9.9)  # 0.495 of A
    assert not match([scene([(*nearly, 0.9)], [A])]).right.any()
    assert match([scene([(*nearly, 0.9)], [A])], least_overlap=0.49).right.all()


def test_ignored_objects_are_neither_right_nor_false():
    within = (2, 2, 6, 10)
    matches = match([scene([(*A, 0.9), (*within, 0.8), (*B, 0.7)], [A, B], [False, True])])
    assert matches.scores.tolist() == [0.7]
    assert average_precision(matches) == 1.0


def test_only_objects_of_a_height_count():
    pictures = [scene([(*A, 0.9), (*C, 0.8), (*GROUND, 0.6)], [A, C])]
    low, high = match(pictures, heights=(12, 30)), match(pictures, heights=(30, 100))
    assert (low.right.tolist(), low.there) == ([True, False], 1)
    assert (high.right.tolist(), high.there) == ([True], 1)


def test_nothing_there_or_nothing_found():
    assert math.isnan(average_precision(match([scene([(*A, 0.9)], [])])))
    assert average_precision(match([scene([], [A])])) == 0.0
    assert best_threshold(match([scene([], [A])])) == 1.0
