"""Pictures of an exploration: floor, paths, the share of it that was seen over time, and the merged map."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib import pyplot as plt
from matplotlib.figure import Figure

from xtdrone_interaction.missions.exploration.metrics import ENOUGH, Array, Mask
from xtdrone_interaction.missions.exploration.record import ExplorationRecord
from xtdrone_interaction.missions.solids import Solid, draw_solids
from xtdrone_planning.exploration.floor_map import FloorMap
from xtdrone_planning.exploration.settings import ExplorationSettings

_HEIGHTS = (0.4, 2.2)  # m: neither floor nor ceiling
_MIDDLE = 1.5  # m, height of the obstacles that are drawn
_DOT = 1.2  # points²
_MARGIN = 1.0  # m around the obstacles


def draw_floor(
    record: ExplorationRecord, visible: Mask, solid: Mask, settings: ExplorationSettings, report: Mapping[str, Any]
) -> Figure:  # fmt: skip
    """Draw floor, paths and coverage over time.

    Args:
        record: the flight.
        visible, solid: see ``visible_cells``.
        settings: of the exploration.
        report: of the flight.
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
    plan.grid(visible=False)
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
    return figure


def draw_merged_map(single: Mapping[str, Array], merged: Array, solids: Sequence[Solid]) -> Figure:
    """Draw the maps of several vehicles, as each has them and merged, from above, over the true obstacles.

    Args:
        single: (n, 3) m, points of each vehicle's map, in its frame.
        merged: (n, 3) m, points of the merged map.
        solids: obstacles of the world.
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
    return figure


def _at_heights(points: Array) -> Array:
    """Return the points between the heights that are drawn, lowest first."""
    chosen = points[(points[:, 2] >= _HEIGHTS[0]) & (points[:, 2] <= _HEIGHTS[1])]
    return np.asarray(chosen[np.argsort(chosen[:, 2], kind="stable")])


def _extent(points: Array) -> tuple[Array, Array]:
    """Return the lowest and the highest corner, (2,) m, of a view that has nearly all points."""
    low, high = np.percentile(points[:, :2], (1.0, 99.0), axis=0)
    return low - _MARGIN, high + _MARGIN
