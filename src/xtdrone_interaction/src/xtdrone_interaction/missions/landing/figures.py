"""The picture of a landing on a robot: paths over the ground, height and distance over time, and the touchdown."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from matplotlib import pyplot as plt
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from xtdrone_interaction.missions.landing.metrics import LandingRecord
from xtdrone_interaction.pictures.picture_style import NamedFigure

_HALF = 0.7  # m, of the platform


def figures(record: LandingRecord, report: dict[str, Any]) -> Iterator[NamedFigure]:
    """Yield the picture of a landing."""
    yield NamedFigure("landing", "Landing", _draw(record, report))


def _draw(record: LandingRecord, report: dict[str, Any]) -> Figure:
    figure, (ways, times, deck) = plt.subplots(1, 3, figsize=(14, 4.6), layout="constrained")
    touch = report["touchdown"]
    ways.plot(*record.robot[:, :2].T, color="0.4", linewidth=3, alpha=0.6, label="robot")
    ways.plot(*record.uav[:, :2].T, color="tab:blue", linewidth=1.2, label="UAV")
    if report["tags_found"] is not None:
        index = int(np.searchsorted(record.time, report["tags_found"]))
        ways.plot(*record.uav[index, :2], "o", color="tab:orange", label="tags found")
    if touch is not None:
        index = int(np.searchsorted(record.time, touch["time"]))
        ways.plot(*record.uav[index, :2], "*", color="tab:red", markersize=11, label="touchdown")
    ways.set_aspect("equal", adjustable="datalim")
    ways.set(xlabel="x, east (m)", ylabel="y, north (m)", title="paths over the ground")
    ways.legend(frameon=False, fontsize=8)
    ways.grid(alpha=0.3)
    offset = record.offset
    times.plot(record.time, offset[:, 2], color="tab:blue", label="height above the robot's wheels")
    times.plot(record.time, np.hypot(*offset[:, :2].T), color="tab:orange", label="horizontal distance")
    times.set(xlabel="simulated time (s)", ylabel="m", title="approach")
    times.legend(frameon=False, fontsize=8)
    times.grid(alpha=0.3)
    deck.add_patch(Rectangle((-_HALF, -_HALF), 2 * _HALF, 2 * _HALF, facecolor="0.93", edgecolor="black"))
    if touch is not None:
        late = record.time > touch["time"] - 6.0
        deck.plot(*offset[late, :2].T, color="tab:blue", linewidth=1.0, label="last 6 s")
        deck.plot(*offset[index, :2], "*", color="tab:red", markersize=11, label=f"touchdown, {touch['error']:.3f} m")
        deck.legend(frameon=False, fontsize=8, loc="upper right")
    deck.set(
        xlim=(-1.0, 1.0), ylim=(-1.0, 1.0), xlabel="m, east", ylabel="m, north", title="over the platform (not turned)"
    )
    deck.set_aspect("equal")
    deck.grid(alpha=0.3)
    return figure
