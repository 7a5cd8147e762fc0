"""Benchmark of the detector: milliseconds of one core per image of 640 x 360 px, by the size of the network's input.

``python -m benchmarks.programs.detector --width 320 416 640`` prints a table; ``--json FILE`` writes it.
"""

from __future__ import annotations

import argparse
import math
import statistics
import sys
import time
from collections.abc import Iterator
from typing import Any

import numpy as np

from benchmarks.programs.program_frame import Column, Row, run
from xtdrone_perception.detection.detector import STRIDE, Detector, DetectorError, load_settings, settings_file

PICTURE = (640, 360)  # px, as the typhoon's camera has it


def input_height(width: int) -> int:
    """Return the minimum height of a network's input, px, that fits the whole image at a width."""
    return STRIDE * math.ceil(width * PICTURE[1] / PICTURE[0] / STRIDE)


def measure(name: str, width: int, seconds: float) -> dict[str, Any]:
    """Measure the processor time of an image on one core, which is hardly affected by other programs.

    Args:
        name: of the network, or the path of its settings.
        width: of its input, pixels, a multiple of 32.
        seconds: minimum time of the measurement, above 0.

    Returns:
        width, height (px), milliseconds (median), images.

    Raises:
        DetectorError: the network cannot be used.
    """
    changes = {"width": width, "height": input_height(width), "threads": 1}
    detector = Detector(load_settings(settings_file(name), changes))
    rgb = np.random.default_rng(0).integers(0, 256, (PICTURE[1], PICTURE[0], 3), np.uint8)
    detector.detect(rgb)
    times: list[float] = []
    while sum(times) < seconds:
        began = time.process_time()
        detector.detect(rgb)
        times.append(time.process_time() - began)
    milliseconds = 1e3 * statistics.median(times)
    return {"width": width, "height": changes["height"], "milliseconds": milliseconds, "pictures": len(times)}


COLUMNS = (Column("input", "{width}x{height}"), Column("ms/picture", "{milliseconds:.1f}"))


def main() -> int:
    """Measure the input widths of the command line and return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--detector", default="search", help="name in config/yolo, or path of a .yaml")
    parser.add_argument("--width", type=int, nargs="+", default=[320, 416, 640], help="of the input, px")
    parser.add_argument("--seconds", type=float, default=3.0, help="minimum time of one measurement, s")
    return run(parser, _cases, COLUMNS, (DetectorError,))


def _cases(arguments: argparse.Namespace) -> Iterator[Row]:
    if min(arguments.width) < STRIDE or not arguments.seconds > 0.0:
        raise ValueError(f"width: at least {STRIDE} each; seconds: above 0")
    for width in arguments.width:
        yield measure(arguments.detector, width, arguments.seconds)


if __name__ == "__main__":
    sys.exit(main())
