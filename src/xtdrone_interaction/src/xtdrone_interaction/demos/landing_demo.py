"""``./xtdrone demo landing``: a UAV finds a ground robot that drives by its AprilTags, and lands on it.

Exit status: 0 for a landing within 0.15 m of the centre of the tags, 1 for another one or a failed flight, 2 for an
invalid value, 128 + n when stopped by signal n.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from rich.console import Console

from xtdrone_control.programs.node_command_line import speed_setting
from xtdrone_control.settings import Settings, setting
from xtdrone_interaction import command_options
from xtdrone_interaction.command_options import seed_setting, web_setting
from xtdrone_interaction.console import PatientConsole, run_reported
from xtdrone_interaction.demos.directed_flight import add_place_options, directed_flight, placed
from xtdrone_interaction.landing.robot_start import robot_start
from xtdrone_interaction.launching.supervised_launch import DemoError, Flight, escape, run_flight
from xtdrone_interaction.metrics.missions.formation_metrics import write_report
from xtdrone_interaction.monitoring.ended_nodes import EndedNodes
from xtdrone_interaction.monitoring.progress_display import Display
from xtdrone_interaction.recording.recorded_flight import RecordError

TYPE, ROBOT = "iris_landing_camera", "ugv_0"
_WORDS = {
    "tags found": "the platform is in sight: [bold]AUTO.PRECLAND[/bold]",
    "no tags found": "[yellow]no tags found: landing here[/yellow]",
    "landing given up": "[yellow]landing aborted[/yellow]",
}


@dataclass(frozen=True, kw_only=True)
class LandingDemoSettings(Settings):
    """Settings of the flight.

    Attributes:
        world: name, or absolute path of a file.
        out: folder of the results.
        master_port: TCP port of the flight's own ROS master; 0: use the running one of ROS_MASTER_URI.
        instance: number of the simulation on this machine.
    """

    ugv_speed: float = setting(1.0, low=0.0, high=1.4, unit="m/s", metavar="V", text="speed of the robot")
    ugv_turn: float = setting(0.0, low=-0.3, high=0.3, unit="rad/s", metavar="W", text="yaw rate of the robot")
    speed: float = speed_setting()
    seed: int = seed_setting("seed of all noise, and of the robot's place")
    headless: bool = setting(False, text="print lines instead of a live display")
    world: str = ""
    out: Path = Path()
    master_port: int = 0
    instance: int = 0
    web: bool = web_setting()


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    parser.description = (
        "Land on a driving robot: a UAV with a camera that looks down takes off, searches for the robot's AprilTags "
        "and lands on them by PX4's precision landing. Leaves runs/<time>/ with flight.bag, report.json, "
        "events.jsonl and "
        "landing.png."
    )
    LandingDemoSettings.add_arguments(parser, ("ugv_speed", "ugv_turn", "seed", "speed", "headless", "web"))
    command_options.add_world(parser)
    add_place_options(parser)


def run(arguments: argparse.Namespace) -> int:
    """Land and return the exit status."""
    return run_reported(lambda: fly(settings_of(arguments), PatientConsole()))


def settings_of(arguments: argparse.Namespace) -> LandingDemoSettings:
    """Return the settings, after all checks that need no ROS.

    Raises:
        OptionError: a value is not allowed.
    """
    settings = LandingDemoSettings.from_arguments(arguments, world=command_options.world(arguments.world))
    return placed(settings, arguments, f"{TYPE}:1")


def fly(settings: LandingDemoSettings, console: Console) -> int:
    """Fly the landing and return the exit status."""
    begin = time.monotonic()
    return run_flight(
        _flight(settings), console, lambda ended: _conclude(settings, console, time.monotonic() - begin, ended)
    )


def _flight(settings: LandingDemoSettings) -> Flight:
    place = ", ".join(f"{value:g}" for value in robot_start(settings.seed))
    arguments = {
        "type": TYPE,
        "robots": f"[{{name: {ROBOT}, type: ugv_tags, pose: [{place}]}}]",
        "ugv_speed": settings.ugv_speed,
        "ugv_turn": settings.ugv_turn,
    }
    return directed_flight(settings, "landing.launch", arguments, _show_event)


def _show_event(event: dict[str, Any], display: Display) -> None:
    words = _WORDS.get(event["event"])
    if words is not None:
        display.note(f"  {event['time']:6.1f} s  {words}")


def _conclude(settings: LandingDemoSettings, console: Console, wall_time: float, ended_nodes: EndedNodes) -> int:
    unstored = ("out", "master_port", "headless", "instance", "web")
    stored = {key: value for key, value in asdict(settings).items() if key not in unstored}
    report = report_of(settings.out / "flight.bag", {**stored, "wall_time": wall_time})
    ended = [str(node) for node in ended_nodes.found.values() if node.matters]
    report["shortcomings"] = [*ended, *report["shortcomings"]]
    print_landing(report, console)  # first: the disk may be full
    write_report(report, settings.out / "report.json")
    for name in ("flight.bag", "report.json", "landing.png"):
        console.print(f"  {settings.out / name}", highlight=False, soft_wrap=True)
    return 1 if report["shortcomings"] else 0


def report_of(bag: Path, settings: dict[str, Any]) -> dict[str, Any]:
    """Return the report of a recorded landing, and draw landing.png beside the bag.

    Raises:
        DemoError: the bag is not the record of a landing.
    """
    from xtdrone_interaction.landing.landing_accuracy import (  # imports matplotlib, which is slow
        make_report,
        read_landing,
    )
    from xtdrone_interaction.pictures.missions.landing_picture import save_landing

    try:
        record = read_landing(bag, f"{TYPE}_0", ROBOT)
    except RecordError as error:
        raise DemoError(str(error)) from error
    report = make_report(record, settings)
    save_landing(record, report, bag.parent / "landing.png")
    return report


def report_again(bag: Path, console: Console) -> int:
    """Make the report of a recorded landing again and return the exit status.

    Raises:
        DemoError: it cannot be read.
    """
    file = bag.parent / "report.json"
    try:
        known = json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        known = {}
    report = report_of(bag, known.get("settings", {}))
    write_report(report, file)
    print_landing(report, console)
    return 1 if report["shortcomings"] else 0


def is_landing(bag: Path) -> bool:
    """Return whether the events beside a bag are those of a landing."""
    from xtdrone_interaction.formation.flight_events import EVENTS_FILE, read_events

    try:
        events = read_events(bag.parent / EVENTS_FILE)
    except ValueError:
        return False
    return bool(events) and "ugv_speed" in events[0]


def print_landing(report: dict[str, Any], console: Console) -> None:
    """Print the figures of a landing."""
    touch = report["touchdown"]
    if touch is not None:
        console.print(
            f"Touchdown {touch['error']:.3f} m from the centre of the tags, {touch['horizontal_velocity']:.2f} m/s "
            f"across and {-touch['vertical_velocity']:.2f} m/s down relative to the robot, "
            f"{report['landing_time']:.1f} s after the tags were found; "
            f"in sight in {100 * report['in_sight']:.0f} % of the images since.",
            highlight=False, soft_wrap=True,
        )  # fmt: skip
    for text in report["shortcomings"]:
        console.print(f"[red]Missed:[/red] {escape(text)}", highlight=False, soft_wrap=True)
