"""What the demos share: settings, options, the launch, and the way from the flight to its report."""

from __future__ import annotations

import argparse
import contextlib
import json
import math
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, TypeVar

from rich.console import Console

from xtdrone_common.files import write_whole
from xtdrone_common.programs.node_command_line import speed_setting
from xtdrone_common.settings import Settings, setting
from xtdrone_interaction import command_options
from xtdrone_interaction.command_options import MachineSettings, OptionError, seed_setting, web_setting
from xtdrone_interaction.launching.flown_script import fly_script
from xtdrone_interaction.launching.supervised_launch import (
    DemoError,
    Flight,
    Launch,
    escape,
    master_port,
    run_flight,
    run_launch,
    watching,
)
from xtdrone_interaction.monitoring.ended_nodes import EndedNodes
from xtdrone_interaction.monitoring.progress_display import Display
from xtdrone_interaction.recording.topics import EVENTS_TOPIC, PROGRESS_TOPIC

if TYPE_CHECKING:
    from xtdrone_interaction.missions.mission import Mission

BAG = "flight.bag"
_START_LIMIT = 180.0  # s of wall time until the first progress message; kernels may have to be compiled
_TIMINGS = "planning_times.json"
_COMMON = ("seed", "speed", "headless", "logs", "web")
_Settings = TypeVar("_Settings", bound="DemoSettings")


@dataclass(frozen=True, kw_only=True)
class DemoSettings(Settings):
    """Settings of every demo.

    Attributes:
        world: Name, or absolute path of a file.
        out: Folder of the results.
        master_port: TCP port of the flight's own ROS master; 0: use the running one of ROS_MASTER_URI.
        instance: Number of the simulation on this machine.
    """

    UNSTORED: ClassVar[tuple[str, ...]] = ("out", "master_port", "headless", "instance", "web")
    """Settings that are not stored in the report."""

    world: str = ""
    seed: int = seed_setting()
    speed: float = speed_setting()
    headless: bool = setting(False, text="no live display; print a progress line every few seconds")
    logs: bool = setting(False, text="write the vehicles' flight logs (PX4's ULog) to logs/ in the results")
    web: bool = web_setting()
    out: Path = Path()
    master_port: int = 0
    instance: int = 0

    def stored(self, begin: float) -> dict[str, Any]:
        """Return the settings stored in the report of a flight whose command began at ``begin``, s, monotonic."""
        kept = {key: value for key, value in asdict(self).items() if key not in self.UNSTORED}
        return {**kept, "wall_time": time.monotonic() - begin}

    def launch_arguments(self) -> dict[str, Any]:
        """Return the arguments that all launch files take."""
        return {
            "world": self.world,
            "seed": self.seed,
            "speed": self.speed,
            **({"log": self.out / "logs"} if self.logs else {}),
            **({"instance": self.instance} if self.instance else {}),
            **({"web": "true"} if self.web else {}),
        }


def add_common_options(parser: argparse.ArgumentParser, settings: type[DemoSettings], world: str = "") -> None:
    """Add the options that all demos take.

    Args:
        parser: Parser of the demo.
        settings: Settings of the demo.
        world: Help of --world without a default; "" for a world by its name that is empty by default.
    """
    settings.add_arguments(parser, _COMMON)
    if world:
        parser.add_argument("--world", metavar="WORLD", help=world)
    else:
        command_options.add_world(parser)
    parser.add_argument("--out", type=Path, metavar="FOLDER", help="new folder for the results (default: runs/<time>)")
    command_options.add_master(parser)
    command_options.add_instance(parser)


def take_place(settings: _Settings, arguments: argparse.Namespace, fleet: str) -> _Settings:
    """Return validated settings with results folder, master and instance.

    Raises:
        OptionError: a value is not allowed.
    """
    machine = MachineSettings.from_arguments(arguments)
    return replace(
        settings,
        out=command_options.results_folder(arguments.out, recorded=True),
        master_port=master_port(machine.master_port, use_running=arguments.use_master),
        instance=command_options.take_instance(fleet, machine.instance),
    )


def parse_numbers(text: object, counts: tuple[int, ...], example: str) -> tuple[float, ...]:
    """Parse numbers with commas between, m in map.

    Raises:
        ValueError: not allowed; the text states what is.
    """
    try:
        values = tuple(float(part) for part in str(text).split(","))
    except ValueError:
        values = ()
    if len(values) not in counts or not all(map(math.isfinite, values)):
        raise ValueError(f"{' or '.join(map(str, counts))} comma-separated numbers, e.g. {example}, m in map")
    return values


def parse_start(text: object) -> tuple[float, ...]:
    """Parse a start, x and y, m in map."""
    return parse_numbers(text, (2,), "14,5")


def check_script(script: Path) -> Path:
    """Return the absolute path of a script.

    Raises:
        OptionError: there is no such script.
    """
    if script.suffix != ".py" or not script.is_file():
        raise OptionError(f"script: {str(script)!r} is not allowed, an existing .py file")
    return script.resolve()


def directed_flight(
    settings: DemoSettings,
    file: str,
    arguments: Mapping[str, Any],
    show_event: Callable[[dict[str, Any], Display], None],
    director: str,
    *,
    start_limit: float = _START_LIMIT,
    topics: tuple[str, str] = (PROGRESS_TOPIC, EVENTS_TOPIC),
    last_events: tuple[str, ...] = ("finished",),
) -> Flight:
    """Return the launch of a flight with a director.

    Args:
        settings: Settings of the demo.
        file: Launch file.
        arguments: Arguments of the launch file, besides those of all demos.
        show_event: Displays the director's events that are relevant to the user.
        director: Name of the director's node, without which the flight cannot continue.
        start_limit: Maximum wall time until the first progress message, s.
        topics: Topics of the progress and of the events.
        last_events: Events that end the flight.
    """
    return Flight(
        file=file,
        arguments={**settings.launch_arguments(), **arguments, "out": settings.out},
        out=settings.out,
        bag=BAG,
        master_port=settings.master_port,
        headless=settings.headless,
        instance=settings.instance,
        start_limit=start_limit,
        progress_topic=topics[0],
        events_topic=topics[1],
        last_events=last_events,
        show_event=show_event,
        vital=(director,),
    )


def fly_directed(
    load: Callable[[], Mission], flight: Flight, settings: DemoSettings, console: Console, *, film: bool = False
) -> int:
    """Fly, and write the report.

    Args:
        load: Returns the kind of the flight, for its report; imports Matplotlib, which is slow.
        flight: Launch of the flight.
        settings: Settings of the demo.
        console: Console that shows progress and report.
        film: Whether to film the recorded flight.

    Returns:
        The exit status: 0 for a good flight, 1 for one that failed or fell short, 128 + signal when stopped.
    """
    begin = time.monotonic()

    def conclude(ended_nodes: EndedNodes) -> int:
        last = flight.events()[-1:]  # none on a full disk
        if last and last[0]["event"] == "failed":
            raise DemoError(last[0]["reason"])
        return _conclude(load(), settings, begin, ended_nodes, console, film=film)

    return run_flight(flight, console, conclude)


def scripted_launch(settings: DemoSettings, file: str, arguments: Mapping[str, Any]) -> Launch:
    """Return the launch of a flight by a script; see :func:`directed_flight`."""
    return Launch(
        file,
        {**settings.launch_arguments(), **arguments},
        settings.out,
        settings.master_port,
        headless=settings.headless,
        instance=settings.instance,
    )


def fly_scripted(
    load: Callable[[], Mission], launch: Launch, command: list[Path | str], settings: DemoSettings, console: Console
) -> int:
    """Run a script that flies the vehicles of a launch, and write the report; see :func:`fly_directed`."""
    begin = time.monotonic()

    def fly() -> int:
        ended_nodes = EndedNodes(launch.log)
        with watching(launch, console, ended_nodes, {}) as watch:
            status = fly_script(command, launch, watch)
        if status:
            raise DemoError(f"{Path(command[0]).name} has ended with status {status}")
        return _conclude(load(), settings, begin, ended_nodes, console)

    return run_launch(launch, console, fly)


def _conclude(
    mission: Mission, settings: DemoSettings, begin: float, ended_nodes: EndedNodes, console: Console,
    *, film: bool = False,
) -> int:  # fmt: skip
    from xtdrone_interaction.missions.mission import film_file, make_report, save_report
    from xtdrone_interaction.report.html_page import print_page

    stored = settings.stored(begin)
    if mission.settings_file:
        write_whole(settings.out / mission.settings_file, json.dumps(stored, indent=2) + "\n")
    made = make_report(mission, settings.out / BAG, stored, list(ended_nodes.found.values()))
    print_page(made.page, console)  # first: the disk may be full
    return save_report(made, settings.out, console, film_file(settings.out) if film else None)


def show_landing(event: dict[str, Any], display: Display) -> None:
    """Show the outcome of a vehicle's flight."""
    if event.get("outcome") and event["event"] == "landing":
        display.note(f"  {event['time']:6.1f} s  {event['vehicle']}: {escape(str(event['outcome']))}")


def planning_times(folder: Path) -> dict[str, Any]:
    """Return the planners' computation times from a results folder; empty if there are none."""
    times: dict[str, Any] = {}
    with contextlib.suppress(FileNotFoundError, ValueError):
        times = json.loads((folder / _TIMINGS).read_text(encoding="utf-8"))
    return times
