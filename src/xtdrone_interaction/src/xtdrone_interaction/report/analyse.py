"""``./xtdrone analyse FILE``: report and pictures of any recording.

Exit status: 0 when a report was written, 1 when nothing can be read, 2 for an invalid value.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from rich.console import Console

from xtdrone_interaction import command_options
from xtdrone_interaction.bags.ros1bag import BagError
from xtdrone_interaction.command_options import OptionError
from xtdrone_interaction.metrics.missions.map_report import map_rows
from xtdrone_interaction.metrics.missions.odometry_errors import write_trajectories
from xtdrone_interaction.metrics.vehicle_metrics import summarise, summarise_log
from xtdrone_interaction.pictures import recording_pictures as recording_pictures
from xtdrone_interaction.pictures import ulog_pictures
from xtdrone_interaction.recording.flight_from_ulog import FlightLog, LogError
from xtdrone_interaction.recording.missions.formation_record import formation_of
from xtdrone_interaction.recording.open_recording import open_recording
from xtdrone_interaction.recording.recorded_flight import RecordError, Recording
from xtdrone_interaction.report import report_tables
from xtdrone_interaction.report.html_page import ReportPage, output_folder, write_page


class MapOptions(NamedTuple):
    """Which maps are compared with the truth.

    Attributes:
        world: name or file of the world; None: no map is compared.
        files: saved maps, besides those of the bag.
    """

    world: str | None = None
    files: Sequence[Path] = ()


def analyse(
    files: Sequence[Path],
    folder: Path,
    console: Console,
    part: int | None = None,
    maps: MapOptions = MapOptions(),  # noqa: B008  (immutable)
) -> None:
    """Write the report of a recording, and print it.

    Args:
        files: one file, or the consecutive bags of a split recording.
        folder: of the report; exists.
        console: to print on.
        part: number of the flight in a bag whose simulated time was reset, from 1; None for the longest.
        maps: which maps are compared with the truth.

    Raises:
        BagError, LogError, RecordError: nothing can be read of it.
    """
    recording = open_recording(files, part)
    if recording.flight_log is not None:
        log = recording.flight_log
        metrics = summarise_log(recording, log)
        write_page(_log_page(log, metrics), metrics, ulog_pictures.pictures(log), folder, console)
        return
    record = formation_of(recording)
    metrics = summarise(recording, record)
    metrics["maps"] = map_rows(files, maps.world, maps.files, part=part) if maps.world else []
    shown = recording_pictures.pictures(recording, record if metrics["formation"] else None)
    write_trajectories(recording, folder)
    write_page(_recording_page(recording, metrics), metrics, shown, folder, console)


def _recording_page(recording: Recording, metrics: dict[str, Any]) -> ReportPage:
    page = ReportPage(f"Flight in {recording.path.name}", _summary(recording, metrics), list(metrics["notes"]))
    if metrics["formation"]:
        page.tables.append(report_tables.formation_table(metrics["formation"]["reconfigurations"]))
        page.notes += metrics["formation"]["shortcomings"]
    else:
        page.notes += recording.collisions
    if metrics["odometry"]:
        page.tables.append(report_tables.odometry_table(metrics["odometry"]))
    if metrics["maps"]:
        page.tables.append(report_tables.map_table(metrics["maps"]))
    page.tables += [report_tables.vehicles_table(metrics["vehicles"]), report_tables.modes_table(metrics["vehicles"])]
    texts = report_tables.texts_table(recording), report_tables.warnings_table(recording)
    page.tables += [table for table in texts if table.rows]
    page.tables.append(report_tables.topics_table(recording))
    return page


def _summary(recording: Recording, metrics: dict[str, Any]) -> str:
    vehicles = f"{len(recording.vehicles)} vehicles" if len(recording.vehicles) != 1 else "1 vehicle"
    text = f"{vehicles}, {len(recording.topics)} topics, {metrics['messages']} messages in {recording.duration:.1f} s"
    text += f", {recording.size / 1e6:.1f} MB."
    if recording.origin:
        text += f" It began at {time.strftime('%Y-%m-%d %H:%M:%S', time.gmtime(recording.origin))} UTC."
    if metrics["formation"]:
        text += f" The formation flight ended with {metrics['formation']['outcome']!r}; judged by "
        text += f"{metrics['formation']['positions']}, the minimum distance was "
        text += f"{metrics['formation']['least_distance']:.2f} m."
    return text


def _log_page(log: FlightLog, metrics: dict[str, Any]) -> ReportPage:
    armed = metrics["armed_time"]
    text = f"{log.duration:.1f} s, armed for {armed:.1f} s, {log.size / 1e6:.1f} MB, {len(log.counts)} topics."
    if metrics["way"] is not None and armed > 0:
        text += f" It flew {metrics['way']:.1f} m, {metrics['highest']:.1f} m above where it began"
        text += "." if metrics["greatest_speed"] is None else f", at up to {metrics['greatest_speed']:.1f} m/s."
    text += _logged_by(metrics["vehicle"])
    return ReportPage(f"Flight log {log.path.name}", text, list(log.notes), report_tables.log_tables(log, metrics))


def _logged_by(vehicle: dict[str, Any]) -> str:
    """Return the sentence on the logging software and hardware; empty if they are unknown."""
    words = " ".join(str(vehicle[key]) for key in ("sys_name", "release") if key in vehicle)
    if "ver_hw" in vehicle:
        words += f" on {vehicle['ver_hw']}"
    if "ver_sw" in vehicle:
        words += f" (git {str(vehicle['ver_sw'])[:10]})"
    return f" Logged by {words.strip()}." if words else ""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    parser.description = (
        "Write report and pictures of a recorded flight: report.html, which needs no other file, the "
        "pictures as PNG, and report.json. No ROS is needed."
    )
    add = parser.add_argument
    add("files", type=Path, nargs="+", metavar="FILE", help="ROS 1 bag or ULog, also one truncated by a crash, ROS 2 "
        "bag, or flight.npz; or the bags of a split recording")  # fmt: skip
    add("--part", type=int, metavar="N", help="of a bag in which time was set back (default: the longest)")
    add(
        "--world", metavar="WORLD", help="world of the flight, by name or file: compare its maps with the true surfaces"
    )
    add("--map", type=Path, action="append", default=[], metavar="FILE", help="saved map to compare, too: an octree "
        ".bt or .ot, or a cloud .ply, .xyz")  # fmt: skip
    add("--out", type=Path, metavar="FOLDER", help="where the report goes (default: <file>-analysis beside the file)")


def run(arguments: argparse.Namespace) -> int:
    """Run the command and return its exit status."""
    first = arguments.files[0]
    try:
        for file in arguments.files:
            if not file.exists():
                raise BagError(f"analyse: {str(file)!r} does not exist")
        if arguments.map and arguments.world is None:
            raise OptionError("map: --map needs --world, with whose surfaces it is compared")
        maps = MapOptions(None if arguments.world is None else command_options.world(arguments.world), arguments.map)
        folder = output_folder(arguments.out, first.with_name(f"{first.stem}-analysis"))
        analyse(arguments.files, folder, Console(), arguments.part, maps)
    except OptionError as error:
        print(f"xtdrone: {error}", file=sys.stderr)
        return 2
    except (BagError, LogError, RecordError) as error:
        print(f"xtdrone: {error}", file=sys.stderr)
        return 1
    except OSError as error:
        print(f"xtdrone: {error.filename or 'system'}: {error.strerror or error}", file=sys.stderr)
        return 1
    return 0
