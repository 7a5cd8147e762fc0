"""Film of a flight through obstacles from above, drawn from its record after the flight."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import numpy as np
from matplotlib import pyplot as plt
from matplotlib.backends.backend_agg import FigureCanvasAgg

from xtdrone_interaction.metrics.clearance import Solid
from xtdrone_interaction.pictures.crossing_map import map_of, shade_of
from xtdrone_interaction.recording.crossing_record import CrossingRecord
from xtdrone_swarm.view import FilmWriter

_RATE = 15  # frames a second
_SPEED = 2.0  # of the film, relative to the flight, unless it is longer than _LENGTH
_LENGTH = 60.0  # s, at most
_DPI = 100
_RADIUS = 0.4  # m, of a drawn vehicle


def make_crossing_film(record: CrossingRecord, solids: Sequence[Solid], path: Path) -> Path:
    """Film a recorded flight over its map at increased speed, and return the path.

    Raises:
        FilmError: the film cannot be written.
    """
    figure, axes = map_of(record, solids)
    try:
        canvas = FigureCanvasAgg(figure)
        figure.set_dpi(_DPI)
        width, height = (2 * round(0.5 * _DPI * float(side)) for side in figure.get_size_inches())  # even, for MP4
        figure.set_size_inches(width / _DPI, height / _DPI)
        clock = axes.set_title("0 s", animated=True)
        shades = [shade_of(index) for index in range(len(record.names))]
        trails = [axes.plot([], [], color=shade, linewidth=1.6, animated=True)[0] for shade in shades]
        bodies = [axes.add_patch(plt.Circle((0.0, 0.0), _RADIUS, color=shade, animated=True)) for shade in shades]
        canvas.draw()
        ground = canvas.copy_from_bbox(figure.bbox)
        with FilmWriter(path, (width, height), _RATE) as writer:
            for k in _moments(record):
                canvas.restore_region(ground)
                clock.set_text(f"{record.time[k] - record.time[0]:.1f} s")
                for index, (trail, body) in enumerate(zip(trails, bodies, strict=True)):
                    trail.set_data(record.position[: k + 1, index, 0], record.position[: k + 1, index, 1])
                    body.set_center((record.position[k, index, 0], record.position[k, index, 1]))
                    axes.draw_artist(trail)
                    axes.draw_artist(body)
                axes.draw_artist(clock)
                writer.add(np.asarray(canvas.buffer_rgba()))
        return writer.path
    finally:
        plt.close(figure)


def _moments(record: CrossingRecord) -> list[int]:
    """Return the samples of the record that are shown."""
    speed = max(_SPEED, float(record.time[-1] - record.time[0]) / _LENGTH)
    times = np.arange(record.time[0], record.time[-1], speed / _RATE)
    return np.searchsorted(record.time, times).tolist() or [0]
