"""Runs launch/search.launch to its end, shows its progress and makes the report, the map and the pictures."""

from __future__ import annotations

import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from rich.console import Console

from xtdrone_interaction.deaths import Deaths
from xtdrone_interaction.display import Display
from xtdrone_interaction.launched import DemoError, Flight, escape, run_flight
from xtdrone_interaction.record import RecordError
from xtdrone_interaction.report import write_report
from xtdrone_interaction.search_prepare import Prepared, prepare
from xtdrone_interaction.search_record import EVENTS_TOPIC, PROGRESS_TOPIC, read_search
from xtdrone_interaction.search_report import make_report, print_report

_START_LIMIT = 90.0  # wall s until the first progress, and _START_LIMIT_VEHICLE more for each vehicle
_START_LIMIT_VEHICLE = 5.0
_LOOK_BELOW, _FOLLOW_BELOW = 2.5, 1.0  # m from the lowest vehicle's height down to those of looks and following


@dataclass(frozen=True)
class SearchSettings:
    """What is flown, and how.

    Attributes:
        n: number of vehicles.
        type: vehicle type.
        region: YAML file with the region, or empty for the shipped one.
        plans: folder with the user's own .plan files, or empty: they are made for the region.
        world: name or file, or empty: one is made from the seed.
        persons: how many stand or walk in the world that is made.
        walking: whether they walk.
        height: of the lowest vehicle while it searches, m.
        on_find: what the others do after a find: ``hold``, ``return`` or ``continue``.
        follow_time: for how long a found person is followed, s.
        time_limit: simulated time after which all return, s.
        camera_rate: pictures of each camera, Hz.
        film: make views.mp4.
        seed: of world, sensor noise and biases.
        speed: target real-time factor, 0 for unlimited.
        out: folder of the results.
        master_port: TCP port of the flight's own ROS master; 0: the one of ROS_MASTER_URI, which runs already.
        headless: plain lines instead of the live display.
        logs: write the vehicles' flight logs into ``out / "logs"``.
    """

    n: int
    type: str
    region: str
    plans: str
    world: str
    persons: int
    walking: bool
    height: float
    on_find: str
    follow_time: float
    time_limit: float
    camera_rate: float
    film: bool
    seed: int
    speed: float
    out: Path
    master_port: int
    headless: bool
    logs: bool

    def stored(self) -> dict[str, Any]:
        """Return what the report keeps of it."""
        return {key: value for key, value in asdict(self).items() if key not in ("out", "master_port", "headless")}


def run_search(settings: SearchSettings, console: Console) -> int:
    """Search.

    Returns:
        The exit status: 0 for a search that went well, 1 for one that failed or found nobody where somebody is,
        128 + signal when stopped.

    Raises:
        ValueError: a region, plan or world that cannot be used.
    """
    begin = time.monotonic()
    settings.out.mkdir(parents=True, exist_ok=True)
    prepared = prepare(settings)
    return run_flight(
        flight(settings, prepared),
        console,
        lambda deaths: _conclude(settings, prepared, console, time.monotonic() - begin, deaths),
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
        },
        out=settings.out,
        bag="flight.bag",
        master_port=settings.master_port,
        headless=settings.headless,
        start_limit=_START_LIMIT + _START_LIMIT_VEHICLE * settings.n,
        progress_topic=PROGRESS_TOPIC,
        events_topic=EVENTS_TOPIC,
        last_events=("finished",),
        show_event=show_event,
    )


# what a user wants to read of an event; filled with its fields
_WORDS = {
    "second_look": "{vehicle} looks again at {place}",
    "confirmed": "[green]{vehicle} has found a person[/green] at {place}",
    "rejected": "{vehicle}: nobody at {place}",
    "following": "{vehicle} follows",
    "follow_ended": "{vehicle} has ended following: {reason}",
    "lost_vehicle": "[red]{vehicle} is lost[/red]: {reason}",
    "reassigned": "what is left of {vehicle}'s part goes to {others}",
    "camera_silent": "[red]{vehicle}'s camera is silent[/red]",
    "returning": "{vehicle} returns: {reason}",
}


def show_event(event: dict[str, Any], display: Display) -> None:
    """Show an event of the mission control that a user wants to read."""
    words = _WORDS.get(event["event"])
    if words is None:
        return
    position = event.get("position")
    place = "" if position is None else f"({position[0]:.1f}, {position[1]:.1f}) m"
    fields = {
        "vehicle": event.get("vehicle", ""),
        "reason": escape(str(event.get("reason", ""))),
        "place": place,
        "others": ", ".join(event.get("to", ())) or "nobody",
    }
    display.note(f"  {event['time']:6.1f} s  {words.format(**fields)}")


def _conclude(settings: SearchSettings, prepared: Prepared, console: Console, wall_time: float, deaths: Deaths) -> int:
    """Make report, map and pictures of the finished search and return the exit status."""
    from xtdrone_interaction.search_map import save_map  # matplotlib takes a while to import

    bag = settings.out / "flight.bag"
    try:
        record = read_search(bag, prepared.names, prepared.persons)
        report = make_report(record, {**settings.stored(), "wall_time": wall_time})
    except RecordError as error:
        raise DemoError(str(error)) from error
    died = list(deaths.found.values())
    report["died"] = [asdict(death) for death in died]
    report["shortcomings"] = [*(str(death) for death in died if death.matters), *report["shortcomings"]]
    write_report(report, settings.out / "report.json")
    save_map(record, prepared.region, prepared.pieces, prepared.ways, settings.out / "map.png")
    print_report(report, console)
    for name in ("flight.bag", "report.json", "map.png", "find.png", "views.png", "views.mp4"):
        if (settings.out / name).exists():
            console.print(f"  {settings.out / name}", highlight=False, soft_wrap=True)
    return 1 if report["shortcomings"] else 0
