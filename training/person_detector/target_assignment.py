"""Assignment of people to the detector's output layers, cells and anchors, by size and position."""

from __future__ import annotations

import torch
from network import Head

# Heads by stride: heights (px) of the people that a head must find, and of those that it may find.
RANGES = {4: ((0.0, 28.0), (0.0, 44.0)), 8: ((18.0, 1e6), (13.0, 1e6)), 16: ((60.0, 1e6), (45.0, 1e6))}


def responsible_cells(head: Head, people: torch.Tensor, grid: tuple[int, int]) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the responsible cells for a head's people: indices into people, and cells (n, 2) x, y."""
    height, width = grid
    place = people[:, 1:3] / head.stride
    cell = place.floor()
    aside = torch.where(place - cell > 0.5, 1.0, -1.0)
    zero = torch.zeros_like(aside[:, 0])
    shifts = [torch.stack([zero, zero], 1), torch.stack([aside[:, 0], zero], 1), torch.stack([zero, aside[:, 1]], 1)]
    cells = torch.cat([cell + shift for shift in shifts])
    index = torch.arange(len(people)).repeat(3)
    inside = (cells[:, 0] >= 0) & (cells[:, 0] < width) & (cells[:, 1] >= 0) & (cells[:, 1] < height)
    return index[inside], cells[inside]


def closest_anchor(head: Head, want: torch.Tensor) -> torch.Tensor:
    """Return the anchor closest in size for each person."""
    if len(head.anchors) == 1:
        return torch.zeros(len(want), dtype=torch.long)
    ratio = (want[:, None, 3:5] / head.anchors[None]).log().abs().sum(2)
    return ratio.argmin(1)
