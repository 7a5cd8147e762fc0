"""``./xtdrone demo search``: UAVs with cameras search a region for people.

Exit status: 0 for a successful search, 1 for one that failed or missed a person, 2 for an invalid value, 128 + n when
stopped by signal n.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console

from xtdrone_common.fleet import parse_fleet
from xtdrone_interaction.command_options import OptionError
from xtdrone_interaction.console import PatientConsole, run_reported
from xtdrone_interaction.launching.supervised_launch import Flight, escape
from xtdrone_interaction.missions.demo import add_common_options, directed_flight, fly_directed, take_place
from xtdrone_interaction.missions.search.prepare import Prepared, SearchSettings, prepare
from xtdrone_interaction.monitoring.progress_display import Display
from xtdrone_interaction.recording.topics import SEARCH_EVENTS_TOPIC, SEARCH_PROGRESS_TOPIC

if TYPE_CHECKING:
    from xtdrone_interaction.missions.mission import Mission

_START_LIMIT = 90.0  # s of wall time until the first progress message, plus _START_LIMIT_VEHICLE per vehicle
_START_LIMIT_VEHICLE = 5.0
_LOOK_BELOW, _FOLLOW_BELOW = 2.5, 1.0  # m below the lowest vehicle: heights of the second look and of following


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    parser.description = (
        "Fly the cooperative search: the region is divided, the ground station uploads the plans to the vehicles, "
        "detectors look for people, a find is inspected a second time and followed. Leaves runs/<time>/ with "
        "flight.bag, report.html, report.json, map.png, the views as pictures and film, the plans and the world."
    )
    add = parser.add_argument
    options = SearchSettings.add_arguments
    options(parser, ("n", "type", "persons", "walking"))
    add("--region", type=Path, metavar="FILE",
        help="YAML file with region: [[x, y], ...] and holes: [...], m in map (default: the shipped one)")  # fmt: skip
    add("--plans", type=Path, metavar="FOLDER",
        help="your own VEHICLE.plan files in QGroundControl's format (default: made for the region)")  # fmt: skip
    options(parser, ("height", "on_find", "follow_time", "time_limit", "camera_rate", "film"))
    world = "your own world, by name or file (default: generated from the seed)"
    add_common_options(parser, SearchSettings, world)


def settings_of(arguments: argparse.Namespace) -> SearchSettings:
    """Return the settings of the search, after all checks that need no ROS.

    Raises:
        OptionError, FleetError: a value is not allowed.
    """
    settings = SearchSettings.from_arguments(
        arguments,
        region=_path(arguments.region, "region"),
        plans=_path(arguments.plans, "plans"),
        world=arguments.world or "",
    )
    fleet = f"{settings.type}:{settings.n}"
    parse_fleet(fleet)
    if settings.world and settings.persons != 1:
        raise OptionError("persons: they are in the world's file; leave out --persons where --world is given")
    return take_place(settings, arguments, fleet)


def _path(wanted: Path | None, name: str) -> str:
    if wanted is None:
        return ""
    if not wanted.exists():
        raise OptionError(f"{name}: {str(wanted)!r} does not exist")
    return str(wanted.resolve())


def run(arguments: argparse.Namespace) -> int:
    """Search and return the exit status."""
    return run_reported(lambda: fly(settings_of(arguments), PatientConsole()))


def fly(settings: SearchSettings, console: Console) -> int:
    """Fly the search and return the exit status.

    Raises:
        OptionError: a region, plan or world is unusable, or the height is too great to detect a person.
    """
    try:
        prepared = prepare(settings)
    except ValueError as error:
        raise OptionError(str(error)) from error
    return fly_directed(load_mission, flight(settings, prepared), settings, console)


def load_mission() -> Mission:
    """Return the kind of the flight."""
    from xtdrone_interaction.missions.search.report import SearchMission  # imports Matplotlib, which is slow

    return SearchMission()


def flight(settings: SearchSettings, prepared: Prepared) -> Flight:
    """Return the launch file with its arguments."""
    arguments = {
        "n": settings.n,
        "type": settings.type,
        "world": prepared.world_file,
        "plans": prepared.plans_folder,
        "region": prepared.region_file,
        "on_find": settings.on_find,
        "follow_time": settings.follow_time,
        "persons": ",".join(prepared.persons),
        "look_height": settings.height - _LOOK_BELOW,
        "follow_height": settings.height - _FOLLOW_BELOW,
        "time_limit": settings.time_limit,
        "camera_rate": settings.camera_rate,
        "film": str(settings.film).lower(),
    }
    return directed_flight(
        settings,
        "search.launch",
        arguments,
        show_event,
        "search_mission",
        start_limit=_START_LIMIT + _START_LIMIT_VEHICLE * settings.n,
        topics=(SEARCH_PROGRESS_TOPIC, SEARCH_EVENTS_TOPIC),
    )


# text per event that is shown to the user; formatted with the event's fields
_WORDS = {
    "second_look": "{vehicle} looks again at {place}",
    "confirmed": "[green]{vehicle} has found a person[/green] at {place}",
    "rejected": "{vehicle}: no person at {place}",
    "following": "{vehicle} follows",
    "follow_ended": "{vehicle} stops following: {reason}",
    "lost_vehicle": "[red]{vehicle} is lost[/red]: {reason}",
    "reassigned": "the rest of {vehicle}'s part is reassigned to {others}",
    "camera_silent": "[red]{vehicle}'s camera has failed[/red]",
    "returning": "{vehicle} returns: {reason}",
}


def show_event(event: dict[str, Any], display: Display) -> None:
    """Show an event of the mission control, if it is of interest to the user."""
    words = _WORDS.get(event["event"])
    if words is None:
        return
    position = event.get("position")
    place = "" if position is None else f"({position[0]:.1f}, {position[1]:.1f}) m"
    fields = {
        "vehicle": event.get("vehicle", ""),
        "reason": escape(str(event.get("reason", ""))),
        "place": place,
        "others": ", ".join(event.get("to", ())) or "no vehicle",
    }
    display.note(f"  {event['time']:6.1f} s  {words.format(**fields)}")
