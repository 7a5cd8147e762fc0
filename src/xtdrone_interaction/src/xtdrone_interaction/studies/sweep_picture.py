"""The picture of a sweep: mean and spread of a figure over the seeds, against one or two parameters.

It needs no display and no ROS.
"""

from __future__ import annotations

import itertools
import json
import math
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import pyarrow.parquet as pq

matplotlib.use("Agg")
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from xtdrone_interaction.pictures.picture_style import save_figure
from xtdrone_interaction.studies.result_store import FIGURES, METADATA
from xtdrone_interaction.studies.study_parameters import StudyError

DPI = 150
_MOST_POOLED = 5  # values listed of a parameter
_MOST_LINES = 8  # a second parameter with more values makes a colour map
_MOST_TICKS = 15
_LOG_RATIO = 1.05  # tolerance for even steps of a logarithmic axis


@dataclass(frozen=True)
class Results:
    """The rows of a sweep as columns.

    Attributes:
        name: of the study.
        columns: by name; None for missing values.
        parameters: names of the varied parameters.
        figures: names of the figures, including the user's.
    """

    name: str
    columns: dict[str, list[Any]]
    parameters: tuple[str, ...]
    figures: tuple[str, ...]


def read_results(file: Path) -> Results:
    """Read results.parquet.

    Raises:
        StudyError: the file is missing, is not Parquet, or does not belong to a sweep.
    """
    try:
        table = pq.read_table(file)
        header = json.loads(table.schema.metadata[METADATA])
        parameters = tuple(header["study"]["parameters"])
        name = str(header["study"]["name"])
    except OSError as error:
        raise StudyError(f"results: {file}: {error.strerror or error}") from error
    except (ValueError, KeyError, TypeError) as error:
        raise StudyError(f"results: {file} is not of a sweep: {error!r}") from error
    constants = set(header["study"]["constants"])
    other = {"key", "seed", "error", *parameters, *constants}
    figures = tuple(column for column in table.column_names if column not in other)
    return Results(name, {column: table[column].to_pylist() for column in table.column_names}, parameters, figures)


def draw(results: Results, figure: str | None = None, x: str | None = None, by: str | None = None) -> Figure:
    """Return the picture.

    Args:
        results: of the sweep.
        figure: name; by default the settling time, or the first figure with values.
        x: parameter of the axis; by default the one with the most values, numbers before texts.
        by: second parameter, drawn as lines or, with many values, as a colour map; by default the one of the others
            whose values change the figure's mean the most. The title names the parameters over which means are taken.

    Raises:
        StudyError: an unknown name, or nothing to show.
    """
    figure = _figure_name(results, figure)
    x, by = _parameters(results, figure, x, by)
    good = [error is None for error in results.columns["error"]]
    shown, axes = plt.subplots(figsize=(7.5, 5.0), layout="constrained")
    points = _points(results, figure, x, by)
    if not points:
        plt.close(shown)
        raise StudyError(f"picture: no run has a {figure!r} to show")
    lines = sorted({second for _, second in points}, key=_order)
    if len(lines) > _MOST_LINES and _numeric({first for first, _ in points}) and _numeric(set(lines)):
        _draw_map(shown, axes, points, x, str(by), figure)
    else:
        _draw_lines(axes, points, lines, x, by, figure)
    empty = sum(value is None for value, fine in zip(results.columns[figure], good, strict=True) if fine)
    title = _title(results, figure, len(good), len(good) - sum(good), empty)
    axes.set_title(title + _pooled(results, x, by), fontsize=10)
    return shown


def save_picture(
    file: Path, path: Path, figure: str | None = None, x: str | None = None, by: str | None = None
) -> None:
    """Draw the picture of a results file into a PNG, SVG or PDF file.

    Raises:
        StudyError: see :func:`read_results` and :func:`draw`; unknown suffix.
    """
    shown = draw(read_results(file), figure, x, by)
    try:
        save_figure(shown, path, dpi=DPI)
    except ValueError as error:
        raise StudyError(f"picture: {path}: {error}") from error


def _figure_name(results: Results, wanted: str | None) -> str:
    if wanted is None:
        for name in ("settling_time", *results.figures):
            if any(value is not None for value in results.columns.get(name, ())):
                return name
        raise StudyError("picture: no run has any figure; see the column 'error' of the results")
    if wanted not in results.figures:
        raise StudyError(f"metric: {wanted!r} is unknown; there are: {', '.join(results.figures)}")
    return wanted


def _parameters(results: Results, figure: str, x: str | None, by: str | None) -> tuple[str, str | None]:
    """Return the parameter of the axis, and the second one or None."""
    for thing, name in (("x", x), ("by", by)):
        if name is not None and name not in (*results.parameters, "seed"):
            there = ", ".join((*results.parameters, "seed"))
            raise StudyError(f"{thing}: {name!r} is not varied in this study; there are: {there}")
    values = {name: set(results.columns[name]) - {None} for name in results.parameters}
    free = [name for name in results.parameters if name not in (x, by) and len(values[name]) > 1]
    free.sort(key=lambda name: (not _numeric(values[name]), -len(values[name])))  # stable: ties keep the study's order
    if x is None:
        x = free.pop(0) if free else next((name for name in results.parameters if name != by), "seed")
    if by is None and free:
        by = max(free, key=lambda name: _effect(results, figure, name))  # the first of equal ones
    return x, None if by == x else by


def _effect(results: Results, figure: str, name: str) -> float:
    """Return how much the mean of the figure changes over the values of a parameter."""
    means = [np.mean(values) for values in _points(results, figure, name, None).values()]
    return float(np.ptp(means)) if means else 0.0


def _pooled(results: Results, x: str, by: str | None) -> str:
    """Return a line of the title that names the varied parameters which the picture does not show; often empty."""
    texts = []
    for name in results.parameters:
        values = sorted(set(results.columns[name]) - {None}, key=_order)
        if name not in (x, by) and len(values) > 1:
            shown = values if len(values) <= _MOST_POOLED else [values[0], "...", values[-1]]
            texts.append(f"{name} ({', '.join(map(_text, shown))})")
    return f"\npooled: {', '.join(texts)}" if texts else ""


def _points(results: Results, figure: str, x: str, by: str | None) -> dict[tuple[Any, Any], list[float]]:
    """Return the figure's values of all runs at each point of the picture."""
    points: dict[tuple[Any, Any], list[float]] = defaultdict(list)
    seconds: Sequence[Any] = results.columns[by] if by else [None] * len(results.columns[x])
    for first, second, value in zip(results.columns[x], seconds, results.columns[figure], strict=True):
        if value is not None and math.isfinite(value):
            points[first, second].append(float(value))
    return points


def _draw_lines(
    axes: Axes,
    points: Mapping[tuple[Any, Any], Sequence[float]],
    lines: Sequence[Any],
    x: str,
    by: str | None,
    figure: str,
) -> None:
    """Draw mean and standard deviation against x, a line for each value of the second parameter."""
    places = sorted({first for first, _ in points}, key=_order)
    numeric = _numeric(set(places))
    where = {place: place if numeric else number for number, place in enumerate(places)}
    shades = plt.get_cmap("viridis")(np.linspace(0.0, 0.85, len(lines)))
    for line, shade in zip(lines, shades, strict=True):
        here = [place for place in places if (place, line) in points]
        at = np.array([where[place] for place in here], dtype=float)
        means = np.array([np.mean(points[place, line]) for place in here])
        spread = np.array([np.std(points[place, line]) for place in here])
        axes.plot(at, means, marker="o", markersize=4, color=shade, label=_text(line))
        if spread.any():
            axes.fill_between(at, means - spread, means + spread, color=shade, alpha=0.2, linewidth=0)
    if not numeric:
        axes.set_xticks(range(len(places)), [_text(place) for place in places], rotation=30 if len(places) > 5 else 0)
    elif _logarithmic(places):
        axes.set_xscale("log")
        _plain_ticks(axes, places)
    elif len(places) <= _MOST_TICKS:
        axes.set_xticks(places)
    axes.set_xlabel(x)
    axes.set_ylabel(_label(figure))
    axes.grid(alpha=0.3)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    if by:
        axes.legend(title=by, frameon=False)


def _draw_map(
    shown: Figure, axes: Axes, points: Mapping[tuple[Any, Any], Sequence[float]], x: str, by: str, figure: str
) -> None:
    """Draw the mean as a colour map over both parameters."""
    firsts = sorted({first for first, _ in points})
    seconds = sorted({second for _, second in points})
    if len(points) * 2 < len(firsts) * len(seconds):  # no grid, but random samples
        first, second = np.array(list(points), dtype=float).T
        colours = axes.scatter(first, second, c=[np.mean(values) for values in points.values()], cmap="viridis")
    else:
        grid = np.full((len(seconds), len(firsts)), np.nan)
        for (first, second), values in points.items():
            grid[seconds.index(second), firsts.index(first)] = np.mean(values)
        colours = axes.pcolormesh(firsts, seconds, grid, shading="nearest", cmap="viridis")
    for scale, ticks in ((axes.set_xscale, firsts), (axes.set_yscale, seconds)):
        if _logarithmic(ticks):
            scale("log")
    axes.set_xlabel(x)
    axes.set_ylabel(by)
    shown.colorbar(colours, ax=axes, label=_label(figure))


def _plain_ticks(axes: Axes, places: Sequence[float]) -> None:
    if len(places) <= _MOST_TICKS:
        axes.set_xticks(places, [_text(place) for place in places])
        axes.set_xticks([], minor=True)


def _logarithmic(places: Sequence[float]) -> bool:
    """Return whether ascending numbers have even logarithmic steps over a wide range."""
    if len(places) < 3 or places[0] <= 0.0:
        return False
    ratios = [b / a for a, b in itertools.pairwise(places)]
    return max(ratios) <= _LOG_RATIO * min(ratios) and places[-1] > 2.0 * places[0]


def _title(results: Results, figure: str, runs: int, failed: int, empty: int) -> str:
    seeds = len(set(results.columns["seed"]))
    parts = [f"{results.name}: {runs} runs, {seeds} {'seed' if seeds == 1 else 'seeds'}"]
    if seeds > 1:
        parts.append("mean and standard deviation")
    if failed:
        parts.append(f"{failed} failed")
    if empty:
        parts.append(f"{empty} not settled" if figure == "settling_time" else f"{empty} without {figure}")
    return ", ".join(parts)


def _label(figure: str) -> str:
    _, unit = FIGURES.get(figure, (float, ""))
    words = figure.replace("_", " ") if figure in FIGURES else figure
    return f"{words} ({unit})" if unit else words


def _numeric(values: set[Any]) -> bool:
    return all(
        isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value) for value in values
    )


def _order(value: Any) -> tuple[bool, Any]:
    """Sort key: numbers by size, then texts."""
    return isinstance(value, str), -math.inf if value is None else value


def _text(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)
