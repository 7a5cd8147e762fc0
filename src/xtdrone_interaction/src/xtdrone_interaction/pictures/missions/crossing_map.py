"""The map of a flight through obstacles from above: the obstacles, and the true paths."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import matplotlib
import numpy as np

matplotlib.use("Agg")
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.collections import PatchCollection
from matplotlib.patches import Circle, Polygon

from xtdrone_control.poses import rotate
from xtdrone_interaction.metrics.clearance import Solid
from xtdrone_interaction.pictures.picture_style import save_figure
from xtdrone_interaction.recording.missions.crossing_record import CrossingRecord
from xtdrone_interaction.recording.series_in_bounded_memory import Array
from xtdrone_sim.shapes.visual import Box, Cylinder

_DPI = 130
_MARGIN = 4.0  # m around the paths


def save_crossing_map(record: CrossingRecord, solids: Sequence[Solid], file: Path) -> Path:
    """Draw the map of a flight and return its file, a PNG."""
    low, high = view_of(record)
    figure, axes = plt.subplots(figsize=(11, 3.2 + 0.03 * (high[1] - low[1])), layout="constrained")
    draw_solids(axes, solids, height_of_flight(record))
    shades = plt.get_cmap("tab10").colors
    for index, name in enumerate(record.names):
        track, shade = record.position[:, index], shades[index % 10]
        axes.plot(track[:, 0], track[:, 1], color=shade, linewidth=1.6, label=name)
        axes.plot(*track[0, :2], "s", color=shade, markersize=5)
        goal = record.crossing_of(name)["goal"]
        if goal is not None:
            axes.plot(goal[0], goal[1], "*", color=shade, markersize=11)
    axes.set_aspect("equal")
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), xlabel="x, east (m)", ylabel="y, north (m)")
    axes.set_title("Paths over the ground (square: start, star: goal), and obstacles at their height")
    axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), fontsize=8)
    save_figure(figure, file, dpi=_DPI)
    return file


def view_of(record: CrossingRecord) -> tuple[Array, Array]:
    """Return the lowest and the highest corner, (3,) m, of a box around the paths."""
    places = record.position.reshape(-1, 3)
    low, high = places.min(axis=0) - _MARGIN, places.max(axis=0) + _MARGIN
    high[1] = max(high[1], low[1] + 16.0)
    return low, high


def height_of_flight(record: CrossingRecord) -> float:
    """Return the median height of the vehicles in the air, m."""
    flown = record.position[..., 2][record.position[..., 2] > 1.0]
    return float(np.median(flown)) if len(flown) else 2.0


def draw_solids(axes: Axes, solids: Sequence[Solid], height: float) -> None:
    """Draw the obstacles at a height, m."""
    patches = []
    for solid in solids:
        x, y, z = solid.pose.position
        if isinstance(solid.shape, Box):
            if abs(z - height) > 0.5 * solid.shape.size[2]:
                continue
            a, b = 0.5 * solid.shape.size[0], 0.5 * solid.shape.size[1]
            corners = [rotate(solid.pose.orientation, (u, v, 0.0)) for u, v in ((a, b), (-a, b), (-a, -b), (a, -b))]
            patches.append(Polygon([(x + u, y + v) for u, v, _ in corners]))
        elif isinstance(solid.shape, Cylinder):
            if abs(z - height) <= 0.5 * solid.shape.length:
                patches.append(Circle((x, y), solid.shape.radius))
        elif abs(z - height) < solid.shape.radius:
            patches.append(Circle((x, y), math.sqrt(solid.shape.radius**2 - (z - height) ** 2)))
    axes.add_collection(PatchCollection(patches, facecolor="0.45", edgecolor="0.25", linewidth=0.5))
