"""The network that comes with the package, on a few pictures of scenes and people that it was not trained on."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from xtdrone_perception.detector import Detection, Detector, load_settings
from xtdrone_perception.scoring import overlaps

PACKAGE = Path(__file__).resolve().parents[1]
PICTURES = Path(__file__).resolve().parent / "pictures"
PEOPLE: dict[str, dict[str, list[list[float]]]] = json.loads((PICTURES / "people.json").read_text())


@pytest.fixture(scope="module")
def detector() -> Detector:
    return Detector(load_settings(PACKAGE / "config/yolo/search.yaml", {"confidence": 0.45}))


def look(detector: Detector, name: str) -> list[Detection]:
    image = cv2.imread(str(PICTURES / name))
    assert image is not None
    assert image.shape == (360, 640, 3)
    return detector.detect(np.ascontiguousarray(image[:, :, ::-1]))


def boxes_of(found: list[Detection]) -> np.ndarray:
    return np.array([[d.xmin, d.ymin, d.xmax, d.ymax] for d in found], float).reshape(-1, 4)


@pytest.mark.parametrize("name", sorted(PEOPLE))
def test_finds_those_who_are_there_and_nobody_else(detector: Detector, name: str):
    certain = np.array(PEOPLE[name]["certain"], float).reshape(-1, 4)
    everybody = np.concatenate([certain, np.array(PEOPLE[name]["others"], float).reshape(-1, 4)])
    found = boxes_of(look(detector, name))
    union, _ = overlaps(everybody, found)
    assert (union[: len(certain)].max(axis=1, initial=0.0) >= 0.5).all()
    assert (union.max(axis=0, initial=0.0) >= 0.3).all()


def test_pictures_show_people_and_nobody():
    assert sum(len(people["certain"]) for people in PEOPLE.values()) >= 12
    assert any(not people["certain"] + people["others"] for people in PEOPLE.values())


def test_size_and_names(detector: Detector):
    assert (detector.settings.width, detector.settings.height) == (640, 384)
    assert detector.names == ("human",)
    assert (PACKAGE / "config/yolo/search.weights").stat().st_size < 20e6
