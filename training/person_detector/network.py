"""A network described by a darknet .cfg, in torch: the trained network is the one that OpenCV reads.

Supports the darknet layers used by the detectors: convolutional, maxpool, upsample, shortcut, route, yolo.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import nn

Section = dict[str, str]


def read_cfg(path: Path) -> list[tuple[str, Section]]:
    """Return the sections of a .cfg in order: (kind, settings); the first is ("net", ...).

    Raises:
        ValueError: a line is neither a section nor a setting.
    """
    sections: list[tuple[str, Section]] = []
    for number, line in enumerate(Path(path).read_text().splitlines(), 1):
        line = line.split("#")[0].strip()
        if not line:
            continue
        if line.startswith("[") and line.endswith("]"):
            sections.append((line[1:-1], {}))
        elif "=" in line and sections:
            key, value = line.split("=", 1)
            sections[-1][1][key.strip()] = value.strip()
        else:
            raise ValueError(f"{path}:{number}: {line!r} is neither [section] nor key=value")
    return sections


@dataclass(frozen=True)
class Head:
    """One yolo layer.

    Attributes:
        stride: image pixels per cell.
        anchors: (n, 2) width and height, pixels.
        scale: scale_x_y of darknet: how far a cell's centre may reach, 1 is just the cell.
    """

    stride: int
    anchors: torch.Tensor
    scale: float


class Darknet(nn.Module):
    """The network; gives the raw outputs of its yolo layers, each (batch, anchors, height, width, 5 + classes)."""

    def __init__(self, cfg: Path):
        super().__init__()
        self.sections = read_cfg(cfg)
        self.classes = 1
        self.layers = nn.ModuleList()
        self.kept: set[int] = set()
        self.heads: list[Head] = []
        channels: list[int] = []
        strides: list[int] = []
        last, stride = 3, 1
        for index, (kind, get) in enumerate(self.sections[1:]):
            layer: nn.Module = nn.Identity()
            if kind == "convolutional":
                layer = _convolution(last, get)
                last, stride = int(get["filters"]), stride * int(get.get("stride", 1))
            elif kind == "maxpool":
                size = int(get["size"])
                layer = nn.MaxPool2d(size, int(get["stride"]), size // 2 if size % 2 else 0)
                stride *= int(get["stride"])
            elif kind == "upsample":
                layer = nn.Upsample(scale_factor=int(get["stride"]), mode="nearest")
                stride //= int(get["stride"])
            elif kind == "route":
                places = self._places(index, get["layers"])
                last, stride = sum(channels[place] for place in places), strides[places[0]]
            elif kind == "shortcut":
                self._places(index, get["from"])
            elif kind == "yolo":
                values = [float(v) for v in get["anchors"].split(",")]
                every = torch.tensor(values).reshape(-1, 2)
                chosen = every[[int(i) for i in get["mask"].split(",")]]
                self.classes = int(get["classes"])
                self.heads.append(Head(stride, chosen, float(get.get("scale_x_y", 1.0))))
            else:
                raise ValueError(f"{cfg}: [{kind}] is not supported")
            self.layers.append(layer)
            channels.append(last)
            strides.append(stride)

    def _places(self, index: int, text: str) -> list[int]:
        places = [int(v) for v in text.split(",")]
        places = [index + place if place < 0 else place for place in places]
        self.kept.update(places)
        return places

    def forward(self, x: torch.Tensor) -> list[torch.Tensor]:
        """Return the heads' raw outputs for images (batch, 3, height, width), RGB, 0..1."""
        kept: dict[int, torch.Tensor] = {}
        found = []
        for index, (kind, get) in enumerate(self.sections[1:]):
            if kind == "route":
                parts = [kept[place] for place in self._places(index, get["layers"])]
                x = torch.cat(parts, 1) if len(parts) > 1 else parts[0]
            elif kind == "shortcut":
                x = x + kept[self._places(index, get["from"])[0]]
            elif kind == "yolo":
                anchors = len(self.heads[len(found)].anchors)
                batch, _, height, width = x.shape
                found.append(x.reshape(batch, anchors, -1, height, width).permute(0, 1, 3, 4, 2))
            else:
                x = self.layers[index](x)
            if index in self.kept:
                kept[index] = x
        return found

    def convolutions(self) -> list[nn.Sequential]:
        """Return the convolutional layers in darknet's order."""
        return [
            layer
            for layer, (kind, _) in zip(self.layers, self.sections[1:], strict=True)
            if kind == "convolutional" and isinstance(layer, nn.Sequential)
        ]

    def outputs(self) -> list[nn.Conv2d]:
        """Return the convolutions before the yolo layers."""
        return [layer[0] for layer in self.convolutions() if len(layer) == 1 and isinstance(layer[0], nn.Conv2d)]


def _convolution(channels: int, get: Section) -> nn.Sequential:
    size, filters = int(get["size"]), int(get["filters"])
    normalised = get.get("batch_normalize", "0") == "1"
    padding = size // 2 if get.get("pad", "0") == "1" else 0
    parts: list[nn.Module] = [
        nn.Conv2d(channels, filters, size, int(get.get("stride", 1)), padding, bias=not normalised)
    ]
    if normalised:
        parts.append(nn.BatchNorm2d(filters, eps=1e-6, momentum=0.03))
    activation = get.get("activation", "linear")
    if activation == "leaky":
        parts.append(nn.LeakyReLU(0.1, inplace=True))
    elif activation == "relu":
        parts.append(nn.ReLU(inplace=True))
    elif activation != "linear":
        raise ValueError(f"activation {activation!r} is not supported; leaky, relu or linear is")
    return nn.Sequential(*parts)


def _tensors(network: Darknet) -> list[torch.Tensor]:
    """Return the parameters in the order of a .weights file."""
    tensors = []
    for layer in network.convolutions():
        conv = layer[0]
        if len(layer) > 1 and isinstance(layer[1], nn.BatchNorm2d):
            norm = layer[1]
            tensors += [norm.bias, norm.weight, norm.running_mean, norm.running_var]
        else:
            tensors.append(conv.bias)
        tensors.append(conv.weight)
    return tensors


def save_weights(network: Darknet, path: Path) -> None:
    """Write darknet's .weights: version 0.2.5, images seen 0, 32-bit floats."""
    with open(path, "wb") as file:
        np.array([0, 2, 5], np.int32).tofile(file)
        np.array([0], np.int64).tofile(file)
        for tensor in _tensors(network):
            tensor.detach().cpu().contiguous().numpy().astype(np.float32).tofile(file)


def load_weights(network: Darknet, path: Path) -> None:
    """Read darknet's .weights into the network.

    Raises:
        ValueError: the number of values in the file is not that of the network.
    """
    values = np.fromfile(path, np.float32, offset=20)
    wanted = sum(tensor.numel() for tensor in _tensors(network))
    if len(values) != wanted:
        raise ValueError(f"{path} holds {len(values)} numbers, the network has {wanted}")
    start = 0
    with torch.no_grad():
        for tensor in _tensors(network):
            part = values[start : start + tensor.numel()]
            tensor.copy_(torch.from_numpy(part).reshape(tensor.shape))
            start += tensor.numel()
