"""Output layouts of YOLO networks: conversion of a network's arrays to boxes, classes and probabilities.

Four layouts, C classes and N candidates:

- ``darknet``: darknet's region layers as run by OpenCV, one or several arrays (N, 5 + C). Row: centre x, y, width,
  height as fractions of the input, objectness, class probabilities (objectness included). yolov3, yolov3-tiny, yolov4,
  yolov4-tiny, and ONNX exports of these with the same decoding.
- ``yolov4``: a pair (1, N, 1, 4) and (1, N, C), as in ONNX exports of yolov4: corners as fractions of the input, and
  class probabilities.
- ``yolov5``: (1, N, 5 + C). Row: centre x, y, width, height in pixels of the input, objectness, conditional class
  probabilities. Also yolov3 and yolov7 exported by the same tools.
- ``yolov8``: (1, 4 + C, N). Column: centre x, y, width, height in pixels of the input, class probabilities. Also yolov9
  and yolo11, exported without non-maximum suppression.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

LAYOUTS = ("darknet", "yolov4", "yolov5", "yolov8")

Array = NDArray[np.float64]
Shape = tuple[int, ...]


class LayoutError(ValueError):
    """Outputs that match no known layout, or another number of classes."""


def find_layout(shapes: Sequence[Shape], classes: int, darknet: bool) -> str:
    """Return the layout of a network's outputs.

    Args:
        shapes: of all outputs.
        classes: number of names, C.
        darknet: whether the network was read from darknet's files.

    Raises:
        LayoutError: no layout matches; the message names those expected.
    """
    candidates = ("darknet",) if darknet else ("yolov5", "yolov8", "yolov4", "darknet")
    fitting = [layout for layout in candidates if fits(layout, shapes, classes)]
    if fitting:
        return fitting[0]
    raise LayoutError(
        f"outputs of shapes {_text(shapes)} fit none of {', '.join(candidates)} with {classes} "
        f"{'class' if classes == 1 else 'classes'}{_guess(shapes, classes, darknet)}"
    )


def check_layout(layout: str, shapes: Sequence[Shape], classes: int) -> None:
    """Check that outputs of these shapes match a layout.

    Raises:
        LayoutError: they do not.
    """
    if not fits(layout, shapes, classes):
        raise LayoutError(
            f"outputs of shapes {_text(shapes)} are not of layout {layout} with {classes} "
            f"{'class' if classes == 1 else 'classes'}{_guess(shapes, classes, layout == 'darknet')}"
        )


def fits(layout: str, shapes: Sequence[Shape], classes: int) -> bool:
    """Return whether outputs of these shapes match a layout."""
    if layout == "darknet":
        return bool(shapes) and all(
            len(shape) >= 2 and shape[-1] == 5 + classes and _ones(shape[:-2]) for shape in shapes
        )
    if layout == "yolov4":
        if len(shapes) != 2:
            return False
        boxes, scores = _boxes_first(shapes)
        return (
            len(boxes) >= 2
            and len(scores) >= 2
            and boxes[-1] == 4
            and scores[-1] == classes
            and np.prod(boxes) // 4 == np.prod(scores) // classes
        )
    if len(shapes) != 1 or len(shapes[0]) != 3 or shapes[0][0] != 1:
        return False
    _, rows, columns = shapes[0]
    return columns == 5 + classes if layout == "yolov5" else rows == 4 + classes


def decode(
    layout: str, outputs: Sequence[Array], size: tuple[int, int], least: float
) -> tuple[Array, NDArray[np.int64], Array]:
    """Return the boxes of sufficient probability, before non-maximum suppression.

    Args:
        layout: one of LAYOUTS.
        outputs: of the network, float.
        size: (width, height) of the network's input, pixels.
        least: minimum probability, 0 to 1.

    Returns:
        corners (n, 4) xmin, ymin, xmax, ymax in pixels of the input; classes (n,); probabilities (n,).
    """
    if layout == "yolov4":
        boxes, scores = _boxes_first(outputs)
        scores = scores.reshape(-1, scores.shape[-1])
        chosen, classes, probabilities = _likely(scores, least)
        corners = boxes.reshape(-1, 4)[chosen] * np.tile(size, 2)
        return corners, classes, probabilities
    if layout == "darknet":
        rows = np.concatenate([output.reshape(-1, output.shape[-1]) for output in outputs])
        scores, scale = rows[:, 5:], np.tile(size, 2)
    elif layout == "yolov5":
        rows = outputs[0].reshape(-1, outputs[0].shape[-1])
        scores, scale = rows[:, 5:] * rows[:, 4:5], np.ones(4)
    else:
        rows = outputs[0][0].T
        scores, scale = rows[:, 4:], np.ones(4)
    chosen, classes, probabilities = _likely(scores, least)
    middles, sizes = rows[chosen, :2] * scale[:2], rows[chosen, 2:4] * scale[2:]
    return np.hstack([middles - 0.5 * sizes, middles + 0.5 * sizes]), classes, probabilities


def _likely(scores: Array, least: float) -> tuple[NDArray[np.int64], NDArray[np.int64], Array]:
    """Return the indices of the rows of sufficient probability, their most probable classes and the probabilities."""
    classes = np.argmax(scores, axis=1)
    probabilities = scores[np.arange(len(scores)), classes]
    chosen = np.flatnonzero(probabilities >= least)
    return chosen, classes[chosen], np.clip(probabilities[chosen], 0.0, 1.0)


def _boxes_first(pair: Sequence) -> tuple:
    """Return the two outputs of ``yolov4``, or their shapes, boxes first."""
    shapes = [entry if isinstance(entry, tuple) else entry.shape for entry in pair]
    # With four classes both end in 4; the boxes have one more axis.
    second = shapes[1][-1] == 4 and (shapes[0][-1] != 4 or len(shapes[1]) > len(shapes[0]))
    return (pair[1], pair[0]) if second else (pair[0], pair[1])


def _ones(shape: Shape) -> bool:
    return all(length == 1 for length in shape)


def _text(shapes: Sequence[Shape]) -> str:
    return ", ".join(" x ".join(map(str, shape)) for shape in shapes)


def _guess(shapes: Sequence[Shape], classes: int, darknet: bool) -> str:
    """Return the apparent number of classes of a network, for a message; empty if it cannot be determined."""
    if not shapes:
        return ""
    shape = shapes[0]
    if darknet or len(shapes) > 1:
        seems = shape[-1] - 5
    elif len(shape) == 3 and shape[0] == 1:
        seems = shape[2] - 5 if shape[2] < shape[1] else shape[1] - 4
    else:
        return ""
    if seems < 1 or seems == classes:
        return ""
    return f"; the network seems to have {seems}, the file of names must have as many"
