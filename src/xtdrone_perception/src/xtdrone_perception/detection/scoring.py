"""Scores of a detector: precision, recall and average precision from detected and true boxes.

Boxes are (n, 4) arrays xmin, ymin, xmax, ymax in pixels. True objects that need not be detected (too small, hidden) are
ignored: detecting them is neither right nor wrong.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class LabelledPicture:
    """Detected and true boxes of an image.

    Attributes:
        found: (n, 4) detected boxes.
        scores: (n,) their probabilities.
        truth: (m, 4) true boxes.
        counts: (m,) bool, False for true boxes that are ignored.
    """

    found: Array
    scores: Array
    truth: Array
    counts: NDArray[np.bool_]


@dataclass(frozen=True)
class Matches:
    """Matches between the detected and the true boxes of many images.

    Attributes:
        scores: (n,) probabilities of the detected boxes that count, the highest first.
        right: (n,) bool, whether each is the most probable box of an object.
        there: number of true objects that count.
        pictures: number of images.
    """

    scores: Array
    right: NDArray[np.bool_]
    there: int
    pictures: int


def overlaps(one: Array, other: Array) -> tuple[Array, Array]:
    """Return (n, m) intersection over union, and intersection over the area of ``one``."""
    one, other = np.asarray(one, float).reshape(-1, 4), np.asarray(other, float).reshape(-1, 4)
    low = np.maximum(one[:, None, :2], other[None, :, :2])
    high = np.minimum(one[:, None, 2:], other[None, :, 2:])
    common = np.clip(high - low, 0.0, None).prod(2)
    area_one = (one[:, 2:] - one[:, :2]).prod(1)
    area_other = (other[:, 2:] - other[:, :2]).prod(1)
    union = area_one[:, None] + area_other[None] - common
    return common / np.maximum(union, 1e-12), common / np.maximum(area_one[:, None], 1e-12)


def match(
    pictures: Iterable[LabelledPicture], least_overlap: float = 0.5, heights: tuple[float, float] = (0.0, np.inf)
) -> Matches:
    """Match detected boxes with true ones, the most probable first in each image.

    A box is right if its intersection over union with an object that counts and is still unmatched is at least
    ``least_overlap``; of several objects, it matches the one with the maximum overlap. Otherwise it is ignored if it
    overlaps an ignored object as much, lies in one by half of its own area, or is itself outside ``heights``. All other
    boxes are false.

    Args:
        pictures: detected and true boxes.
        least_overlap: 0 to 1.
        heights: only objects at least as high as the first and below the second, px, count.
    """
    scores: list[float] = []
    right: list[bool] = []
    there, count = 0, 0
    for picture in pictures:
        count += 1
        truth = np.asarray(picture.truth, float).reshape(-1, 4)
        tall = truth[:, 3] - truth[:, 1]
        counts = np.asarray(picture.counts, bool) & (tall >= heights[0]) & (tall < heights[1])
        there += int(counts.sum())
        union, own = overlaps(picture.found, truth)
        free = counts.copy()
        for index in np.argsort(-np.asarray(picture.scores, float), kind="stable"):
            fitting = np.where(free, union[index], -1.0)
            best = int(fitting.argmax()) if len(fitting) else -1
            if best >= 0 and fitting[best] >= least_overlap:
                free[best] = False
                scores.append(float(picture.scores[index]))
                right.append(True)
                continue
            aside = ~counts & ((union[index] >= least_overlap) | (own[index] >= 0.5))
            height = picture.found[index][3] - picture.found[index][1]
            if not aside.any() and heights[0] <= height < heights[1]:
                scores.append(float(picture.scores[index]))
                right.append(False)
    order = np.argsort(-np.array(scores), kind="stable") if scores else np.zeros(0, int)
    return Matches(np.array(scores, float)[order], np.array(right, bool)[order], there, count)


def curve(matches: Matches) -> tuple[Array, Array]:
    """Return precision and recall after each box, the most probable first."""
    hits = np.cumsum(matches.right)
    precision = hits / np.maximum(np.arange(1, len(hits) + 1), 1)
    return precision, hits / max(matches.there, 1)


def average_precision(matches: Matches) -> float:
    """Return the area under the monotone precision-recall curve; NaN without any true object."""
    if not matches.there:
        return float("nan")
    precision, recall = curve(matches)
    if not len(precision):
        return 0.0
    envelope = np.maximum.accumulate(precision[::-1])[::-1]
    steps = np.diff(np.concatenate([[0.0], recall]))
    return float((steps * envelope).sum())


def at_threshold(matches: Matches, threshold: float) -> tuple[float, float, float]:
    """Return precision, recall and false boxes per image, counting boxes of probability ``threshold`` or more.

    Precision is 1 if there is no such box.
    """
    taken = matches.scores >= threshold
    hits = int(matches.right[taken].sum())
    false = int(taken.sum()) - hits
    precision = hits / (hits + false) if hits + false else 1.0
    return precision, hits / max(matches.there, 1), false / max(matches.pictures, 1)


def best_threshold(matches: Matches) -> float:
    """Return the threshold with the maximum harmonic mean of precision and recall; 1 if no box is right."""
    precision, recall = curve(matches)
    both = precision + recall
    mean = np.divide(2 * precision * recall, both, out=np.zeros_like(both), where=both > 0)
    if not len(mean) or mean.max() == 0.0:
        return 1.0
    return float(matches.scores[int(mean.argmax())])
