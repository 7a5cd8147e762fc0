"""The detector with tiny networks, against boxes computed by hand."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from tiny_networks import write_darknet, write_onnx

from xtdrone_perception.detection.detector import Detector, DetectorError, DetectorSettings, load_settings
from xtdrone_perception.detection.output_layouts import LayoutError, find_layout

NAMES = ("human", "car")
SURE = 6.0  # logit


def sigmoid(x: float) -> float:
    return 1.0 / (1.0 + math.exp(-x))


@pytest.fixture
def names(tmp_path: Path) -> Path:
    path = tmp_path / "tiny.names"
    path.write_text("human\ncar\n\n")
    return path


def red_darknet(folder: Path, *, width: int = 96, height: int = 64, extra: str = "") -> tuple[Path, Path]:
    """Write a network with two anchors: a human in a red cell, a (less probable) car in a green one."""
    biases = np.array([0.5, -0.4, 0.2, -0.3, -SURE, SURE, -SURE, 0, 0, 0, 0, -SURE, -SURE, -2.0], float)
    weights = np.zeros((14, 3))
    weights[4, 0] = weights[11, 1] = 2 * SURE
    return write_darknet(folder, width=width, height=height, anchors=[(10, 20), (24, 12)], classes=2,
                         weights=weights, biases=biases, extra=extra)  # fmt: skip


def red_cell_picture() -> np.ndarray:
    picture = np.zeros((64, 96, 3), np.uint8)
    picture[40, 70] = (255, 0, 0)  # cell (2, 1)
    picture[5, 40] = (0, 255, 0)  # cell (1, 0)
    return picture


def check_box(found, box, probability=None, name="human"):
    assert found.name == name
    assert (found.xmin, found.ymin, found.xmax, found.ymax) == pytest.approx(box, abs=1e-3)
    if probability is not None:
        assert found.probability == pytest.approx(probability, abs=1e-5)


def test_darknet_against_its_formula(tmp_path, names):
    cfg, weights = red_darknet(tmp_path)
    detector = Detector(DetectorSettings(weights, cfg, names, confidence=0.05))
    human, car = detector.detect(red_cell_picture())
    assert (detector.settings.width, detector.settings.height, detector.settings.layout) == (96, 64, "darknet")
    x, y = 32 * (2 + sigmoid(0.5)), 32 * (1 + sigmoid(-0.4))
    w, h = 10 * math.exp(0.2), 20 * math.exp(-0.3)
    check_box(human, (x - w / 2, y - h / 2, x + w / 2, min(64, y + h / 2)), sigmoid(SURE) ** 2)
    # Below 0.2, OpenCV's default threshold.
    check_box(car, (48 - 12, 16 - 6, 48 + 12, 16 + 6), sigmoid(SURE) * sigmoid(-2.0), "car")


@pytest.mark.parametrize("extra", ["", "thresh=0.9\n"])
def test_the_confidence_replaces_the_threshold_of_darknet(tmp_path, names, extra):
    cfg, weights = red_darknet(tmp_path, extra=extra)
    for confidence, count in ((0.05, 2), (0.1, 2), (0.5, 1)):
        found = Detector(DetectorSettings(weights, cfg, names, confidence=confidence)).detect(red_cell_picture())
        assert len(found) == count


def test_an_input_size_different_from_the_file(tmp_path, names):
    cfg, weights = red_darknet(tmp_path, width=416, height=416)
    detector = Detector(DetectorSettings(weights, cfg, names, width=96, height=64))
    (human,) = detector.detect(red_cell_picture())
    x, w = 32 * (2 + sigmoid(0.5)), 10 * math.exp(0.2)
    assert (human.xmin, human.xmax) == pytest.approx((x - w / 2, x + w / 2), abs=1e-3)


def test_letterbox_and_stretching(tmp_path, names):
    cfg, weights = red_darknet(tmp_path, width=96, height=96)
    picture = np.zeros((128, 192, 3), np.uint8)  # half as large: 96 x 64, 16 px of grey above and below
    picture[64:, 128:] = (255, 0, 0)
    w, h = 10 * math.exp(0.2), 20 * math.exp(-0.3)

    boxed = Detector(DetectorSettings(weights, cfg, names, nms=1.0)).detect(picture)
    x, y = 32 * (2 + sigmoid(0.5)), 32 * (1 + sigmoid(-0.4))
    upper = min(boxed, key=lambda found: found.ymin)
    check_box(upper, (2 * (x - w / 2), 2 * (y - 16 - h / 2), 2 * (x + w / 2), 2 * (y - 16 + h / 2)))

    stretched = Detector(DetectorSettings(weights, cfg, names, nms=1.0, letterbox=False)).detect(picture)
    upper = min(stretched, key=lambda found: found.ymin)
    check_box(upper, (2 * (x - w / 2), (y - h / 2) / 0.75, 2 * (x + w / 2), (y + h / 2) / 0.75))


ROWS = np.array([[30.0, 20.0, 10.0, 16.0], [31.0, 20.0, 10.0, 16.0], [70.0, 40.0, 8.0, 30.0]])


def onnx_outputs(layout: str) -> dict[str, np.ndarray]:
    """Return two boxes of one human, 0.8 and 0.9, and a car of 0.6, in an input of 96 x 64."""
    human, car = np.array([0.8, 0.9, 0.1]), np.array([0.1, 0.1, 0.6])
    parts = ROWS / [96, 64, 96, 64]
    if layout == "darknet":
        rows = np.column_stack([parts, np.ones(3), human, car])
        return {"a": rows[None, :2], "b": rows[None, 2:]}
    if layout == "yolov4":
        corners = np.hstack([parts[:, :2] - parts[:, 2:] / 2, parts[:, :2] + parts[:, 2:] / 2])
        return {"confs": np.column_stack([human, car])[None], "boxes": corners[None, :, None, :]}
    if layout == "yolov5":
        return {"output0": np.column_stack([ROWS, np.full(3, 0.95), human / 0.95, car / 0.95])[None]}
    return {"output0": np.column_stack([ROWS, human, car]).T[None]}


@pytest.mark.parametrize("layout", ["darknet", "yolov4", "yolov5", "yolov8"])
def test_layouts_of_onnx(tmp_path, names, layout):
    outputs = {name: (value, np.zeros((3, value.size))) for name, value in onnx_outputs(layout).items()}
    path = write_onnx(tmp_path / "tiny.onnx", (96, 64), outputs)
    for asked in (layout,) if layout == "yolov5" else ("auto", layout):  # three rows are no grid of yolov5
        detector = Detector(DetectorSettings(path, None, names, layout=asked, width=96, height=64, confidence=0.3))
        assert detector.settings.layout == layout
        human, car = detector.detect(np.zeros((64, 96, 3), np.uint8))
        check_box(human, (26, 12, 36, 28), 0.9)
        check_box(car, (66, 25, 74, 55), 0.6, "car")


def test_the_input_is_red_green_blue_from_0_to_1(tmp_path, names):
    constant = np.array([[[30.0, 20.0, 10.0, 16.0, 1.0, 0.0, 0.0]]])
    factors = np.zeros((3, 7))
    factors[0, 5], factors[2, 6] = 0.75, 0.5
    path = write_onnx(tmp_path / "tiny.onnx", (64, 32), {"output0": (constant, factors)})
    settings = DetectorSettings(path, None, names, layout="yolov5", width=64, height=32, confidence=0.1)
    detector = Detector(settings)
    (red,) = detector.detect(np.full((32, 64, 3), (255, 0, 0), np.uint8))
    (blue,) = detector.detect(np.full((32, 64, 3), (0, 0, 255), np.uint8))
    assert (red.name, red.probability) == ("human", pytest.approx(0.75))
    assert (blue.name, blue.probability) == ("car", pytest.approx(0.5))
    assert detector.detect(np.full((32, 64, 3), (0, 255, 0), np.uint8)) == []


def test_two_objects_of_different_classes_at_one_place_are_two(tmp_path, names):
    rows = np.array([[[30.0, 20, 10, 16, 1, 0.9, 0.0], [30.0, 20, 10, 16, 1, 0.0, 0.8]]])
    path = write_onnx(tmp_path / "tiny.onnx", (64, 32), {"output0": (rows, np.zeros((3, rows.size)))})
    settings = DetectorSettings(path, None, names, layout="yolov5", width=64, height=32)
    found = Detector(settings).detect(np.zeros((32, 64, 3), np.uint8))
    assert [entry.name for entry in found] == ["human", "car"]


def test_number_of_classes_decides_between_layouts():
    size = (640, 640)
    assert find_layout([(1, 8400, 7)], 2, False, size) == "yolov5"
    assert find_layout([(1, 6, 8400)], 2, False, size) == "yolov8"
    assert find_layout([(1, 25200, 85)], 80, False, size) == "yolov5"
    assert find_layout([(1, 25200, 6)], 1, False, size) == "yolov5"
    assert find_layout([(1, 15120, 6)], 1, False, (640, 384)) == "yolov5"
    assert find_layout([(1, 84, 8400)], 80, False, size) == "yolov8"
    assert find_layout([(1, 5, 8400)], 1, False, size) == "yolov8"
    with pytest.raises(LayoutError, match="seems to have 80"):
        find_layout([(1, 84, 8400)], 2, False, size)
    with pytest.raises(LayoutError, match="seems to have 80"):
        find_layout([(507, 85), (2028, 85)], 1, True, (416, 416))


@pytest.mark.parametrize(
    ("shapes", "classes", "size", "message"),
    [
        ([(1, 300, 6)], 1, (640, 640), "objects that the network has chosen.*nms=False"),  # yolov10, yolo11 with nms
        ([(1, 300, 6)], 80, (640, 640), "objects that the network has chosen"),  # whatever the names
        ([(1, 300, 6)], 1, (160, 128), "objects that the network has chosen"),  # also the number of cells
        ([(1, 1234, 6)], 1, (640, 640), "objects that the network has chosen"),
        ([(100, 7)], 2, (640, 640), "objects that the network has chosen"),  # yolov7 with its own suppression
        ([(1, 1, 100, 7)], 2, (640, 640), "objects that the network has chosen"),  # DetectionOutput of SSD
        ([(1, 300, 7)], 2, (640, 640), "objects that the network has chosen"),  # rotated boxes
        ([(1, 84, 85)], 80, (640, 640), "fit yolov5 and yolov8: give layout"),
        ([(1, 100, 4), (1, 100, 4)], 4, (640, 640), "not certainly yolov4"),
        ([(1, 100, 4), (1, 100, 80)], 80, (640, 640), "not certainly yolov4"),  # DETR: centres and sizes
    ],
)
def test_uncertain_layouts_are_rejected(shapes, classes, size, message):
    with pytest.raises(LayoutError, match=message):
        find_layout(shapes, classes, False, size)


@pytest.mark.parametrize(
    ("layout", "metadata", "message"),
    [
        ("yolov8", {"task": "pose"}, "task 'pose' is not allowed, detect"),
        ("yolov5", {"end2end": "True"}, "end-to-end export"),
        ("yolov8", {"args": "{'nms': True, 'batch': 1}"}, "end-to-end export"),
        ("yolov8", {"names": "{0: 'person', 1: 'car', 2: 'cat'}"}, "the network has 3 classes, the file of names"),
        ("yolov8", {"task": "detect", "names": "{0: 'a', 1: 'b'}", "args": "{'nms': False}", "end2end": "False"}, ""),
        ("yolov8", {"names": "{" * 5000, "args": "\0"}, ""),
    ],
)
def test_metadata_of_onnx_count_for_every_layout(tmp_path, names, layout, metadata, message):
    outputs = {name: (value, np.zeros((3, value.size))) for name, value in onnx_outputs(layout).items()}
    path = write_onnx(tmp_path / "tiny.onnx", (96, 64), outputs, metadata)
    for asked in {"yolov5": (layout,), "yolov8": ("auto", layout)}[layout]:
        settings = DetectorSettings(path, None, names, layout=asked, width=96, height=64)
        if message:
            with pytest.raises(DetectorError, match=message):
                Detector(settings)
        else:
            assert Detector(settings).settings.layout == layout


def test_coordinates_in_another_unit_are_rejected(tmp_path, names):
    pixels, parts = onnx_outputs("yolov8")["output0"], onnx_outputs("darknet")
    scaled = pixels / np.array([96, 64, 96, 64, 1, 1])[None, :, None]
    path = write_onnx(tmp_path / "parts.onnx", (96, 64), {"output0": (scaled, np.zeros((3, scaled.size)))})
    with pytest.raises(DetectorError, match=r"centres up to .* are not of layout yolov8, which has pixels"):
        Detector(DetectorSettings(path, None, names, width=96, height=64))
    rows = {name: (value * 50.0, np.zeros((3, value.size))) for name, value in parts.items()}
    path = write_onnx(tmp_path / "pixels.onnx", (96, 64), rows)
    with pytest.raises(DetectorError, match="which has fractions of the input"):
        Detector(DetectorSettings(path, None, names, width=96, height=64))


def test_settings_file(tmp_path, names):
    cfg, weights = red_darknet(tmp_path)
    path = tmp_path / "tiny.yaml"
    path.write_text("weights: tiny.weights\nconfig: tiny.cfg\nnames: tiny.names\nconfidence: 0.3\nnms: 0.5\n")
    settings = load_settings(path, {"confidence": 0.6})
    assert (settings.weights, settings.config, settings.names) == (weights, cfg, names)
    assert (settings.confidence, settings.nms) == (0.6, 0.5)
    path.write_text("weights: tiny.weights\nconfidenze: 0.3\n")
    with pytest.raises(DetectorError, match="confidenze is unknown"):
        load_settings(path)
    path.write_text("- 1\n")
    with pytest.raises(DetectorError, match="mapping"):
        load_settings(path)
    with pytest.raises(DetectorError, match=r"none\.yaml: No such file"):
        load_settings(tmp_path / "none.yaml")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"width": 100, "height": 64}, "width: 100 is not allowed, a multiple of 32"),
        ({"width": 96}, "both or neither"),
        ({"confidence": 1.5}, "confidence: 1.5"),
        ({"nms": "much"}, "nms: 'much'"),
        ({"threads": 0}, "threads: 0"),
        ({"layout": "yolov1"}, "layout: 'yolov1'"),
        ({"letterbox": "maybe"}, "letterbox: 'maybe'"),
    ],
)
def test_invalid_settings_are_rejected(changes, message):
    with pytest.raises(DetectorError, match=message):
        DetectorSettings(Path("a.weights"), **changes)


def test_unusable_files_are_rejected(tmp_path, names):
    cfg, weights = red_darknet(tmp_path)

    def rejects(message: str, **changes):
        with pytest.raises(DetectorError, match=message):
            Detector(DetectorSettings(**{"weights": weights, "config": cfg, "names": names, **changes}))

    rejects("missing.weights: No such file", weights=tmp_path / "missing.weights")
    rejects("missing.cfg: No such file", config=tmp_path / "missing.cfg")
    rejects("missing.names: No such file", names=tmp_path / "missing.names")
    rejects("needs a darknet .cfg", config=None)
    rejects("names: a file", names=None)
    rejects("a file .weights or .onnx", weights=cfg)
    one = tmp_path / "one.names"
    one.write_text("human\n")
    rejects("seems to have 2", names=one)
    rejects("is not of layout|are not of layout yolov5", layout="yolov5")
    short = tmp_path / "short.weights"
    short.write_bytes(weights.read_bytes()[:-40])
    rejects("short.weights", weights=short)
    huge = tmp_path / "huge.weights"
    with huge.open("wb") as file:
        file.truncate(5 << 30)  # sparse
    rejects("huge.weights: it has 5120.0 MB, at most 2048 MB", weights=huge)
    broken = tmp_path / "broken.cfg"
    broken.write_text("[net]\nwidth=96\nheight=64\nchannels=3\n[dance]\n")
    rejects("broken.cfg", config=broken)
    broken.write_text("hello")
    rejects(r"no section \[net\]", config=broken)
    onnx = tmp_path / "broken.onnx"
    onnx.write_bytes(b"no network")
    rejects("broken.onnx", weights=onnx, width=96, height=64)
    rejects("size must be given", weights=onnx)


@pytest.mark.parametrize(
    "picture", [np.zeros((64, 96), np.uint8), np.zeros((64, 96, 4), np.uint8), np.zeros((64, 96, 3)),
                np.zeros((0, 96, 3), np.uint8), None]
)  # fmt: skip
def test_invalid_pictures_are_rejected(tmp_path, names, picture):
    cfg, weights = red_darknet(tmp_path)
    with pytest.raises(ValueError, match="picture"):
        Detector(DetectorSettings(weights, cfg, names)).detect(picture)
