"""Picture of the maps of several vehicles, as each has them and merged, from above."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import matplotlib
import numpy as np
from numpy.typing import NDArray

matplotlib.use("Agg")
from matplotlib import pyplot as plt

from xtdrone_interaction.metrics.clearance import Solid
from xtdrone_interaction.pictures.missions.crossing_map import draw_solids
from xtdrone_interaction.pictures.picture_style import save_figure

Array = NDArray[np.float64]

_DPI = 120
_HEIGHTS = (0.4, 2.2)  # m: neither floor nor ceiling
_MIDDLE = 1.5  # m, height of the obstacles that are drawn
_DOT = 1.2  # points²
_MARGIN = 1.0  # m around the obstacles


def save_merged_map(single: Mapping[str, Array], merged: Array, solids: Sequence[Solid], file: Path) -> Path:
    """Draw both over the true obstacles, and return the file, a PNG.

    Args:
        single: (n, 3) m, points of each vehicle's map, in its frame.
        merged: (n, 3) m, points of the merged map.
        solids: obstacles of the world.
        file: to write.
    """
    figure, (own, together) = plt.subplots(1, 2, figsize=(14, 5.6), sharex=True, sharey=True, layout="constrained")
    for axes in (own, together):
        draw_solids(axes, solids, _MIDDLE)
        axes.set_aspect("equal")
        axes.set(xlabel="x, east (m)")
    for number, (name, points) in enumerate(single.items()):
        shown = _at_heights(points)
        own.scatter(shown[:, 0], shown[:, 1], s=_DOT, color=f"C{number}", linewidths=0, label=name)
    own.set(ylabel="y, north (m)", title="Maps of the vehicles, each in its own frame; dark: the true walls")
    own.legend(loc="upper right", fontsize=8, markerscale=4)
    shown = _at_heights(merged)
    heights = together.scatter(shown[:, 0], shown[:, 1], s=_DOT, c=shown[:, 2], cmap="viridis", linewidths=0)
    together.set(title="Merged map, in the first vehicle's frame")
    figure.colorbar(heights, ax=together, label="height (m)", shrink=0.8)
    low, high = _extent(shown)
    own.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
    save_figure(figure, file, dpi=_DPI)
    return file


def _at_heights(points: Array) -> Array:
    """Return the points between the heights that are drawn, lowest first."""
    chosen = points[(points[:, 2] >= _HEIGHTS[0]) & (points[:, 2] <= _HEIGHTS[1])]
    return np.asarray(chosen[np.argsort(chosen[:, 2], kind="stable")])


def _extent(points: Array) -> tuple[Array, Array]:
    """Return the lowest and the highest corner, (2,) m, of a view that has nearly all points."""
    low, high = np.percentile(points[:, :2], (1.0, 99.0), axis=0)
    return low - _MARGIN, high + _MARGIN
