"""Object detection with a YOLO network, run by OpenCV on the CPU.

Loads darknet cfg and weights files, and ONNX files; the layouts of outputs are in ``output_layouts``. No ROS.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import rospkg
from numpy.typing import NDArray

from xtdrone_common.files import ContentError, load_yaml, read_bytes, read_text
from xtdrone_common.settings import SettingError, Settings, setting

from .output_layouts import LAYOUTS, LayoutError, check_layout, check_metadata, check_scale, decode, find_layout

STRIDE = 32  # px of the input per cell of the coarsest grid; input sizes are multiples of it
_GREY = 127  # of the letterbox edges, as in darknet
_LARGEST_FILE = 1 << 31  # bytes; networks for a CPU are far smaller
_METADATA = 14  # field of an ONNX file
_WITH_LENGTH, _FIXED = 2, {1: 8, 5: 4}  # wire types of protobuf: with a length, and bytes of those of a fixed one
_FILES = ("weights", "config", "names")


class DetectorError(ValueError):
    """An unusable network; the message names the file or value and the reason."""


@dataclass(frozen=True)
class Detection:
    """An object in an image.

    Attributes:
        class_id: index of the class, from 0.
        name: Name of the class.
        probability: 0 to 1.
        xmin, ymin, xmax, ymax: px from the left and upper edges, within the image.
    """

    class_id: int
    name: str
    probability: float
    xmin: float
    ymin: float
    xmax: float
    ymax: float


def _check_multiple(size: int) -> None:
    if size % STRIDE:
        raise ValueError(f"a multiple of {STRIDE} px")


@dataclass(frozen=True)
class DetectorSettings(Settings):
    """Settings of a network.

    Attributes:
        weights: ``.weights`` (darknet) or ``.onnx``.
        config: darknet's ``.cfg``; None for ONNX.
        names: file with the names of the classes, one per line, in the network's order.
    """

    weights: Path
    config: Path | None = None
    names: Path | None = None
    layout: str = setting(
        "auto", choices=("auto", *LAYOUTS), text="layout of the outputs; auto derives it from their shapes"
    )
    width: int = setting(
        0, low=0, high=2048, unit="px", check=_check_multiple, text="width of the network's input; 0: from the file"
    )
    height: int = setting(
        0, low=0, high=2048, unit="px", check=_check_multiple, text="height of the network's input; 0: from the file"
    )
    confidence: float = setting(0.5, low=0.01, high=1.0, text="minimum probability of a detection")
    nms: float = setting(
        0.45, low=0.0, high=1.0, text="intersection over union above which two boxes of a class count as one object"
    )
    letterbox: bool = setting(True, text="pad the image with grey edges instead of stretching it")
    threads: int = setting(1, low=1, high=64, text="OpenCV threads of the process")

    def __post_init__(self) -> None:
        """Check everything but the files.

        Raises:
            DetectorError: a value is invalid.
        """
        try:
            super().__post_init__()
        except SettingError as error:
            raise DetectorError(str(error)) from error
        if bool(self.width) != bool(self.height):
            raise DetectorError("width and height: give both or neither")


def settings_file(name: str) -> Path:
    """Return the path of a settings file, given as a path ending in .yaml or as a name in this package's config."""
    path = Path(name).expanduser()
    if path.suffix == ".yaml":
        return path
    return Path(rospkg.RosPack().get_path("xtdrone_perception")) / "config" / "yolo" / f"{name}.yaml"


def load_settings(path: Path, changes: Mapping[str, Any] | None = None) -> DetectorSettings:
    """Load settings from a YAML file with the fields of DetectorSettings.

    Args:
        path: the file; paths in it are relative to its folder.
        changes: entries that replace those of the file; paths are relative to the working directory.

    Raises:
        DetectorError: the file is missing or malformed, or an entry is unknown or invalid.
    """
    try:
        entries = load_yaml(read_text(path))
    except OSError as error:
        raise DetectorError(f"{path}: {error.strerror}") from error
    except ContentError as error:
        raise DetectorError(f"{path}: not YAML: {error}") from error
    if not isinstance(entries, dict):
        raise DetectorError(f"{path}: a mapping of settings is needed")
    return settings_of({**_resolve(entries, path.parent), **_resolve(changes or {}, Path())}, str(path))


def settings_of(entries: Mapping[str, Any], source: str = "detector") -> DetectorSettings:
    """Return settings from their names and values; an empty path counts as none.

    Raises:
        DetectorError: an entry is unknown, missing or invalid.
    """
    known = {field.name for field in fields(DetectorSettings)}
    if unknown := sorted(set(map(str, entries)) - known):
        raise DetectorError(f"{source}: {', '.join(unknown)} is unknown; there are {', '.join(sorted(known))}")
    if not entries.get("weights"):
        raise DetectorError(f"{source}: weights is missing")
    values = {name: value for name, value in entries.items() if name not in _FILES}
    files = {name: Path(str(entries[name])) for name in _FILES if entries.get(name)}
    try:
        return DetectorSettings(**{**values, **files})
    except DetectorError as error:
        raise DetectorError(f"{source}: {error}") from error


def _resolve(entries: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """Return the entries with paths resolved relative to a folder."""
    return {
        name: folder / Path(str(value)).expanduser() if name in _FILES and value else value
        for name, value in entries.items()
    }


def read_names(path: Path) -> tuple[str, ...]:
    """Return the names in a file, one per line; empty lines are ignored.

    Raises:
        DetectorError: the file is missing or empty.
    """
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise DetectorError(f"names: {path}: {getattr(error, 'strerror', None) or error}") from error
    names = tuple(line.strip() for line in lines if line.strip())
    if not names:
        raise DetectorError(f"names: {path} has no names")
    return names


class Detector:
    """A network that detects objects, one image at a time.

    Attributes:
        names: Names of the classes.
        settings: as given, with the layout and input size filled in.
    """

    def __init__(self, settings: DetectorSettings) -> None:
        """Load the network and run it once.

        Raises:
            DetectorError: a file is missing or malformed, or the outputs match no layout.
        """
        if settings.names is None:
            raise DetectorError("names: a file with the class names is needed")
        self.names = read_names(settings.names)
        cv2.setNumThreads(int(settings.threads))
        darknet = settings.weights.suffix == ".weights"
        metadata: dict[str, str] = {}
        if darknet:
            self._network, size = _read_darknet(settings)
        else:
            self._network, size, metadata = _read_onnx(settings)
        self._outputs = self._network.getUnconnectedOutLayersNames()
        self._size = (settings.width or size[0], settings.height or size[1])
        blank = self._run(np.zeros((self._size[1], self._size[0], 3), np.uint8))
        shapes = [output.shape for output in blank]
        try:
            check_metadata(metadata, len(self.names))
            if settings.layout == "auto":
                layout = find_layout(shapes, len(self.names), darknet, self._size)
                if not darknet:
                    check_scale(layout, [output.astype(float) for output in blank])
            else:
                layout = settings.layout
                check_layout(layout, shapes, len(self.names))
        except LayoutError as error:
            raise DetectorError(f"{settings.weights}: {error} ({settings.names})") from error
        self.settings = replace(settings, layout=layout, width=self._size[0], height=self._size[1])

    def detect(self, rgb: NDArray[np.uint8]) -> list[Detection]:
        """Return the objects in an image, the most probable first.

        Args:
            rgb: (height, width, 3), uint8.

        Raises:
            ValueError: wrong shape or type of the array.
        """
        if not isinstance(rgb, np.ndarray) or rgb.ndim != 3 or rgb.shape[2] != 3 or rgb.dtype != np.uint8:
            given = f"{rgb.dtype} of shape {rgb.shape}" if isinstance(rgb, np.ndarray) else type(rgb).__name__
            raise ValueError(f"picture: {given} is not allowed, uint8 of shape (height, width, 3) is needed")
        if not rgb.size:
            raise ValueError(f"picture: shape {rgb.shape} is empty")
        picture, scale, offset = self._fit_picture(rgb)
        outputs = [output.astype(float) for output in self._run(picture)]
        corners, classes, probabilities = decode(self.settings.layout, outputs, self._size, self.settings.confidence)
        return self._choose_objects(
            (corners - np.tile(offset, 2)) / np.tile(scale, 2), classes, probabilities, rgb.shape
        )

    def _run(self, picture: NDArray[Any]) -> list[NDArray[np.float32]]:
        """Return the outputs for an image of the input's size."""
        self._network.setInput(cv2.dnn.blobFromImage(picture, 1.0 / 255.0))
        try:
            return list(self._network.forward(self._outputs))
        except cv2.error as error:
            raise DetectorError(
                f"the network does not run with an input of {self._size[0]}x{self._size[1]} px: {_reason(error)}"
            ) from error

    def _fit_picture(self, rgb: NDArray[np.uint8]) -> tuple[NDArray[Any], tuple[float, float], tuple[float, float]]:
        """Return the image at the input's size, with its scale and offset there, (x, y) each."""
        height, width = rgb.shape[:2]
        to_width, to_height = self._size
        if not self.settings.letterbox:
            return cv2.resize(rgb, self._size), (to_width / width, to_height / height), (0.0, 0.0)
        ratio = min(to_width / width, to_height / height)
        inner = (max(1, round(width * ratio)), max(1, round(height * ratio)))
        left, top = (to_width - inner[0]) // 2, (to_height - inner[1]) // 2
        picture = np.full((to_height, to_width, 3), _GREY, np.uint8)
        picture[top : top + inner[1], left : left + inner[0]] = (
            rgb if inner == (width, height) else cv2.resize(rgb, inner)
        )
        return picture, (inner[0] / width, inner[1] / height), (float(left), float(top))

    def _choose_objects(
        self,
        corners: NDArray[np.float64],
        classes: NDArray[np.int64],
        probabilities: NDArray[np.float64],
        shape: Sequence[int],
    ) -> list[Detection]:
        """Return one detection per object, clipped to the image."""
        limits = np.array([shape[1], shape[0], shape[1], shape[0]], float)
        corners = np.clip(corners, 0.0, limits)
        whole = np.flatnonzero((corners[:, 2] > corners[:, 0]) & (corners[:, 3] > corners[:, 1]))
        corners, classes, probabilities = corners[whole], classes[whole], probabilities[whole]
        boxes = np.hstack([corners[:, :2], corners[:, 2:] - corners[:, :2]])
        kept = cv2.dnn.NMSBoxesBatched(
            boxes.tolist(), probabilities.tolist(), classes.tolist(), self.settings.confidence, self.settings.nms
        )
        found = [
            Detection(int(classes[i]), self.names[classes[i]], float(probabilities[i]), *map(float, corners[i]))
            for i in np.asarray(kept, int).reshape(-1)
        ]
        return sorted(found, key=lambda entry: -entry.probability)


def _read_darknet(settings: DetectorSettings) -> tuple[Any, tuple[int, int]]:
    """Return a network from darknet files and the size of its input."""
    if settings.config is None:
        raise DetectorError(f"config: {settings.weights} needs a darknet .cfg file")
    try:
        text = _read(settings.config).decode("utf-8")
    except UnicodeDecodeError as error:
        raise DetectorError(f"config: {settings.config} is not text") from error
    size = _darknet_size(text, settings.config)
    if settings.width:
        text = _with_entry(text, r"net(?:work)?", "width", settings.width)
        text = _with_entry(text, r"net(?:work)?", "height", settings.height)
    # OpenCV drops boxes below the region layers' own threshold, which defaults to 0.2.
    text = _with_entry(text, "yolo|region", "thresh", settings.confidence)
    weights = _read(settings.weights)
    try:
        network = cv2.dnn.readNetFromDarknet(np.frombuffer(text.encode(), np.uint8), np.frombuffer(weights, np.uint8))
    except cv2.error as error:
        raise DetectorError(f"{settings.config} and {settings.weights}: {_reason(error)}") from error
    _check_length(network, weights, settings)
    return _on_cpu(network), size


def _check_length(network: Any, weights: bytes, settings: DetectorSettings) -> None:
    """Check the number of darknet weights against the configuration, which OpenCV does not.

    Raises:
        DetectorError: they differ.
    """
    layers = [network.getLayer(network.getLayerId(name)) for name in network.getLayerNames()]
    needed = sum(blob.size for layer in layers if layer.type in ("Convolution", "BatchNorm") for blob in layer.blobs)
    major, minor = struct.unpack_from("<ii", weights.ljust(8, b"\0"))
    present = (len(weights) - (20 if 10 * major + minor >= 2 else 16)) // 4
    if present != needed:
        raise DetectorError(
            f"{settings.weights} has {max(present, 0)} weights, {settings.config} needs {needed}: they do not match"
        )


def _darknet_size(text: str, path: Path) -> tuple[int, int]:
    """Return the input width and height of a darknet configuration."""
    section = re.search(r"^\s*\[net(?:work)?\]([^\[]*)", text, re.MULTILINE)
    found = {
        name: re.search(rf"^\s*{name}\s*=\s*(\d+)", section[1], re.MULTILINE) if section else None
        for name in ("width", "height")
    }
    if found["width"] is None or found["height"] is None:
        raise DetectorError(f"config: {path} has no section [net] with width and height")
    return int(found["width"][1]), int(found["height"][1])


def _with_entry(text: str, section: str, name: str, value: float) -> str:
    """Return a darknet configuration with an entry set in all sections of a kind."""

    def entered(match: re.Match[str]) -> str:
        body = re.sub(rf"^\s*{name}\s*=.*\n?", "", match[2], flags=re.MULTILINE)
        return f"{match[1]}\n{name}={value}{body if body.startswith(chr(10)) else chr(10) + body}"

    return re.sub(rf"^(\s*\[(?:{section})\])([^\[]*)", entered, text, flags=re.MULTILINE)


def _read_onnx(settings: DetectorSettings) -> tuple[Any, tuple[int, int], dict[str, str]]:
    """Return a network from an ONNX file, the size of its input, and its metadata."""
    if settings.weights.suffix != ".onnx":
        raise DetectorError(f"weights: {settings.weights} is not allowed, a file .weights or .onnx")
    if not settings.width:
        raise DetectorError(f"width and height: {settings.weights} is ONNX; its input size must be given")
    content = _read(settings.weights)
    try:
        network = cv2.dnn.readNetFromONNX(np.frombuffer(content, np.uint8))
    except cv2.error as error:
        raise DetectorError(f"{settings.weights}: {_reason(error)}") from error
    return _on_cpu(network), (settings.width, settings.height), onnx_metadata(content)


def onnx_metadata(content: bytes) -> dict[str, str]:
    """Return the texts of ``metadata_props`` in an ONNX file by name; what is damaged is left out.

    onnx.proto: field 14 of ModelProto, with the key in field 1 and the value in field 2.
    """
    pairs = [dict(_protobuf_fields(entry)) for number, entry in _protobuf_fields(content) if number == _METADATA]
    texts = [(pair[1], pair[2]) for pair in pairs if 1 in pair and 2 in pair]
    return {name.decode("utf-8", "replace"): text.decode("utf-8", "replace") for name, text in texts}


def _protobuf_fields(content: bytes) -> Iterator[tuple[int, bytes]]:
    """Yield number and content of the fields of a protobuf message that have a length, up to the first damaged one."""
    at = 0
    while at < len(content):
        key, at = _varint(content, at)
        if key & 7 == _WITH_LENGTH:
            length, at = _varint(content, at)
            if at + length > len(content):
                return
            yield key >> 3, content[at : at + length]
            at += length
        elif key & 7 == 0:
            _, at = _varint(content, at)
        elif key & 7 in _FIXED:
            at += _FIXED[key & 7]
        else:
            return


def _varint(content: bytes, at: int) -> tuple[int, int]:
    """Return the number that begins at a byte, and the byte after it."""
    value = 0
    for shift, byte in enumerate(content[at : at + 10]):
        value |= (byte & 127) << 7 * shift
        if byte < 128:
            return value, at + shift + 1
    return value, len(content)


def _on_cpu(network: Any) -> Any:
    network.setPreferableBackend(cv2.dnn.DNN_BACKEND_OPENCV)
    network.setPreferableTarget(cv2.dnn.DNN_TARGET_CPU)
    return network


def _read(path: Path) -> bytes:
    """Return the content of a file.

    Raises:
        DetectorError: the file cannot be read, is empty or too large.
    """
    try:
        content = read_bytes(path, _LARGEST_FILE)
    except OSError as error:
        raise DetectorError(f"{path}: {error.strerror}") from error
    if not content:
        raise DetectorError(f"{path} is empty")
    return content


def _reason(error: cv2.error) -> str:
    """Return OpenCV's message as one line."""
    return " ".join(str(getattr(error, "err", "") or error).split())
