"""Map and film of a flight through obstacles from above: obstacles, vehicles, their paths and a formation's slots."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import pyplot as plt
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from xtdrone_interaction.missions.fleet_record import FleetRecord
from xtdrone_interaction.missions.solids import Solid, draw_solids
from xtdrone_interaction.pictures.picture_style import NamedFigure
from xtdrone_interaction.recording.series_in_bounded_memory import Array
from xtdrone_swarm.view.film import FilmWriter

_RATE = 15  # frames per second
_SPEED = 8.0  # minimum speed of the film, relative to the flight
_LENGTH = 60.0  # s, at most
_TRAIL = 5.0  # s
_SIZE = (1280, 420)  # pixels
_DPI = 100
_MARGIN = 4.0  # m around the paths


def figures(record: FleetRecord, solids: Sequence[Solid]) -> Iterator[NamedFigure]:
    """Yield the map of a flight."""
    yield NamedFigure("map", "Map", draw_map(record, solids))


def draw_map(record: FleetRecord, solids: Sequence[Solid]) -> Figure:
    """Draw the map of a flight: obstacles, and the true paths."""
    low, high = view_of(record)
    figure, axes = plt.subplots(figsize=(11, 3.2 + 0.03 * (high[1] - low[1])), layout="constrained")
    draw_solids(axes, solids, height_of_flight(record))
    shades = plt.get_cmap("tab10").colors
    for index, name in enumerate(record.names):
        track, shade = record.position[:, index], shades[index % 10]
        axes.plot(track[:, 0], track[:, 1], color=shade, linewidth=1.6, label=name)
        axes.plot(*track[0, :2], "s", color=shade, markersize=5)
        goal = record.outcome_of(name)["goal"]
        if goal is not None:
            axes.plot(goal[0], goal[1], "*", color=shade, markersize=11)
    axes.set_aspect("equal")
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), xlabel="x, east (m)", ylabel="y, north (m)")
    axes.set_title("Paths over the ground (square: start, star: goal), and obstacles at their height")
    axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), fontsize=8)
    return figure


def view_of(record: FleetRecord) -> tuple[Array, Array]:
    """Return the lowest and the highest corner, (3,) m, of a box around the paths."""
    places = record.position.reshape(-1, 3)
    low, high = places.min(axis=0) - _MARGIN, places.max(axis=0) + _MARGIN
    high[1] = max(high[1], low[1] + 16.0)
    return low, high


def height_of_flight(record: FleetRecord) -> float:
    """Return the median height of the vehicles in the air, m."""
    flown = record.position[..., 2][record.position[..., 2] > 1.0]
    return float(np.median(flown)) if len(flown) else 2.0


def save_film(record: FleetRecord, solids: Sequence[Solid], path: Path) -> Path:
    """Film a flight and return the path, whose suffix is .mp4 or .gif.

    Raises:
        FilmError: the film cannot be written.
    """
    with FilmWriter(path, _SIZE, _RATE) as writer:
        for picture in _frames(record, solids):
            writer.add(picture)
    return path


def _frames(record: FleetRecord, solids: Sequence[Solid]) -> Iterator[NDArray[np.uint8]]:
    """Yield the pictures, RGBA, shape (height, width, 4); the array is reused."""
    figure = Figure(figsize=(_SIZE[0] / _DPI, _SIZE[1] / _DPI), dpi=_DPI, layout="constrained")
    canvas = FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    draw_solids(axes, solids, height_of_flight(record))
    low, high = view_of(record)
    axes.set_aspect("equal")
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), xlabel="x, east (m)", ylabel="y, north (m)")
    shades = plt.get_cmap("tab10").colors
    count = len(record.names)
    trails = [axes.plot([], [], color=shades[k % 10], linewidth=1.5, alpha=0.6, animated=True)[0] for k in range(count)]
    (slots,) = axes.plot([], [], "+", color="0.3", markersize=9, animated=True)
    vehicles = axes.scatter(
        np.zeros(count), np.zeros(count), s=45, c=[shades[k % 10] for k in range(count)], zorder=3, animated=True
    )
    title = axes.text(0.01, 0.97, "", transform=axes.transAxes, va="top", fontsize=9, animated=True)
    canvas.draw()
    background = canvas.copy_from_bbox(figure.bbox)
    for row in _rows(record):
        now, places = float(record.time[row]), record.position[row]
        behind = record.position[(record.time >= now - _TRAIL) & (record.time <= now)]
        for k, trail in enumerate(trails):
            trail.set_data(behind[:, k, 0], behind[:, k, 1])
        vehicles.set_offsets(places[:, :2])
        stage, offsets = _stage(record.events, now)
        wanted = np.zeros((0, 3)) if offsets is None else places[0] + offsets
        slots.set_data(wanted[:, 0], wanted[:, 1])
        title.set_text(f"{now:6.1f} s  {stage}")
        canvas.restore_region(background)  # type: ignore[attr-defined]
        for artist in (*trails, slots, vehicles, title):
            axes.draw_artist(artist)
        yield np.asarray(canvas.buffer_rgba())


def _rows(record: FleetRecord) -> range:
    """Return the rows of the track that are filmed."""
    length = float(record.time[-1] - record.time[0])
    speed = max(_SPEED, length / _LENGTH)
    step = max(1, math.ceil(speed / _RATE / float(np.median(np.diff(record.time))) - 0.5))
    return range(0, len(record.time), step)


def _stage(events: Sequence[dict[str, Any]], now: float) -> tuple[str, NDArray[np.float64] | None]:
    """Return the formation's stage and slots, (n - 1, 3) m from the leader, at a time, s; empty and None without."""
    stage, offsets = "", None
    for event in events:
        if event["time"] > now:
            break
        stage = event["phase"] if event["event"] == "phase" else stage
        offsets = np.array(event["offsets"]) if event["event"] == "assigned" else offsets
    return stage, offsets
