"""Tiny networks with known outputs, written to files: darknet's, and ONNX by hand."""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

CELL = 32


def write_darknet(
    folder: Path,
    *,
    width: int,
    height: int,
    anchors: Sequence[tuple[int, int]],
    classes: int,
    weights: np.ndarray,
    biases: np.ndarray,
    extra: str = "",
) -> tuple[Path, Path]:
    """Write a network: five times the greatest of 2 x 2, then a convolution 1 x 1, then boxes; return cfg and weights.

    Args:
        folder: output folder.
        width, height: of the input, px.
        anchors: boxes' sizes, px; A of them.
        classes: C.
        weights: (A * (5 + C), 3): of red, green, blue (0 to 1) of a cell.
        biases: (A * (5 + C)).
        extra: additional lines in the section of the boxes.
    """
    pairs = ", ".join(f"{w},{h}" for w, h in anchors)
    mask = ",".join(map(str, range(len(anchors))))
    text = f"[net]\nwidth={width}\nheight={height}\nchannels=3\n\n" + "[maxpool]\nsize=2\nstride=2\n\n" * 5
    text += f"[convolutional]\nsize=1\nstride=1\npad=1\nfilters={len(biases)}\nactivation=linear\n\n"
    text += f"[yolo]\nmask={mask}\nanchors={pairs}\nclasses={classes}\nnum={len(anchors)}\n{extra}\n"
    cfg, path = folder / "tiny.cfg", folder / "tiny.weights"
    cfg.write_text(text)
    header = struct.pack("<iiiq", 0, 2, 0, 0)
    path.write_bytes(header + biases.astype("<f4").tobytes() + weights.astype("<f4").tobytes())
    return cfg, path


def write_onnx(
    path: Path,
    size: tuple[int, int],
    outputs: Mapping[str, tuple[np.ndarray, np.ndarray]],
    metadata: Mapping[str, str] | None = None,
) -> Path:
    """Write a network whose outputs are constants plus the picture's mean colour (0 to 1) times factors.

    Args:
        path: output file.
        size: (width, height) of the input, px.
        outputs: by name: the constants, and the factors of red, green, blue, with an axis of 3 before theirs.
        metadata: texts by name.
    """
    nodes = [_node("GlobalAveragePool", ["picture"], "mean"), _node("Flatten", ["mean"], "colour")]
    constants, infos = [], []
    for name, (constant, factors) in outputs.items():
        constants += [
            _tensor(f"{name}_factors", factors.reshape(3, -1).astype("<f4"), 1),
            _tensor(f"{name}_constant", constant.reshape(1, -1).astype("<f4"), 1),
            _tensor(f"{name}_shape", np.array(constant.shape, "<i8"), 7),
        ]
        nodes += [
            _node("MatMul", ["colour", f"{name}_factors"], f"{name}_coloured"),
            _node("Add", [f"{name}_coloured", f"{name}_constant"], f"{name}_flat"),
            _node("Reshape", [f"{name}_flat", f"{name}_shape"], name),
        ]
        infos.append(_info(name, constant.shape))
    graph = b"".join(
        [
            *(_field(1, node) for node in nodes),
            _field(2, b"tiny"),
            *(_field(5, constant) for constant in constants),
            _field(11, _info("picture", (1, 3, size[1], size[0]))),
            *(_field(12, info) for info in infos),
        ]
    )
    entries = [_field(1, key.encode()) + _field(2, value.encode()) for key, value in (metadata or {}).items()]
    properties = b"".join(_field(14, entry) for entry in entries)
    path.write_bytes(_number(1, 7) + _field(7, graph) + _field(8, _number(2, 12)) + properties)
    return path


def _varint(value: int) -> bytes:
    found = b""
    while value >= 128:
        found += bytes([value & 127 | 128])
        value >>= 7
    return found + bytes([value])


def _number(field: int, value: int) -> bytes:
    return _varint(field << 3) + _varint(value)


def _field(field: int, content: bytes) -> bytes:
    return _varint(field << 3 | 2) + _varint(len(content)) + content


def _node(kind: str, inputs: Sequence[str], output: str) -> bytes:
    fields = [_field(1, name.encode()) for name in inputs]
    return b"".join([*fields, _field(2, output.encode()), _field(3, output.encode()), _field(4, kind.encode())])


def _tensor(name: str, values: np.ndarray, kind: int) -> bytes:
    dims = b"".join(_number(1, length) for length in values.shape)
    return dims + _number(2, kind) + _field(8, name.encode()) + _field(9, values.tobytes())


def _info(name: str, shape: Sequence[int]) -> bytes:
    dims = b"".join(_field(1, _number(1, length)) for length in shape)
    tensor = _number(1, 1) + _field(2, dims)
    return _field(1, name.encode()) + _field(2, _field(1, tensor))
