"""Fly the cooperative search: run launch/search.launch, show its progress, and write the report, map and pictures."""

from __future__ import annotations

import contextlib
import json
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from rich.console import Console

from xtdrone_interaction.command_options import OptionError
from xtdrone_interaction.demos.search.search_prepare import Prepared, SearchSettings, prepare, read_prepared
from xtdrone_interaction.launching.supervised_launch import DemoError, Flight, escape, run_flight
from xtdrone_interaction.metrics.missions.formation_metrics import write_report
from xtdrone_interaction.metrics.missions.search_metrics import make_report
from xtdrone_interaction.monitoring.ended_nodes import EndedNode, EndedNodes
from xtdrone_interaction.monitoring.progress_display import Display
from xtdrone_interaction.recording.missions.search_record import EVENTS_TOPIC, PROGRESS_TOPIC, read_search
from xtdrone_interaction.recording.recorded_flight import RecordError
from xtdrone_interaction.report.printed_results import print_search

_START_LIMIT = 90.0  # s of wall time until the first progress message, plus _START_LIMIT_VEHICLE per vehicle
_START_LIMIT_VEHICLE = 5.0
_RESULTS = ("report.json", "map.png", "find.png", "views.png", "views.mp4")
_LOOK_BELOW, _FOLLOW_BELOW = 2.5, 1.0  # m below the lowest vehicle: heights of the second look and of following


def run_search(settings: SearchSettings, console: Console) -> int:
    """Fly the search.

    Returns:
        The exit status: 0 for a successful search, 1 for one that failed or missed a person, 128 + signal when stopped.

    Raises:
        OptionError: a region, plan or world is unusable, or the height is too great to detect a person.
    """
    begin = time.monotonic()
    try:
        prepared = prepare(settings)
    except ValueError as error:
        raise OptionError(str(error)) from error
    return run_flight(
        flight(settings, prepared),
        console,
        lambda ended_nodes: _conclude(settings, prepared, console, time.monotonic() - begin, ended_nodes),
    )


def flight(settings: SearchSettings, prepared: Prepared) -> Flight:
    """Return the launch file with its arguments."""
    return Flight(
        file="search.launch",
        arguments={
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
            "seed": settings.seed,
            "speed": settings.speed,
            "out": settings.out,
            "log": settings.out / "logs" if settings.logs else "",
            **({"instance": settings.instance} if settings.instance else {}),
            **({"web": "true"} if settings.web else {}),
        },
        out=settings.out,
        bag="flight.bag",
        master_port=settings.master_port,
        headless=settings.headless,
        instance=settings.instance,
        start_limit=_START_LIMIT + _START_LIMIT_VEHICLE * settings.n,
        progress_topic=PROGRESS_TOPIC,
        events_topic=EVENTS_TOPIC,
        last_events=("finished",),
        show_event=show_event,
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


def _conclude(
    settings: SearchSettings, prepared: Prepared, console: Console, wall_time: float, ended_nodes: EndedNodes
) -> int:
    """Write the report and map of the finished search and return the exit status."""
    stored = {**settings.stored(), "wall_time": wall_time}
    return _report(settings.out / "flight.bag", prepared, stored, console, list(ended_nodes.found.values()))


def report_again(bag: Path, console: Console) -> int:
    """Rewrite the report and map of a recorded search; keep entries that are only in the earlier report.

    Args:
        bag: in a results folder, beside the files prepared for the search.
        console: prints the figures.

    Returns:
        The exit status, as :func:`run_search`; 1 for a search that was cut short.

    Raises:
        DemoError: it cannot be read.
    """
    known: dict[str, Any] = {}
    with contextlib.suppress(FileNotFoundError, ValueError):
        known = json.loads((bag.parent / "report.json").read_text(encoding="utf-8"))
    try:
        prepared = read_prepared(bag.parent)
    except ValueError as error:
        raise DemoError(str(error)) from error
    ended_nodes = [EndedNode(**ended) for ended in known.get("died", [])]
    return _report(bag, prepared, known.get("settings", {}), console, ended_nodes)


def _report(
    bag: Path, prepared: Prepared, settings: Mapping[str, Any], console: Console, ended_nodes: Sequence[EndedNode]
) -> int:
    """Write report.json and map.png beside the bag, print the figures, and return the exit status.

    Raises:
        DemoError: the bag is not the record of a search.
    """
    from xtdrone_interaction.pictures.missions.search_map import save_map  # matplotlib takes a while to import

    folder = bag.parent
    try:
        record = read_search(bag, prepared.names, prepared.persons)
    except RecordError as error:
        raise DemoError(str(error)) from error
    report = make_report(record, dict(settings))
    report["died"] = [asdict(ended) for ended in ended_nodes]
    report["shortcomings"] = [*(str(ended) for ended in ended_nodes if ended.matters), *report["shortcomings"]]
    print_search(report, console)  # first: the disk may be full
    write_report(report, folder / "report.json")
    save_map(record, prepared.region, prepared.pieces, prepared.ways, folder / "map.png")
    for file in (bag, *(folder / name for name in _RESULTS)):
        if file.exists():
            console.print(f"  {file}", highlight=False, soft_wrap=True)
    console.print(
        f"./xtdrone record-view search --bag {bag} films it as rviz shows it", highlight=False, soft_wrap=True
    )
    return 1 if report["shortcomings"] else 0
