"""Film of a recorded flight through obstacles from above: vehicles, the paths behind them and a formation's slots."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from xtdrone_interaction.metrics.clearance import Solid
from xtdrone_interaction.pictures.missions.crossing_map import draw_solids, height_of_flight, view_of
from xtdrone_interaction.recording.missions.crossing_record import CrossingRecord
from xtdrone_swarm.view.film import FilmWriter

_RATE = 15  # frames per second
_SPEED = 8.0  # minimum speed of the film, relative to the flight
_LENGTH = 60.0  # s, at most
_TRAIL = 5.0  # s
_SIZE = (1280, 420)  # pixels
_DPI = 100


def save_crossing_film(record: CrossingRecord, solids: Sequence[Solid], path: Path) -> Path:
    """Film a flight and return the path, whose suffix is .mp4 or .gif.

    Raises:
        FilmError: the film cannot be written.
    """
    with FilmWriter(path, _SIZE, _RATE) as writer:
        for picture in _pictures(record, solids):
            writer.add(picture)
    return path


def _pictures(record: CrossingRecord, solids: Sequence[Solid]) -> Iterator[NDArray[np.uint8]]:
    """Yield the pictures, RGBA, shape (height, width, 4); the array is reused."""
    figure = Figure(figsize=(_SIZE[0] / _DPI, _SIZE[1] / _DPI), dpi=_DPI, layout="constrained")
    canvas = FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    draw_solids(axes, solids, height_of_flight(record))
    low, high = view_of(record)
    axes.set_aspect("equal")
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), xlabel="x, east (m)", ylabel="y, north (m)")
    shades = matplotlib.colormaps["tab10"].colors  # type: ignore[attr-defined]
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


def _rows(record: CrossingRecord) -> range:
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
