"""Shared by all pictures: style, colours, lines of many points, legends, and files."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib
import numpy as np

matplotlib.use("Agg")
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter

from xtdrone_common.files import replacing
from xtdrone_interaction.recording.series_in_bounded_memory import Array

_POINTS = 4000  # drawn per line; longer lines are reduced to the minimum and maximum of each part
_LONGEST_NAME = 22  # letters in a legend beside a panel
_LEAST_MAP = 2.0  # m, minimum extent of a map
_MAX_NAME = 120  # characters of a file name
MOST_NAMED = 18  # lines; of more, only the first and the last are named
NO_MODE = "0.85"
LEADER_COLOUR = "black"
STYLE: dict[str, Any] = {
    "font.size": 9,
    "axes.titlesize": 10,
    "axes.grid": True,
    "grid.alpha": 0.3,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "legend.frameon": False,
    "text.parse_math": False,  # names of patterns may contain dollar signs
}


class NamedFigure(NamedTuple):
    """A figure of a report.

    Attributes:
        name: file name without suffix.
        title: heading.
        figure: the drawn figure.
    """

    name: str
    title: str
    figure: Figure


def save_figures(figures: Iterable[NamedFigure], folder: str | Path, dpi: int = 150) -> list[tuple[str, Path]]:
    """Write figures into ``folder`` as PNG, and return their titles and paths.

    Args:
        figures: drawn one by one as the iterator advances, so that all have the same style and only one is open.
        folder: existing folder.
        dpi: resolution, dots per inch.
    """
    saved = []
    with plt.rc_context(STYLE):
        for name, title, figure in figures:
            path = Path(folder) / f"{_file_stem(name)}.png"
            save_figure(figure, path, dpi=dpi)
            saved.append((title, path))
    return saved


def save_figure(figure: Figure, path: Path, **options: Any) -> None:
    """Write a figure to a file in the format of its suffix, and close it.

    Args:
        figure: the figure.
        path: the file, which is whole or absent.
        options: further arguments of ``Figure.savefig``, such as ``dpi``.

    Raises:
        ValueError: Matplotlib does not know the suffix.
        OSError: see ``files.replacing``.
    """
    try:
        with replacing(path) as draft:
            figure.savefig(draft, format=path.suffix[1:], **options)
    finally:
        plt.close(figure)


def _file_stem(name: str) -> str:
    """Return a name valid on every file system: names of patterns may contain words and paths."""
    return re.sub(r"[^\w.+-]+", "-", name)[:_MAX_NAME]


def fleet_colours(count: int) -> list[Any]:
    """Return one colour per vehicle of a formation, the leader's first."""
    if count <= 11:
        return [LEADER_COLOUR, *plt.get_cmap("tab10").colors[: count - 1]]
    return [LEADER_COLOUR, *plt.get_cmap("turbo")(np.linspace(0.05, 0.95, count - 1))]


def shades(count: int) -> list[Any]:
    """Return one colour per line."""
    if count <= 10:
        return list(plt.get_cmap("tab10").colors[:count])
    return list(plt.get_cmap("turbo")(np.linspace(0.05, 0.95, count)))


def thinned(time: Array, value: Array) -> tuple[Array, Array]:
    """Return a line of fewer points with the same appearance: the minimum and maximum of each part.

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
    """Draw a line with any number of points."""
    panel.plot(*thinned(time, value), **style)


def panels(count: int, height: float = 2.3, side: float = 0.83) -> tuple[Figure, list[Axes]]:
    """Return a figure of stacked panels with a common time axis; ``side``: their right border, share of the width."""
    inches = 1.1 + height * count
    figure, axes = plt.subplots(count, 1, figsize=(9.0, inches), sharex=True, squeeze=False)
    figure.subplots_adjust(left=0.09, right=side, top=1 - 0.5 / inches, bottom=0.5 / inches, hspace=0.12)
    for panel in axes[:, 0]:
        panel.margins(x=0.01)
    return figure, list(axes[:, 0])


def plain_numbers(panel: Axes) -> None:
    """Label a logarithmic axis without mathtext, which is off."""
    panel.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))


def same_scale(panel: Axes) -> None:
    """Give both axes of a map the same scale, and show at least a few metres."""
    for low, high, limit in ((*panel.get_xlim(), panel.set_xlim), (*panel.get_ylim(), panel.set_ylim)):
        if high - low < _LEAST_MAP:
            middle = (low + high) / 2
            limit(middle - _LEAST_MAP / 2, middle + _LEAST_MAP / 2)
    panel.set_aspect("equal", adjustable="datalim")


def name_lines(figure: Figure, panel: Axes, left: float = 0.84) -> None:
    """Draw a legend beside the panels; of many lines, name only the first and the last."""
    handles, labels = panel.get_legend_handles_labels()
    if len(labels) > MOST_NAMED:
        handles, labels = [handles[0], handles[-1]], [labels[0], f"... {labels[-1]}"]
    if labels:
        labels = [label if len(label) <= _LONGEST_NAME else f"…{label[1 - _LONGEST_NAME :]}" for label in labels]
        figure.legend(handles, labels, loc="upper left", bbox_to_anchor=(left, 0.97), fontsize=8)


def colours_of(names: Sequence[str]) -> dict[str, Any]:
    """Return one colour per name, in order of appearance."""
    unique = list(dict.fromkeys(names))
    colours = plt.get_cmap("tab20").colors
    return {name: colours[(2 * i + i // 10) % 20] for i, name in enumerate(unique)}


def mark_times(panels_: Sequence[Axes], marks: Sequence[tuple[float, str]]) -> None:
    """Draw vertical lines in all panels, named above the first one.

    Args:
        panels_: stacked panels.
        marks: time, s, and name of each line.
    """
    for time, name in marks:
        for panel in panels_:
            panel.axvline(time, color="0.6", lw=0.8, ls="--", zorder=1)
        panels_[0].annotate(
            name, (time, 1.0), xycoords=("data", "axes fraction"), xytext=(2, 2), textcoords="offset points",
            rotation=30, ha="left", va="bottom", color="0.35", fontsize=8,
        )  # fmt: skip
