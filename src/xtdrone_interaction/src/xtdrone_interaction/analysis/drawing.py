"""What the pictures of recordings share: colours, lines of many points, bands of modes. No display is needed."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import matplotlib
import numpy as np

matplotlib.use("Agg")
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from xtdrone_interaction.analysis.columns import Array

_POINTS = 4000  # drawn of a line; of more, the least and the greatest value of each part
_LONGEST_NAME = 22  # letters in a legend beside a panel
_LEAST_MAP = 2.0  # m shown
MOST_NAMED = 18  # vehicles; more are not named one by one
NO_MODE = "0.85"


class Picture(NamedTuple):
    """A picture of a report.

    Attributes:
        name: of its file, without ending.
        title: in words.
        figure: drawn.
    """

    name: str
    title: str
    figure: Figure


def shades(count: int) -> list[Any]:
    """Return a colour for each of so many lines."""
    if count <= 10:
        return list(plt.get_cmap("tab10").colors[:count])
    return list(plt.get_cmap("turbo")(np.linspace(0.05, 0.95, count)))


def thinned(time: Array, value: Array) -> tuple[Array, Array]:
    """Return a line that looks the same, of few points: of each part its least and its greatest value.

    Args:
        time, value: shape (t,).
    """
    if len(time) <= _POINTS:
        return time, value
    size = len(time) // (_POINTS // 2)
    parts = len(time) // size
    rows = value[: parts * size].reshape(parts, size)
    rows = np.where(np.isfinite(rows), rows, np.nan_to_num(rows[:, :1]))
    pairs = np.sort(np.column_stack([rows.argmin(axis=1), rows.argmax(axis=1)]), axis=1)
    chosen = (pairs + size * np.arange(parts)[:, None]).ravel()
    chosen = np.append(chosen, np.arange(parts * size, len(time)))
    return time[chosen], value[chosen]


def line(panel: Axes, time: Array, value: Array, **style: Any) -> None:
    """Draw a line of any number of points."""
    panel.plot(*thinned(time, value), **style)


def panels(count: int, height: float = 2.3, side: float = 0.83) -> tuple[Figure, list[Axes]]:
    """Return a figure with panels one above the other that share their time axis; ``side``: their right border."""
    inches = 1.1 + height * count
    figure, axes = plt.subplots(count, 1, figsize=(9.0, inches), sharex=True, squeeze=False)
    figure.subplots_adjust(left=0.09, right=side, top=1 - 0.5 / inches, bottom=0.5 / inches, hspace=0.12)
    for panel in axes[:, 0]:
        panel.margins(x=0.01)
    return figure, list(axes[:, 0])


def same_scale(panel: Axes) -> None:
    """Give both axes of a map the same scale, and of a vehicle that hardly moves no more than a few metres' detail."""
    for low, high, limit in ((*panel.get_xlim(), panel.set_xlim), (*panel.get_ylim(), panel.set_ylim)):
        if high - low < _LEAST_MAP:
            middle = (low + high) / 2
            limit(middle - _LEAST_MAP / 2, middle + _LEAST_MAP / 2)
    panel.set_aspect("equal", adjustable="datalim")


def name_lines(figure: Figure, panel: Axes, left: float = 0.84) -> None:
    """Put the legend of a panel beside it; of very many lines only the first and the last are named."""
    handles, labels = panel.get_legend_handles_labels()
    if len(labels) > MOST_NAMED:
        handles, labels = [handles[0], handles[-1]], [labels[0], f"... {labels[-1]}"]
    if labels:
        labels = [label if len(label) <= _LONGEST_NAME else f"…{label[1 - _LONGEST_NAME :]}" for label in labels]
        figure.legend(handles, labels, loc="upper left", bbox_to_anchor=(left, 0.97), fontsize=8)


def spans(changes: Sequence[tuple[float, Any]], end: float) -> Iterator[tuple[float, float, Any]]:
    """Yield (start, end, value) of a value that changes at times."""
    for number, (start, value) in enumerate(changes):
        yield start, changes[number + 1][0] if number + 1 < len(changes) else max(end, start), value


def colours_of(names: Sequence[str]) -> dict[str, Any]:
    """Return a colour for each name, in the order in which they come."""
    unique = list(dict.fromkeys(names))
    colours = plt.get_cmap("tab20").colors
    return {name: colours[(2 * i + i // 10) % 20] for i, name in enumerate(unique)}


def mark_times(panels_: Sequence[Axes], marks: Sequence[tuple[float, str]]) -> None:
    """Draw lines at times in all panels, and their names above the first."""
    for time, name in marks:
        for panel in panels_:
            panel.axvline(time, color="0.6", lw=0.8, ls="--", zorder=1)
        panels_[0].annotate(
            name, (time, 1.0), xycoords=("data", "axes fraction"), xytext=(2, 2), textcoords="offset points",
            rotation=30, ha="left", va="bottom", color="0.35", fontsize=8,
        )  # fmt: skip
