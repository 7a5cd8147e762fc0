#!/usr/bin/env python3
"""Finds a detector's false positives in its training images, to train on these places more often.

    find_false_positives.py DATA/train --weights RUN/last.weights

Writes DATA/train/hard.json, which train.py reads, also while it runs. Runs in `./xtdrone shell`.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np
from evaluate import SETTINGS, detector_of
from pictures import read_labels, read_picture

from xtdrone_perception.detection.scoring import overlaps


def main() -> None:
    """Search all images."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="folder written by make_data.py")
    parser.add_argument("--settings", type=Path, default=SETTINGS)
    parser.add_argument("--weights", type=Path, help="weights that replace those of the settings")
    parser.add_argument("--threshold", type=float, default=0.25, help="probability threshold (%(default)s)")
    parser.add_argument("--every", type=int, default=1, help="process every N-th image (%(default)s)")
    options = parser.parse_args()
    detector = detector_of(options.settings, options.weights, options.threshold)
    hard = []
    for label in read_labels(options.folder)[:: options.every]:
        picture = read_picture(options.folder, label)
        for found in detector.detect(picture.image):
            box = np.array([[found.xmin, found.ymin, found.xmax, found.ymax]])
            union, own = overlaps(box, picture.boxes)
            if not len(picture.boxes) or max(union.max(), own.max()) < 0.2:
                hard.append((picture.name, 0.5 * (found.xmin + found.xmax), 0.5 * (found.ymin + found.ymax)))
    (options.folder / "hard.json").write_text(json.dumps(hard) + "\n")
    print(f"{len(hard)} places")


if __name__ == "__main__":
    main()
