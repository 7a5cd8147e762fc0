"""Benchmark of the detector: milliseconds of one core a picture of 640 x 360 px, by the size of the network's input.

``python -m xtdrone_perception.benchmark --width 320 416 640`` prints a table; ``--json FILE`` writes it.
"""

from __future__ import annotations

import argparse
import json
import math
import statistics
import time
from pathlib import Path
from typing import Any

import numpy as np

from .detector import STRIDE, Detector, DetectorError, load_settings, settings_file

PICTURE = (640, 360)  # px, as the typhoon's camera has it


def input_height(width: int) -> int:
    """Return the least height, px, that a network's input of a width needs for the whole picture."""
    return STRIDE * math.ceil(width * PICTURE[1] / PICTURE[0] / STRIDE)


def measure(name: str, width: int, seconds: float) -> dict[str, Any]:
    """Return how long a core works on a picture: processor time, which other programs hardly change.

    Args:
        name: of the network, or the path of its settings.
        width: of its input, pixels, a multiple of 32.
        seconds: least time of the measurement, above 0.

    Returns:
        width, height (px), milliseconds (median), pictures.

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


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--detector", default="search", help="name in config/yolo, or path of a .yaml")
    parser.add_argument("--width", type=int, nargs="+", default=[320, 416, 640], help="of the input, px")
    parser.add_argument("--seconds", type=float, default=3.0, help="least time of one measurement, s")
    parser.add_argument("--json", type=Path, help="write the figures here")
    arguments = parser.parse_args()
    if min(arguments.width) < STRIDE or not arguments.seconds > 0.0:
        parser.error(f"width: at least {STRIDE} each; seconds: above 0")
    print(f"{'input':>9} {'ms/picture':>11}")
    results = []
    for width in arguments.width:
        try:
            results.append(measure(arguments.detector, width, arguments.seconds))
        except DetectorError as error:
            parser.error(str(error))
        print(f"{width:4d}x{results[-1]['height']:<4d} {results[-1]['milliseconds']:11.1f}", flush=True)
    if arguments.json:
        arguments.json.write_text(json.dumps(results, indent=1) + "\n")


if __name__ == "__main__":
    main()
