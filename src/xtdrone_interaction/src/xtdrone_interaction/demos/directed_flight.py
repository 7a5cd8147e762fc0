"""Common parts of demos with a director node: flight, options, and regenerated reports."""

from __future__ import annotations

import argparse
import contextlib
import json
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Protocol, TypeVar

from xtdrone_interaction import command_options
from xtdrone_interaction.command_options import MachineSettings
from xtdrone_interaction.formation.shared_topics_and_names import EVENTS_TOPIC, PROGRESS_TOPIC
from xtdrone_interaction.launching.supervised_launch import DemoError, Flight, escape, master_port
from xtdrone_interaction.monitoring.progress_display import Display

_START_LIMIT = 180.0  # s of wall time until the first progress message; kernels may have to be compiled
_TIMINGS = "planning_times.json"


class DirectedDemo(Protocol):
    """Settings common to these demos."""

    @property
    def world(self) -> str:
        """Name or file of the world."""

    @property
    def seed(self) -> int:
        """Seed of all noise."""

    @property
    def speed(self) -> Any:
        """Target real-time factor."""

    @property
    def out(self) -> Path:
        """Folder of the results."""

    @property
    def master_port(self) -> int:
        """TCP port of the flight's own ROS master; 0: use the running one of ROS_MASTER_URI."""

    @property
    def headless(self) -> bool:
        """Whether to print lines instead of a live display."""

    @property
    def instance(self) -> int:
        """Number of the simulation on this machine."""

    @property
    def web(self) -> bool:
        """Whether the flight is served to a browser."""


Show = Callable[[dict[str, Any], Display], None]
_Settings = TypeVar("_Settings", bound=Any)


def directed_flight(settings: DirectedDemo, file: str, arguments: Mapping[str, Any], show_event: Show) -> Flight:
    """Return a demo's launch.

    Args:
        settings: of the demo.
        file: launch file.
        arguments: of the launch file, in addition to those of ``DirectedDemo``.
        show_event: displays the director's events that are relevant to the user.
    """
    return Flight(
        file=file,
        arguments={
            **arguments,
            "world": settings.world,
            "seed": settings.seed,
            "speed": settings.speed,
            "out": settings.out,
            **({"instance": settings.instance} if settings.instance else {}),
            **({"web": "true"} if settings.web else {}),
        },
        out=settings.out,
        bag="flight.bag",
        master_port=settings.master_port,
        headless=settings.headless,
        instance=settings.instance,
        start_limit=_START_LIMIT,
        progress_topic=PROGRESS_TOPIC,
        events_topic=EVENTS_TOPIC,
        last_events=("finished",),
        show_event=show_event,
    )


def show_landing(event: dict[str, Any], display: Display) -> None:
    """Show the outcome of a vehicle's flight."""
    if event.get("outcome") and event["event"] == "landing":
        display.note(f"  {event['time']:6.1f} s  {event['vehicle']}: {escape(str(event['outcome']))}")


def add_place_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of results, master and instance."""
    parser.add_argument("--out", type=Path, metavar="FOLDER", help="new folder for the results (default: runs/<time>)")
    command_options.add_master(parser)
    command_options.add_instance(parser)


def placed(settings: _Settings, arguments: argparse.Namespace, fleet: str) -> _Settings:
    """Return validated settings with results folder, master and instance.

    Raises:
        OptionError: a value is not allowed.
    """
    machine = MachineSettings.from_arguments(arguments)
    done: _Settings = replace(
        settings,
        out=command_options.results_folder(arguments.out, recorded=True),
        master_port=master_port(machine.master_port, use_running=arguments.use_master),
        instance=command_options.take_instance(fleet, machine.instance),
    )
    return done


def stored_settings(file: Path) -> dict[str, Any]:
    """Return the settings stored beside a bag.

    Raises:
        DemoError: they cannot be read.
    """
    try:
        settings: dict[str, Any] = json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise DemoError(f"{file}: {error}") from error
    return settings


def planning_times(folder: Path) -> dict[str, Any]:
    """Return the planners' computation times from a results folder; empty if there are none."""
    times: dict[str, Any] = {}
    with contextlib.suppress(FileNotFoundError, ValueError):
        times = json.loads((folder / _TIMINGS).read_text(encoding="utf-8"))
    return times
