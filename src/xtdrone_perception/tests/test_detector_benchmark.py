"""The benchmark of the detector with a network of a few numbers."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from tiny_networks import write_darknet

from xtdrone_perception.benchmark import input_height, measure


def test_a_picture_of_640_by_360_fits_into_each_input():
    assert [input_height(width) for width in (320, 416, 640)] == [192, 256, 384]


def test_it_measures_at_the_size_asked_for(tmp_path: Path):
    write_darknet(tmp_path, width=640, height=384, anchors=[(8, 12)], classes=1,
                  weights=np.zeros((6, 3)), biases=np.zeros(6))  # fmt: skip
    (tmp_path / "tiny.names").write_text("human\n")
    settings = tmp_path / "tiny.yaml"
    settings.write_text("weights: tiny.weights\nconfig: tiny.cfg\nnames: tiny.names\n")
    found = measure(str(settings), 320, 0.01)
    assert (found["width"], found["height"]) == (320, 192)
    assert found["milliseconds"] > 0.0
    assert found["pictures"] >= 1
