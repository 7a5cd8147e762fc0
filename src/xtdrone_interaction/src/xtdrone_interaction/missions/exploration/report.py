"""The report of an exploration."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from xtdrone_common.fleet import parse_fleet
from xtdrone_interaction.missions.demo import planning_times
from xtdrone_interaction.missions.exploration.figures import draw_floor, draw_merged_map
from xtdrone_interaction.missions.exploration.metrics import Array, Mask, make_report, visible_cells
from xtdrone_interaction.missions.exploration.record import ExplorationRecord, read_exploration, read_merging
from xtdrone_interaction.missions.map_report import MERGED, map_rows, octrees_in, read_map
from xtdrone_interaction.missions.mission import FlightReport, Mission
from xtdrone_interaction.missions.solids import Solid, solids_of_world
from xtdrone_interaction.pictures.picture_style import NamedFigure
from xtdrone_interaction.report.html_page import ReportPage
from xtdrone_interaction.report.report_tables import ReportTable, map_table, number
from xtdrone_planning.exploration.settings import ExplorationSettings

_OCTREE = "map.bt"  # of several vehicles: map.VEHICLE.bt


class ShownFloor(NamedTuple):
    """What the pictures of an exploration show, besides its metrics.

    Attributes:
        record: The flight.
        visible, solid: Masks of cells, see ``visible_cells``.
        solids: Obstacles of the world.
        settings: Settings of the exploration.
        maps: Points of saved maps by their files, each (n, 3) m; none if maps were not merged.
    """

    record: ExplorationRecord
    visible: Mask
    solid: Mask
    solids: Sequence[Solid]
    settings: ExplorationSettings
    maps: dict[Path, Array]


class ExplorationMission(Mission):
    """An exploration of a floor."""

    name = "exploration"
    settings_file = "explore.json"
    results = ("*.bt",)

    def report(self, file: Path, settings: dict[str, Any]) -> FlightReport:
        """Read a recorded exploration, and return its metrics, judgement, tables and figures."""
        folder = file.parent
        names = [vehicle.name for vehicle in parse_fleet(str(settings["fleet"]))]
        record = read_exploration(file, names)
        solids = solids_of_world(str(settings["world"]))
        exploration = ExplorationSettings(bounds=tuple(settings["bounds"]))
        visible, solid = visible_cells(solids, exploration, tuple(settings["start"]))
        data = make_report(record, solids, visible, settings, planning_times(folder))
        data["maps"] = map_rows([file], str(settings["world"]), octrees_in(folder))
        data["shortcomings"] += [f"{name} was not saved" for name in unsaved_maps(folder, names)]
        maps = {}
        if settings.get("merge"):
            data["merging"] = read_merging(file, names)
            data["shortcomings"] += _unmerged(data["merging"])
            maps = {path: read_map(path) for path in octrees_in(folder)}
        page = ReportPage("Exploration", summarise(data), tables=[vehicles_table(data), map_table(data["maps"])])
        return FlightReport(data, page, figures(ShownFloor(record, visible, solid, solids, exploration, maps), data))


def figures(shown: ShownFloor, report: Mapping[str, Any]) -> Iterator[NamedFigure]:
    """Yield the floor and, if there is one, the merged map."""
    floor = draw_floor(shown.record, shown.visible, shown.solid, shown.settings, report)
    yield NamedFigure("floor", "Floor", floor)
    merged = [points for path, points in shown.maps.items() if path.stem == MERGED]
    single = {path.suffixes[0].strip("."): points for path, points in shown.maps.items() if path.stem != MERGED}
    if merged and len(merged[0]):
        yield NamedFigure("merged_map", "Merged map", draw_merged_map(single, merged[0], shown.solids))


def unsaved_maps(folder: Path, names: Sequence[str]) -> list[str]:
    """Return the octrees that should be in the results folder of some vehicles and are not."""
    expected = [_OCTREE] if len(names) == 1 else [_OCTREE.replace(".", f".{name}.") for name in names]
    return [name for name in expected if not (folder / name).is_file()]


def _unmerged(merging: Mapping[str, Mapping[str, Any]]) -> list[str]:
    if not merging:
        return ["map_merging.py has reported nothing"]
    return [f"{name}: {entry['state']}" for name, entry in merging.items() if not entry["merged"]]


def vehicles_table(report: dict[str, Any]) -> ReportTable:
    """Return the table of the vehicles' flights."""
    head = ("vehicle", "outcome", "path\n(m)", "nearest obstacle\nfrom its centre (m)")
    rows = [
        (name, item["outcome"], number(item["path"], 1), number(item["clearance"]))
        for name, item in report["vehicles"].items()
    ]
    return ReportTable("Vehicles", head, rows, texts=frozenset({1}))


def summarise(report: dict[str, Any]) -> str:
    """Return the figures of all vehicles together, as sentences."""
    seen = f"Seen: {100 * report['coverage']:.1f} % of the visible floor"
    if report["time_to_95_percent"] is not None:
        seen += f", 95 % after {report['time_to_95_percent']:.0f} s"
    if report["explored_after"] is not None:
        seen += f", no frontier left after {report['explored_after']:.0f} s"
    lines = [f"{seen}."]
    if report["least_distance"] is not None:
        lines.append(f"Minimum distance of two vehicles {report['least_distance']:.2f} m.")
    for name, entry in report.get("merging", {}).items():
        if entry["merged"]:
            lines.append(f"Map of {name}: {entry['state']}, since {entry['since']:.0f} s.")
    return "\n".join(lines)
