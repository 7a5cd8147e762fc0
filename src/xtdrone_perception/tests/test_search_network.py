"""The shipped network, on pictures of scenes and people it was not trained on."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from xtdrone_perception.detection.detector import Detector, load_settings
from xtdrone_perception.detection.scoring import LabelledPicture, at_threshold, average_precision, match

PACKAGE = Path(__file__).resolve().parents[1]
PICTURES = Path(__file__).resolve().parent / "pictures"
PEOPLE: dict[str, dict[str, list[list[float]]]] = json.loads((PICTURES / "people.json").read_text())


@pytest.fixture(scope="module")
def detector() -> Detector:
    return Detector(load_settings(PACKAGE / "config/yolo/search.yaml", {"confidence": 0.02}))


def look(detector: Detector, name: str) -> LabelledPicture:
    """Return the detected and the true boxes of a picture."""
    image = cv2.imread(str(PICTURES / name))
    assert image is not None
    assert image.shape == (360, 640, 3)
    found = detector.detect(np.ascontiguousarray(image[:, :, ::-1]))
    certain, others = PEOPLE[name]["certain"], PEOPLE[name]["others"]
    return LabelledPicture(
        np.array([[d.xmin, d.ymin, d.xmax, d.ymax] for d in found], float).reshape(-1, 4),
        np.array([d.probability for d in found], float),
        np.array(certain + others, float).reshape(-1, 4),
        np.arange(len(certain) + len(others)) < len(certain),
    )


def test_detects_people_and_little_else(detector: Detector):
    """The pictures are the first of each of eight scenes; AP50 of the test split is 0.97 (training/person_detector)."""
    matches = match([look(detector, name) for name in PEOPLE])
    assert matches.there == 58
    assert average_precision(matches) > 0.9
    precision, recall, _ = at_threshold(matches, detector_threshold())
    assert precision > 0.8
    assert recall > 0.8


def detector_threshold() -> float:
    """Return the least probability of the shipped detector."""
    return load_settings(PACKAGE / "config/yolo/search.yaml", {}).confidence


def test_size_and_names(detector: Detector):
    assert (detector.settings.width, detector.settings.height) == (640, 384)
    assert detector.names == ("human",)
    assert (PACKAGE / "config/yolo/search.weights").stat().st_size < 20e6
