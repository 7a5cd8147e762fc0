"""A kind of flight: how its recordings are recognised, and the one report that all kinds write."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from rich.console import Console

from xtdrone_interaction.launching.supervised_launch import DemoError, escape
from xtdrone_interaction.monitoring.ended_nodes import EndedNode
from xtdrone_interaction.pictures.picture_style import NamedFigure
from xtdrone_interaction.recording.recorded_flight import RecordError
from xtdrone_interaction.report.html_page import ReportPage, write_page

REPORT = "report.json"


@dataclass
class FlightReport:
    """The report of a recorded flight.

    Attributes:
        data: Content of report.json; ``shortcomings``: where the flight fell short, as sentences.
        page: Page of the report without its figures.
        figures: Figures, each drawn when the iterator is advanced.
        film: Films the flight into a file, and returns it; None for a kind of flight without film.
    """

    data: dict[str, Any]
    page: ReportPage
    figures: Iterable[NamedFigure]
    film: Callable[[Path, Console], Path] | None = None


class Mission:
    """A kind of flight.

    Attributes:
        name: Name of the kind.
        settings_file: File in the results folder that holds the settings of the flight; "" for report.json.
        kept: Entries of an earlier report that a report made again has, too.
        results: Patterns of the names of further files in the results folder.
    """

    name: str
    settings_file = ""
    kept: tuple[str, ...] = ()
    results: tuple[str, ...] = ()

    def recognises(self, file: Path) -> bool:
        """Return whether a recording is one of such a flight, by the files beside it."""
        if self.settings_file:
            return (file.parent / self.settings_file).is_file()
        return earlier_report(file.parent).get("kind") == self.name

    def report(self, file: Path, settings: dict[str, Any]) -> FlightReport:
        """Read a recorded flight, and return its metrics, judgement, tables and figures.

        Args:
            file: Recording, in its results folder.
            settings: Settings of the flight, stored in the report.

        Raises:
            RecordError, ValueError, KeyError: it is not a record of such a flight.
        """
        raise NotImplementedError

    def stored_settings(self, folder: Path) -> dict[str, Any]:
        """Return the settings of the flight in a results folder; empty if they are not known.

        Raises:
            DemoError: their file cannot be read.
        """
        if not self.settings_file:
            return dict(earlier_report(folder).get("settings", {}))
        file = folder / self.settings_file
        try:
            return dict(json.loads(file.read_text(encoding="utf-8")))
        except (OSError, ValueError) as error:
            raise DemoError(f"{file}: {error}") from error


def earlier_report(folder: Path) -> dict[str, Any]:
    """Return the report in a results folder; empty without one."""
    try:
        found = json.loads((folder / REPORT).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return found if isinstance(found, dict) else {}


def film_file(folder: Path) -> Path:
    """Return the film's file in the results folder: .mp4 where ffmpeg is installed, else .gif."""
    return folder / ("flight.mp4" if shutil.which("ffmpeg") else "flight.gif")


def make_report(
    mission: Mission, file: Path, settings: dict[str, Any], ended_nodes: Sequence[EndedNode] = (),
    kept: Mapping[str, Any] | None = None,
) -> FlightReport:  # fmt: skip
    """Return the report of a recorded flight.

    Args:
        mission: Kind of the flight.
        file: Recording, in its results folder.
        settings: Settings of the flight.
        ended_nodes: Nodes that ended in flight.
        kept: Entries that the report has unchanged.

    Raises:
        DemoError: the file is not a record of such a flight.
    """
    try:
        made = mission.report(file, settings)
    except (RecordError, ValueError, KeyError) as error:
        raise DemoError(str(error)) from error
    ended = [str(node) for node in ended_nodes if node.matters]
    made.data["shortcomings"] = [*ended, *made.data.get("shortcomings", [])]
    made.data |= {"kind": mission.name, "died": [asdict(node) for node in ended_nodes], **(kept or {})}
    made.page.missed = made.data["shortcomings"]
    beside = [path for name in ("flight.mp4", "flight.gif", *mission.results) for path in file.parent.glob(name)]
    made.page.files = [*sorted(beside), file, file.parent / "events.jsonl", *sorted(file.parent.glob("logs/*"))]
    return made


def save_report(made: FlightReport, folder: Path, console: Console, film: Path | None = None) -> int:
    """Write report.html, report.json and the pictures into a folder; return 0 for a good flight, else 1.

    Args:
        made: Report of the flight.
        folder: Results folder.
        console: Console that shows the paths.
        film: File of a film to make; None for none.
    """

    def make_film() -> Path | None:
        from xtdrone_swarm.view import FilmError

        try:
            return made.film(film, console) if film is not None and made.film is not None else None
        except FilmError as error:
            console.print(f"[red]Error:[/red] {escape(str(error))}", highlight=False, soft_wrap=True)
            return None

    try:
        write_page(made.page, made.data, made.figures, folder, console, make_film)
    except RecordError as error:
        raise DemoError(str(error)) from error
    return 1 if made.data["shortcomings"] else 0


def make_report_again(mission: Mission, file: Path) -> FlightReport:
    """Return the report of a recorded flight with what only an earlier report knows.

    Raises:
        DemoError: it is not a record of such a flight.
    """
    known = earlier_report(file.parent)
    ended = [EndedNode(**node) for node in known.get("died", [])]
    kept = {key: known[key] for key in mission.kept if key in known}
    return make_report(mission, file, mission.stored_settings(file.parent), ended, kept)
