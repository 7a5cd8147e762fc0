"""How well a detector finds: precision, recall and average precision from boxes found and boxes that are there.

Boxes are (n, 4) arrays xmin, ymin, xmax, ymax in pixels. What is there but need not be found (too small, hidden) is
ignored: finding it is neither right nor wrong.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Scene:
    """One picture: what was found in it and what is there.

    Attributes:
        found: (n, 4) boxes found.
        scores: (n,) their probabilities.
        truth: (m, 4) boxes of what is there.
        counts: (m,) bool, False for what is ignored.
    """

    found: Array
    scores: Array
    truth: Array
    counts: NDArray[np.bool_]


@dataclass(frozen=True)
class Matches:
    """What became of the boxes found in many pictures.

    Attributes:
        scores: (n,) probabilities of the boxes that count, the highest first.
        right: (n,) bool, whether each found something that had not been found by a likelier one.
        there: how many objects that count there are.
        pictures: number of pictures.
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


def match(scenes: Iterable[Scene], least_overlap: float = 0.5, heights: tuple[float, float] = (0.0, np.inf)) -> Matches:
    """Say of every box found whether it is right, the likeliest first in each picture.

    A box is right where its intersection over union with an object that counts, and that no likelier box has found, is
    ``least_overlap`` or more; of several objects it finds the one it overlaps most. Otherwise it is ignored where it
    overlaps an object that is ignored so much, or lies in it by half of its own area, or is itself outside of
    ``heights``; all others are false.

    Args:
        scenes: the pictures.
        least_overlap: 0 to 1.
        heights: only objects from the first to below the second, px, count.
    """
    scores: list[float] = []
    right: list[bool] = []
    there, pictures = 0, 0
    for scene in scenes:
        pictures += 1
        truth = np.asarray(scene.truth, float).reshape(-1, 4)
        tall = truth[:, 3] - truth[:, 1]
        counts = np.asarray(scene.counts, bool) & (tall >= heights[0]) & (tall < heights[1])
        there += int(counts.sum())
        union, own = overlaps(scene.found, truth)
        free = counts.copy()
        for index in np.argsort(-np.asarray(scene.scores, float), kind="stable"):
            fitting = np.where(free, union[index], -1.0)
            best = int(fitting.argmax()) if len(fitting) else -1
            if best >= 0 and fitting[best] >= least_overlap:
                free[best] = False
                scores.append(float(scene.scores[index]))
                right.append(True)
                continue
            aside = ~counts & ((union[index] >= least_overlap) | (own[index] >= 0.5))
            height = scene.found[index][3] - scene.found[index][1]
            if not aside.any() and heights[0] <= height < heights[1]:
                scores.append(float(scene.scores[index]))
                right.append(False)
    order = np.argsort(-np.array(scores), kind="stable") if scores else np.zeros(0, int)
    return Matches(np.array(scores, float)[order], np.array(right, bool)[order], there, pictures)


def curve(matches: Matches) -> tuple[Array, Array]:
    """Return precision and recall after each box, the likeliest first."""
    hits = np.cumsum(matches.right)
    precision = hits / np.maximum(np.arange(1, len(hits) + 1), 1)
    return precision, hits / max(matches.there, 1)


def average_precision(matches: Matches) -> float:
    """Return the area under precision over recall, precision made monotonous; NaN where nothing was to be found."""
    if not matches.there:
        return float("nan")
    precision, recall = curve(matches)
    if not len(precision):
        return 0.0
    envelope = np.maximum.accumulate(precision[::-1])[::-1]
    steps = np.diff(np.concatenate([[0.0], recall]))
    return float((steps * envelope).sum())


def at_threshold(matches: Matches, threshold: float) -> tuple[float, float, float]:
    """Return precision, recall and false boxes a picture with what is as likely as ``threshold`` or more.

    Precision is 1 where nothing is found.
    """
    taken = matches.scores >= threshold
    hits = int(matches.right[taken].sum())
    false = int(taken.sum()) - hits
    precision = hits / (hits + false) if hits + false else 1.0
    return precision, hits / max(matches.there, 1), false / max(matches.pictures, 1)


def best_threshold(matches: Matches) -> float:
    """Return the threshold at which the harmonic mean of precision and recall is greatest; 1 where nothing is right."""
    precision, recall = curve(matches)
    both = precision + recall
    mean = np.divide(2 * precision * recall, both, out=np.zeros_like(both), where=both > 0)
    if not len(mean) or mean.max() == 0.0:
        return 1.0
    return float(matches.scores[int(mean.argmax())])
