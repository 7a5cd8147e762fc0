"""The report of a flight by odometry alone: drift, where it landed, and its map against the world."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from xtdrone_interaction.metrics.odometry_errors import Trajectory, aligned, common, errors, pairs
from xtdrone_interaction.missions.map_report import join_clouds, map_rows, octrees_in
from xtdrone_interaction.missions.mission import FlightReport, Mission, earlier_report
from xtdrone_interaction.pictures.odometry_pictures import drift, path
from xtdrone_interaction.pictures.picture_style import NamedFigure
from xtdrone_interaction.recording.flight_from_bag import read_bag
from xtdrone_interaction.recording.recorded_flight import RecordError, Recording
from xtdrone_interaction.recording.series_in_bounded_memory import Array
from xtdrone_interaction.report.html_page import ReportPage
from xtdrone_interaction.report.report_tables import map_table, odometry_table

SOURCES = ("lidar_odometry", "laser_odometry", "visual_odometry")
_HOME_LIMIT = 0.5  # m
_DRIFT_LIMITS = {"visual_odometry": 1.5}  # % of the way
_DRIFT_LIMIT = 0.5  # % of the way, of the others
_LEAST_WAY = 20.0  # m; on a shorter path the noise of the first pose, by which the flight is aligned, is not small
_VOXEL = 0.5  # m, of the joined map


class ShownFlight(NamedTuple):
    """Data for the pictures of the flight.

    Attributes:
        name: of vehicle and source.
        found, true: poses at the same times, the former in the latter's frame.
        points: (n, 3) m of the map, in the odometry's frame.
    """

    name: str
    found: Trajectory
    true: Trajectory
    points: Array


def slam_report(bag: Path, world: str | None = None) -> tuple[dict[str, Any], ShownFlight]:
    """Return the report as plain data, and the data for its pictures.

    Args:
        bag: of the flight; octrees beside it are compared with the world, too.
        world: name or file; None: maps are not compared.

    Raises:
        RecordError: the bag has no odometry beside the truth, or no such world.
    """
    maps = tuple(f"/{source}/local_map" for source in SOURCES)
    names = [topic.name for topic in read_bag([bag], wanted=lambda name: False).topics if topic.name.endswith(maps)]
    recording = read_bag([bag], keep=names)
    known = [pair for pair in pairs(recording) if pair[1] in SOURCES]
    if not known:
        raise RecordError(f"{bag}: no odometry of its own beside the vehicle's true odometry")
    vehicle, source, estimate, truth = known[0]
    rows = [
        {"vehicle": vehicle, "source": source, **asdict(row)}
        for alignment in ("first", "umeyama")
        if (row := errors(estimate, truth, alignment)) is not None
    ]
    if not rows:
        raise RecordError(f"{bag}: {source} and the truth have no times in common")
    found, true = common(estimate, truth)
    miss = float(np.linalg.norm((truth.position[-1] - truth.position[0])[:2]))
    points = join_clouds([message for name in names for _, message in recording.messages.get(name, [])], _VOXEL)
    report = {
        "vehicle": vehicle,
        "odometry": rows,
        "home_miss": miss,
        "map_points": len(points),
        "maps": map_rows([bag], world, octrees_in(bag.parent)) if world else [],
        "shortcomings": _shortcomings(rows[0], miss, recording),
    }
    return report, ShownFlight(f"{vehicle} {source}", aligned(found, true, "first"), true, points)


def _shortcomings(row: dict[str, Any], miss: float, recording: Recording) -> list[str]:
    found = list(recording.collisions)
    if miss > _HOME_LIMIT:
        found.append(f"landed {miss:.2f} m from the start, more than {_HOME_LIMIT:g} m")
    limit = _DRIFT_LIMITS.get(row["source"], _DRIFT_LIMIT)
    if row["drift"] is not None and row["drift"] * row["way"] > limit * max(row["way"], _LEAST_WAY):
        found.append(f"drift {row['drift']:.2f} % of the path, more than {limit:g} %")
    return found


class SlamMission(Mission):
    """A flight by odometry alone."""

    name = "slam"
    results = ("map.bt",)

    def recognises(self, file: Path) -> bool:
        """Return whether the report beside a recording is that of a flight by odometry."""
        return "home_miss" in earlier_report(file.parent)

    def report(self, file: Path, settings: dict[str, Any]) -> FlightReport:
        """Read a recorded flight, and return its metrics, judgement, tables and figures."""
        data, shown = slam_report(file, settings.get("world"))
        data["settings"] = settings
        page = ReportPage("Flight by odometry alone", f"It landed {data['home_miss']:.2f} m from the start.")
        page.tables.append(odometry_table(data["odometry"]))
        if data["maps"]:
            page.tables.append(map_table(data["maps"]))
        return FlightReport(data, page, figures(shown))


def figures(shown: ShownFlight) -> Iterator[NamedFigure]:
    """Yield the path over the map, and the drift."""
    yield NamedFigure("path", "Path", path(shown.found, shown.true, shown.name, shown.points))
    yield NamedFigure("drift", "Drift", drift(shown.found, shown.true, shown.name))
