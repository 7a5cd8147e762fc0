"""Pictures of a formation flight: response curves, the formations in space, distances and errors; and its film.

Each vehicle has the same colour in all pictures; the leader is black.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray
from rich.console import Console

from xtdrone_interaction.missions.formation.criteria import SETTLED_ERROR
from xtdrone_interaction.missions.formation.metrics import flight_part
from xtdrone_interaction.missions.formation.record import FormationRecord, PatternWindow
from xtdrone_interaction.pictures.picture_style import (
    LEADER_COLOUR,
    MOST_NAMED,
    NamedFigure,
    fleet_colours,
    plain_numbers,
)
from xtdrone_interaction.recording.distances import DISTANCE_LIMIT, formation_error
from xtdrone_interaction.recording.topics import ORIGIN
from xtdrone_swarm.view import Frame, film

_LEAD_IN = 1.0  # s shown before the command
_MAX_WAYS = 60  # vehicles drawn individually; of a larger fleet, an even selection
_MAX_EDGES = 400  # edges of a topology; more would hide the vehicles
_MAX_PANELS = 3  # formations side by side
_LEAST_ERROR = 1e-3  # m; simplified vehicles have no estimation error
_RATE = 15  # frames of the film per second
_SPEED = 8.0  # minimum speed of the film, relative to the flight
_LENGTH = 60.0  # s of the film, at most


def figures(record: FormationRecord) -> Iterator[NamedFigure]:
    """Yield all pictures of a flight, each drawn on demand.

    Raises:
        RecordError: the record contains no takeoff.
    """
    before = None
    for number, window in enumerate(record.windows):
        if before is not None:
            yield _named(f"response_{number}_{before}_to_{window.pattern}", response(record, before, window))
        before = window.pattern
    if before is not None:
        yield _named("formations", formations(record))
    yield _named("distances", distances(record))


def _named(name: str, figure: Figure) -> NamedFigure:
    return NamedFigure(name, name.replace("_", " ").capitalize(), figure)


def _shown(count: int) -> list[int]:
    """Return the vehicles drawn individually: the leader and, of a large fleet, an even selection of the others."""
    if count <= _MAX_WAYS:
        return list(range(count))
    return [0, *np.unique(np.linspace(1, count - 1, _MAX_WAYS - 1).round().astype(int)).tolist()]


def _of_all(count: int) -> str:
    """Return a text with the number of vehicles drawn individually and the total number."""
    shown = len(_shown(count))
    return f"{count} UAVs" if shown == count else f"{shown} of {count} UAVs"


def response(record: FormationRecord, before: str, window: PatternWindow) -> Figure:
    """Draw x, y and z of every vehicle over time during one reconfiguration, the slots dotted."""
    track = record.track.between(window.start - _LEAD_IN, window.end)
    figure, axes = plt.subplots(3, 1, figsize=(9.0, 7.5), sharex=True)
    figure.subplots_adjust(left=0.08, right=0.83, top=0.93, bottom=0.07, hspace=0.1)
    shades = fleet_colours(len(record.names))
    leader_end = track.position[-1, 0]
    for axis, (panel, letter) in enumerate(zip(axes, "xyz", strict=True)):
        for i in _shown(len(record.names)):
            name, width = record.names[i], 1.8 if i == 0 else 1.2
            panel.plot(track.time - window.start, track.position[:, i, axis], color=shades[i], lw=width, label=name)
            if i > 0:
                panel.axhline(leader_end[axis] + window.offsets[i - 1, axis], color=shades[i], lw=0.7, ls=":", zorder=1)
        panel.axvline(0.0, color="grey", lw=0.8, ls="--", zorder=1)
        panel.set_ylabel(f"{letter} [m]")
        panel.margins(x=0.01)
    axes[-1].set_xlabel(f"time since the command '{window.pattern}' [s]")
    fleet = f"{_of_all(len(record.names))}, map frame, ENU"
    figure.suptitle(f"Position response from {before} to {window.pattern} ({fleet})")
    _name_vehicles(figure, record.names, axes[0])
    return figure


def _name_vehicles(figure: Figure, names: tuple[str, ...], panel: Axes) -> None:
    """Draw the legend beside the panels; of a large fleet, name only the leader and the slots."""
    handles, labels = panel.get_legend_handles_labels()
    labels = [f"{labels[0]} (leader)", *labels[1:]]
    if len(names) > MOST_NAMED:
        handles, labels = handles[:1], labels[:1]
    handles.append(Line2D([], [], color="grey", lw=0.7, ls=":"))
    labels.append("slot")
    figure.legend(handles, labels, loc="upper left", bbox_to_anchor=(0.84, 0.94))


def formations(record: FormationRecord) -> Figure:
    """Draw the first settled formations after origin in space, side by side.

    They show the vehicles, the links of the topology, and ground trails: the paths during the reconfiguration,
    projected onto the lowest plane.
    """
    chosen = [w for w in record.windows if w.pattern != ORIGIN][:_MAX_PANELS] or record.windows[:1]
    figure = plt.figure(figsize=(max(6.4, 4.8 * len(chosen)), 5.8))
    figure.subplots_adjust(left=0.0, right=0.97, top=0.92, bottom=0.1, wspace=0.02)
    shades = fleet_colours(len(record.names))
    for number, window in enumerate(chosen):
        panel = figure.add_subplot(1, len(chosen), number + 1, projection="3d")
        _formation(panel, record, window, shades)
    count = len(record.names)
    entries = {
        "leader": Line2D([], [], marker="*", ls="", ms=13, color=LEADER_COLOUR),
        "follower (number: index)" if count <= MOST_NAMED else "follower": Line2D(
            [], [], marker="o", ls="", ms=7, color="tab:blue"
        ),
        "communication topology": Line2D([], [], color="0.55", lw=1.2),
        "ground trail" if count <= _MAX_WAYS else f"ground trail of {_of_all(count)}": Line2D(
            [], [], color="tab:blue", lw=1.2, alpha=0.5
        ),
    }
    if not any(0 < len(_edges(window)) <= _MAX_EDGES for window in chosen):
        del entries["communication topology"]
    figure.legend(entries.values(), entries.keys(), loc="lower center", ncol=4 if len(chosen) > 1 else 2)
    figure.suptitle(f"Formations of {len(record.names)} UAVs (map frame, ENU, metres)")
    return figure


def _edges(window: PatternWindow) -> NDArray[np.int64]:
    """Return the links as pairs of listener and speaker, shape (e, 2)."""
    return np.empty((0, 2), dtype=np.int64) if window.topology is None else np.argwhere(window.topology > 0)


def _formation(panel: Any, record: FormationRecord, window: PatternWindow, shades: list[Any]) -> None:
    track = record.track.between(window.start, window.end)
    places = track.position[-1]
    low, high = track.position.reshape(-1, 3).min(axis=0), track.position.reshape(-1, 3).max(axis=0)
    margin = 0.08 * (high - low).max() + 0.3
    floor = low[2] - 2 * margin
    edges = _edges(window)
    for i, j in edges[: len(edges) if len(edges) <= _MAX_EDGES else 0]:
        panel.plot(*np.stack([places[i], places[j]]).T, color="0.55", lw=1.2, zorder=2)
    if len(places) > _MAX_WAYS:
        panel.scatter(*places[1:].T, c=shades[1:], s=9.0, depthshade=False, zorder=5)
    for i in _shown(len(places)):
        place = places[i]
        trail = track.position[:, i]
        panel.plot(trail[:, 0], trail[:, 1], np.full(len(trail), floor), color=shades[i], lw=1.2, alpha=0.5, zorder=1)
        panel.plot([place[0]] * 2, [place[1]] * 2, [floor, place[2]], color=shades[i], lw=0.6, ls=":", zorder=1)
        if i > 0 and len(places) > _MAX_WAYS:
            continue
        marker, width = ("*", 16) if i == 0 else ("o", 9)
        panel.plot(*place[:, None], marker=marker, ms=width, color=shades[i], mec="white", mew=0.6, ls="", zorder=5 + i)
        if i > 0 and len(places) <= MOST_NAMED:
            x, y, z = place
            panel.text(x, y, z + 0.5 * margin, str(i), color=shades[i], ha="center", va="bottom", zorder=40)
    panel.set(xlim=(low[0] - margin, high[0] + margin), ylim=(low[1] - margin, high[1] + margin))
    panel.set(zlim=(floor, high[2] + margin), xlabel="x", ylabel="y", zlabel="z")
    panel.set_title(window.pattern, y=1.0)
    panel.patch.set_alpha(0.0)  # else it hides the neighbour's z label
    size = high - low + 2 * margin
    box = np.array([size[0], size[1], high[2] + margin - floor])
    height = float(box @ [0.24, 0.24, 0.94] / np.linalg.norm(box))  # projected, as seen from this elevation
    panel.set_box_aspect(box, zoom=0.78 * min(1.3, 1.0 / height))
    panel.view_init(elev=20, azim=-60)


def distances(record: FormationRecord) -> Figure:
    """Draw the minimum distance between vehicles and the formation error over time, with the reconfigurations."""
    track = record.track
    part = track.part(flight_part(record, track).time[0], np.inf)
    figure, (upper, lower) = plt.subplots(2, 1, figsize=(9.0, 6.4), sharex=True)
    figure.subplots_adjust(left=0.09, right=0.96, top=0.86, bottom=0.13, hspace=0.1)
    upper.plot(track.time[part], track.least_distance[part], color="tab:blue", lw=1.2)
    upper.axhline(DISTANCE_LIMIT, color="tab:red", lw=1.0, ls="--", label=f"limit {DISTANCE_LIMIT} m")
    upper.set(ylabel="minimum distance [m]", ylim=(0.0, None))
    upper.legend(loc="lower right")
    for window in record.windows:
        flown = track.between(window.start, window.end)
        error = formation_error(flown.position, window.offsets).clip(min=_LEAST_ERROR)
        lower.plot(flown.time, error.max(axis=1), color="tab:orange", lw=1.2)
        lower.plot(flown.time, error.mean(axis=1), color="tab:green", lw=1.2)
        upper.annotate(window.pattern, (window.start, 1.0), xycoords=("data", "axes fraction"), xytext=(2, 3),
                       textcoords="offset points", rotation=30, ha="left", va="bottom", color="0.35")  # fmt: skip
        for panel in (upper, lower):
            panel.axvspan(window.start, window.end, color="0.93", zorder=0)
            panel.axvline(window.start, color="0.6", lw=0.8, zorder=1)
    lower.axhline(SETTLED_ERROR, color="tab:red", lw=1.0, ls="--")
    lower.set(yscale="log", ylabel="formation error [m]", xlabel="simulated time [s]")
    plain_numbers(lower)
    lower.margins(x=0.01)
    handles = [Line2D([], [], color=c, ls=s) for c, s in (("tab:orange", "-"), ("tab:green", "-"), ("tab:red", "--"))]
    labels = ["greatest error", "mean error", f"settled below {SETTLED_ERROR} m"]
    figure.legend(handles, labels, loc="lower center", ncol=3)
    figure.suptitle("Distances between the UAVs and from their slots (shaded: reconfigurations)")
    return figure


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
            edges = _links(record.topologies[links].value)
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


def _links(adjacency: NDArray[np.int_] | None) -> NDArray[np.int64] | None:
    """Return the links of the topology, shape (e, 2); None if there are too many to draw."""
    if adjacency is None:
        return None
    edges = np.argwhere(np.asarray(adjacency) > 0)
    return edges if len(edges) <= _MAX_EDGES else None
