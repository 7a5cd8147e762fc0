"""Pictures of an exploration: the floor with the paths, and the share of it that was seen over time."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np

matplotlib.use("Agg")
from matplotlib import pyplot as plt

from xtdrone_interaction.metrics.missions.exploration_metrics import ENOUGH, Mask
from xtdrone_interaction.pictures.picture_style import save_figure
from xtdrone_interaction.recording.missions.exploration_record import ExplorationRecord
from xtdrone_planning.exploration.floor_map import FloorMap
from xtdrone_planning.exploration.settings import ExplorationSettings

_DPI = 120


def save_floor(
    record: ExplorationRecord, visible: Mask, solid: Mask, settings: ExplorationSettings, report: Mapping[str, Any],
    file: Path,
) -> Path:  # fmt: skip
    """Draw floor, paths and coverage over time, and return the file, a PNG.

    Args:
        record: the flight.
        visible, solid: see ``visible_cells``.
        settings: of the exploration.
        report: of the flight.
        file: to write.
    """
    figure, (plan, curve) = plt.subplots(1, 2, figsize=(13, 6), width_ratios=(2.2, 1.0), layout="constrained")
    known = np.zeros_like(visible)
    for _, cells in record.floors:
        if cells.shape == known.shape:
            known |= cells >= 0
    shades = np.full((*visible.shape, 3), 0.82)
    shades[known] = 1.0
    shades[visible & ~known] = (1.0, 0.75, 0.6)
    shades[solid] = 0.25
    floor = FloorMap(settings)
    low = floor.first * floor.cell
    high = low + np.array(visible.shape) * floor.cell
    plan.imshow(shades.transpose(1, 0, 2), origin="lower", extent=(low[0], high[0], low[1], high[1]))
    for index, name in enumerate(record.names):
        track = record.position[:, index]
        plan.plot(track[:, 0], track[:, 1], color=f"C{index}", linewidth=1.5, label=name)
        plan.plot(*track[0, :2], "s", color=f"C{index}", markersize=6)
    plan.set(xlabel="x, east (m)", ylabel="y, north (m)", title="White: seen; dark: walls; orange: not seen")
    plan.legend(loc="upper right", fontsize=8)
    if report["coverage_over_time"]:
        times, shares = np.array(report["coverage_over_time"]).T
        curve.plot(times, 100.0 * shares)
    curve.axhline(100.0 * ENOUGH, color="0.5", linewidth=0.8, linestyle="--")
    curve.set(xlabel="time (s)", ylabel="seen of the visible floor (%)", ylim=(0.0, 102.0))
    curve.grid(alpha=0.3)
    save_figure(figure, file, dpi=_DPI)
    return file
