"""The map of a cooperative search: region, pieces, plans, paths flown, finds and true positions of persons."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import PathPatch
from matplotlib.path import Path
from numpy.typing import NDArray
from shapely.geometry import MultiPolygon, Polygon

from xtdrone_interaction.missions.search.record import SearchRecord


def draw_map(
    record: SearchRecord,
    region: Polygon,
    pieces: Sequence[Polygon],
    plans: Mapping[str, NDArray[np.float64]],
) -> Figure:
    """Draw the map of a search.

    Args:
        record: the search.
        region: searched region, m, map frame.
        pieces: one per vehicle, or none if the user's own plans were flown.
        plans: planned path of each vehicle, shape (k, 2), m, map frame.
    """
    figure, axes = plt.subplots(figsize=(9, 7), layout="constrained")
    shades = plt.get_cmap("tab10").colors
    _fill(axes, region, facecolor="0.95", edgecolor="black", linewidth=1.5)
    for index, piece in enumerate(pieces):
        _fill(axes, piece, facecolor=(*shades[index % 10], 0.12), edgecolor="0.6", linewidth=0.6)
    for index, name in enumerate(record.names):
        shade = shades[index % 10]
        if name in plans:
            axes.plot(*plans[name].T, ":", color=shade, linewidth=0.9)
        axes.plot(*record.position[:, index, :2].T, color=shade, linewidth=1.3, label=name)
        axes.plot(*record.position[0, index, :2], "s", color=shade, markersize=4)
    _persons(axes, record)
    _finds(axes, record)
    axes.set_aspect("equal")
    axes.set(xlabel="x, east (m)", ylabel="y, north (m)", title=_title(record))
    axes.grid(alpha=0.3)
    axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False, fontsize=8)
    return figure


def _title(record: SearchRecord) -> str:
    end = record.finished
    covered = end.get("covered_fraction")
    part = "" if covered is None else f", {100 * covered:.0f} % covered"
    if end["outcome"] == "found":
        finds = sum(event["event"] == "confirmed" for event in record.events)
        first = f"{finds} finds, the first" if finds > 1 else "Found"
        return f"{first} by {end['vehicle']} at {end.get('found_time', end['time']):.0f} s{part}"
    return f"{str(end['outcome']).capitalize()} after {end['time']:.0f} s{part}"


def _persons(axes: Axes, record: SearchRecord) -> None:
    for number, (name, track) in enumerate(record.persons.items()):
        known = track[np.isfinite(track[:, 0])]
        if not len(known):
            continue
        axes.plot(*known[:, :2].T, color="black", linewidth=2.0, label="persons, true" if number == 0 else None)
        axes.plot(*known[0, :2], "o", color="black", markersize=5)
        axes.annotate(name, known[0, :2], textcoords="offset points", xytext=(5, 5), fontsize=7)


def _finds(axes: Axes, record: SearchRecord) -> None:
    styles: dict[str, tuple[str, str, str]] = {
        "confirmed": ("*", "red", "found"),
        "rejected": ("x", "grey", "looked at again, rejected"),
    }
    for kind, (marker, colour, label) in styles.items():
        places = [event["position"] for event in record.events if event["event"] == kind and event.get("position")]
        if places:
            axes.plot(*np.array(places)[:, :2].T, marker, color=colour, markersize=10, linestyle="", label=label)


def _fill(axes: Axes, shape: Polygon | MultiPolygon, **style: Any) -> None:
    for polygon in getattr(shape, "geoms", [shape]):
        rings = [np.asarray(ring.coords)[:, :2] for ring in (polygon.exterior, *polygon.interiors)]
        axes.add_patch(PathPatch(Path.make_compound_path(*(Path(ring, closed=True) for ring in rings)), **style))
    axes.autoscale_view()
