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

Networks that choose their objects themselves (end-to-end exports: one row of corners, score and class per object) have
shapes like those of ``yolov5`` with one or two classes. They are rejected, and so are outputs that fit two layouts.
"""

from __future__ import annotations

import ast
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

LAYOUTS = ("darknet", "yolov4", "yolov5", "yolov8")

Array = NDArray[np.float64]
Shape = tuple[int, ...]


_CHOSEN_COLUMNS = (6, 7)
"""Columns of end-to-end exports: corners, score and class, and in some the number of the picture or an angle."""
_USUAL_LIMITS = (100, 200, 300, 500, 1000, 3000)  # objects of an end-to-end export
_LONGEST_LITERAL = 1 << 18  # characters of a text in the metadata
_STRIDES = (4, 8, 16, 32, 64)
_LARGEST_FRACTION = 2.0  # of the input; coordinates beyond it are pixels
_ADVICE = (
    "export it without non-maximum suppression (Ultralytics: nms=False, end2end=False), or give layout if it is known"
)


class LayoutError(ValueError):
    """Outputs that match no known layout, or several, or another number of classes."""


def find_layout(shapes: Sequence[Shape], classes: int, darknet: bool, size: tuple[int, int]) -> str:
    """Return the layout of a network's outputs.

    Args:
        shapes: Shapes of all outputs.
        classes: number of names, C.
        darknet: whether the network was read from darknet's files.
        size: (width, height) of the network's input, pixels.

    Raises:
        LayoutError: no layout matches; the message names those expected. Or it is not certain which one does.
    """
    candidates = ("darknet",) if darknet else ("yolov5", "yolov8", "yolov4", "darknet")
    fitting = [layout for layout in candidates if fits(layout, shapes, classes)]
    if "yolov5" in fitting and "yolov8" in fitting:
        raise LayoutError(f"outputs of shapes {_text(shapes)} fit yolov5 and yolov8: give layout")
    if "yolov4" in fitting and not _has_certain_boxes(shapes):
        raise LayoutError(
            f"outputs of shapes {_text(shapes)} are not certainly yolov4, 1 x N x 1 x 4 and 1 x N x {classes}: "
            f"{_ADVICE}"
        )
    if fitting and (darknet or not _may_be_chosen(shapes, size)):
        return fitting[0]
    if not darknet and _may_be_chosen(shapes, size):
        raise LayoutError(
            f"output of shape {_text(shapes)} may have the objects that the network has chosen (corners, score, "
            f"class), which is not supported: {_ADVICE}"
        )
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


def _has_certain_boxes(shapes: Sequence[Shape]) -> bool:
    """Return whether a pair is that of ``yolov4``; (1, N, 4) has centres and sizes in other networks."""
    boxes, scores = _boxes_first(shapes)
    return len(boxes) == 4 and boxes[2] == 1 and len(scores) == 3


def _may_be_chosen(shapes: Sequence[Shape], size: tuple[int, int]) -> bool:
    """Return whether a single output may be that of an end-to-end export."""
    if len(shapes) != 1 or len(shapes[0]) < 2 or shapes[0][-1] not in _CHOSEN_COLUMNS or not _ones(shapes[0][:-2]):
        return False
    rows = shapes[0][-2]
    return rows in _USUAL_LIMITS or rows not in _grid_sizes(size)


def _grid_sizes(size: tuple[int, int]) -> set[int]:
    """Return the numbers of candidates on the grids of a network: two or more with 3 anchors, three or more with 1."""
    cells = [-(-size[0] // stride) * -(-size[1] // stride) for stride in _STRIDES]
    grids = [(first, last) for first in range(4) for last in range(3, 5) if last > first]  # each with the stride of 32
    found = {3 * sum(cells[first : last + 1]) for first, last in grids}
    return found | {sum(cells[first : last + 1]) for first, last in grids if last - first > 1}


def check_scale(layout: str, outputs: Sequence[Array]) -> None:
    """Check that the coordinates of a network are pixels or fractions of the input, as its layout has them.

    Args:
        layout: one of LAYOUTS.
        outputs: Outputs of the network for any picture.

    Raises:
        LayoutError: they are not, so that all boxes would be at wrong places.
    """
    if layout == "yolov4":
        return
    columns = [output[0].T if layout == "yolov8" else output.reshape(-1, output.shape[-1]) for output in outputs]
    largest = max((float(np.abs(rows[:, :2]).max()) for rows in columns if len(rows)), default=0.0)
    if (layout == "darknet") != (largest <= _LARGEST_FRACTION):
        wanted = "fractions of the input" if layout == "darknet" else "pixels"
        raise LayoutError(f"centres up to {largest:.4g} are not of layout {layout}, which has {wanted}: {_ADVICE}")


def check_metadata(metadata: Mapping[str, str], classes: int) -> None:
    """Check what Ultralytics' exporter has written into a file: ``task``, ``end2end``, ``args`` and ``names``.

    Args:
        metadata: texts by name; empty if there are none.
        classes: number of names, C.

    Raises:
        LayoutError: the network does another task, chooses the objects itself, or has another number of classes.
    """
    task = metadata.get("task", "detect")
    if task != "detect":
        raise LayoutError(f"task {task[:40]!r} is not allowed, detect")
    arguments, names = (_literal(metadata.get(name, "{}")) for name in ("args", "names"))
    if metadata.get("end2end", "").lower() == "true" or (isinstance(arguments, Mapping) and arguments.get("nms")):
        raise LayoutError(f"an end-to-end export, which has chosen its objects, is not supported: {_ADVICE}")
    if isinstance(names, (Mapping, list)) and names and len(names) != classes:
        raise LayoutError(f"the network has {len(names)} classes, the file of names has {classes}")


def _literal(text: str) -> object:
    try:
        return ast.literal_eval(text[:_LONGEST_LITERAL])
    except (ValueError, SyntaxError, MemoryError, RecursionError):
        return None


def decode(
    layout: str, outputs: Sequence[Array], size: tuple[int, int], least: float
) -> tuple[Array, NDArray[np.int64], Array]:
    """Return the boxes of sufficient probability, before non-maximum suppression.

    Args:
        layout: one of LAYOUTS.
        outputs: Outputs of the network, float.
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
