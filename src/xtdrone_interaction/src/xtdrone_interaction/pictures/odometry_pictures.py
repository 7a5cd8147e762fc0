"""Pictures of odometry: its path and map beside the truth, and its error over time."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from matplotlib import pyplot as plt
from matplotlib.figure import Figure

from xtdrone_interaction.metrics.odometry_errors import Trajectory, aligned, common, pairs
from xtdrone_interaction.pictures.picture_style import NamedFigure, panels
from xtdrone_interaction.recording.recorded_flight import Recording
from xtdrone_interaction.recording.series_in_bounded_memory import Array

_LEAST_POSES = 3
_TRUE, _FOUND = "tab:green", "tab:orange"


def pictures(recording: Recording) -> Iterator[NamedFigure]:
    """Yield the pictures of all odometry of a recording whose truth is known."""
    for vehicle, source, estimate, truth in pairs(recording):
        found, true = common(estimate, truth)
        if len(found) < _LEAST_POSES:
            continue
        found = aligned(found, true, "first")
        name = f"{vehicle} {source}"
        yield NamedFigure(f"{source}_{vehicle}_path", f"Way of {name}", path(found, true, name))
        yield NamedFigure(f"{source}_{vehicle}_drift", f"Error of {name}", drift(found, true, name))


def path(found: Trajectory, true: Trajectory, name: str, points: Array | None = None) -> Figure:
    """Draw the paths from above, over the points of a map (n, 3) if there is one, coloured by height."""
    figure, panel = plt.subplots(figsize=(7.0, 6.4), layout="constrained")
    if points is not None and len(points):
        low, high = np.percentile(points[:, 2], [2, 98])
        drawn = panel.scatter(points[:, 0], points[:, 1], 0.8, points[:, 2], cmap="viridis", vmin=low, vmax=high, lw=0)
        figure.colorbar(drawn, ax=panel, label="height of the map [m]", shrink=0.8)
    panel.plot(true.position[:, 0], true.position[:, 1], color=_TRUE, lw=3.0, alpha=0.6, label="truth")
    panel.plot(found.position[:, 0], found.position[:, 1], color=_FOUND, lw=1.2, label=name)
    panel.plot(*true.position[0, :2], "o", color="black", ms=5, label="start")
    panel.set(xlabel="east [m]", ylabel="north [m]", aspect="equal")
    panel.legend(loc="best")
    panel.set_title(f"Way of {name}")
    return figure


def drift(found: Trajectory, true: Trajectory, name: str) -> Figure:
    """Draw the error over the path, in total and by axis."""
    figure, (panel,) = panels(1, 3.2, 0.97)
    difference, way = found.position - true.position, true.way
    panel.plot(way, np.linalg.norm(difference, axis=1), color="black", lw=1.4, label="total")
    for axis, label in enumerate(("east", "north", "up")):
        panel.plot(way, difference[:, axis], lw=0.8, label=label)
    panel.set(xlabel="way [m]", ylabel="error [m]")
    panel.legend(loc="best")
    figure.suptitle(f"Error of {name}")
    return figure
