"""Film of a recorded formation flight, drawn from its record after the flight."""

from __future__ import annotations

import math
import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rich.console import Console

from xtdrone_interaction.recording.missions.formation_record import FormationRecord
from xtdrone_swarm.view import Frame, film

_RATE = 15  # frames per second
_SPEED = 8.0  # minimum speed of the film, relative to the flight
_LENGTH = 60.0  # s, at most
_MOST_LINKS = 400  # of a topology that is drawn


def default_file(folder: Path) -> Path:
    """Return the film's file in the results folder: .mp4 where ffmpeg is installed, else .gif."""
    return folder / ("flight.mp4" if shutil.which("ffmpeg") else "flight.gif")


def frames(record: FormationRecord) -> Iterator[Frame]:
    """Yield the frames of a film of the flight."""
    track = record.track
    speed = max(_SPEED, float(track.time[-1] - track.time[0]) / _LENGTH)
    step = max(1, math.ceil(speed / _RATE / float(np.median(np.diff(track.time))) - 0.5))
    names = {round(w.start, 3): w.pattern for w in record.windows}
    pattern, number, links = "", -1, -1  # links: index of the topology; the recorder may have missed one
    edges = None
    for k in range(0, len(track.time), step):
        now, places = float(track.time[k]), track.position[k]
        while number + 1 < len(record.patterns) and record.patterns[number + 1].time <= now:
            number += 1
        while links + 1 < len(record.topologies) and record.topologies[links + 1].time <= now:
            links += 1
            edges = _edges(record.topologies[links].value)
        pattern = next((name for start, name in reversed(names.items()) if start <= now), pattern)
        slots = None
        if number >= 0:
            slots = places[0] + np.vstack([np.zeros(3), record.patterns[number].value])
        yield Frame(now, places, slots, edges, pattern)


def make_film(record: FormationRecord, path: Path, console: Console) -> Path:
    """Film a recorded flight at increased speed, show the progress, and return the path.

    Raises:
        FilmError: the film cannot be written.
    """
    return film(list(frames(record)), path, _RATE, console, names=record.names)


def _edges(adjacency: NDArray[np.int_] | None) -> NDArray[np.int64] | None:
    """Return the links of the topology, shape (e, 2); None if there are too many to draw."""
    if adjacency is None:
        return None
    edges = np.argwhere(np.asarray(adjacency) > 0)
    return edges if len(edges) <= _MOST_LINKS else None
