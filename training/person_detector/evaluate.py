#!/usr/bin/env python3
"""Quality of a detector: precision, recall and average precision on images of make_data.py.

    evaluate.py DATA/test
    evaluate.py DATA/test --weights RUN/last.weights --threshold 0.4 --out result.json

The detector runs as in flight, in OpenCV with darknet's files. People lower than 12 px or hidden by more than 60 %
count as neither found nor false. Runs in `./xtdrone shell`.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from xtdrone_perception.detection.detector import Detector, load_settings
from xtdrone_perception.detection.scoring import LabelledPicture, at_threshold, average_precision, best_threshold, match

SETTINGS = Path(__file__).resolve().parents[2] / "src/xtdrone_perception/config/yolo/search.yaml"
LOWEST = 12.0  # px
HIDDEN = 0.6
LEAST = 0.01  # minimum probability of the evaluated boxes
BANDS = ((12.0, 20.0), (20.0, 40.0), (40.0, math.inf), (12.0, math.inf))


def detector_of(settings: Path, weights: Path | None, confidence: float | None) -> Detector:
    """Return the detector of a settings file, with other weights or another minimum probability if given."""
    changes: dict[str, Any] = {}
    if weights is not None:
        changes["weights"] = str(weights)
    if confidence is not None:
        changes["confidence"] = confidence
    return Detector(load_settings(settings, changes))


def looked_at(detector: Detector, folder: Path, most: int) -> tuple[list[LabelledPicture], list[bool], float]:
    """Return the detections in a folder's images, a mask of those without people, and the median time, s."""
    labels = [json.loads(line) for line in (folder / "labels.jsonl").read_text().splitlines()][:most]
    scenes, empty, times = [], [], []
    for label in labels:
        image = cv2.imread(str(folder / label["file"]))
        if image is None:
            raise OSError(f"{folder / label['file']}: no image")
        begun = time.process_time()
        found = detector.detect(np.ascontiguousarray(image[:, :, ::-1]))
        times.append(time.process_time() - begun)
        boxes = np.array([[d.xmin, d.ymin, d.xmax, d.ymax] for d in found], float).reshape(-1, 4)
        truth = np.array([person["box"] for person in label["people"]], float).reshape(-1, 4)
        seen = np.array([person["visible"] >= 1.0 - HIDDEN for person in label["people"]], bool)
        counts = seen & (truth[:, 3] - truth[:, 1] >= LOWEST)
        scenes.append(LabelledPicture(boxes, np.array([d.probability for d in found], float), truth, counts))
        empty.append(not label["people"])
    return scenes, empty, float(np.median(times))


def judged(scenes: list[LabelledPicture], empty: list[bool], threshold: float | None) -> dict[str, Any]:
    """Return the metrics by height of the people, at the given threshold or the best one."""
    every = match(scenes, heights=BANDS[-1])
    best = best_threshold(every)
    used = best if threshold is None else threshold
    result: dict[str, Any] = {"pictures": len(scenes), "best_threshold": best, "threshold": used, "sizes": {}}
    for low, high in BANDS:
        matches = match(scenes, heights=(low, high))
        precision, recall, _ = at_threshold(matches, used)
        name = f"{low:g} to {high:g} px" if math.isfinite(high) else f"{low:g} px and more"
        result["sizes"][name] = {
            "people": matches.there,
            "AP50": average_precision(matches),
            "precision": precision,
            "recall": recall,
        }
    alone = [scene for scene, none in zip(scenes, empty, strict=True) if none]
    false = sum(int((scene.scores >= used).sum()) for scene in alone)
    result["pictures_without_people"] = len(alone)
    result["false_boxes_in_them"] = false
    return result


def table(result: dict[str, Any]) -> str:
    """Return the metrics as a table."""
    lines = ["| height of the person | people | AP50 | precision | recall |", "|---|---|---|---|---|"]
    for name, row in result["sizes"].items():
        lines.append(f"| {name} | {row['people']} | {row['AP50']:.3f} | {row['precision']:.3f} | {row['recall']:.3f} |")
    lines.append("")
    lines.append(
        f"{result['pictures']} images; precision and recall at probability {result['threshold']:.3f} (best "
        f"{result['best_threshold']:.3f}); {result['false_boxes_in_them']} false boxes in "
        f"{result['pictures_without_people']} images without people"
    )
    return "\n".join(lines)


def main() -> None:
    """Evaluate."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="folder written by make_data.py")
    parser.add_argument("--settings", type=Path, default=SETTINGS, help="settings file of the detector (%(default)s)")
    parser.add_argument("--weights", type=Path, help="weights that replace those of the settings")
    parser.add_argument(
        "--threshold", type=float, help="probability threshold for precision and recall (default: the best)"
    )
    parser.add_argument("--most", type=int, default=100_000, help="maximum number of images")
    parser.add_argument("--out", type=Path, help="JSON file to write")
    options = parser.parse_args()
    detector = detector_of(options.settings, options.weights, LEAST)
    scenes, empty, seconds = looked_at(detector, options.folder, options.most)
    result = judged(scenes, empty, options.threshold)
    result["ms_per_picture"] = 1e3 * seconds
    print(table(result))
    print(f"{1e3 * seconds:.1f} ms of processor time per image")
    if options.out:
        options.out.write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()
