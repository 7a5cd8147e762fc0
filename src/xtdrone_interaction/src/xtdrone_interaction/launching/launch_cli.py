"""``./xtdrone launch``: run a launch file; report when it is ready and which nodes die.

Exit status: 0 after a clean end, 1 when a node has died or the launch has failed, 2 for an invalid value,
128 + n when stopped by signal n.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console

from xtdrone_common.fleet import INSTANCE_STEP, FleetError, instance_port
from xtdrone_common.settings import Settings, setting
from xtdrone_interaction import command_options
from xtdrone_interaction.command_options import OptionError, parse_instance
from xtdrone_interaction.console import PatientConsole
from xtdrone_interaction.launching import launch_file
from xtdrone_interaction.launching.launch_file import LaunchFile
from xtdrone_interaction.launching.supervised_launch import (
    DemoError,
    Launch,
    Watch,
    check_progress,
    escape,
    master_port,
    print_log_errors,
    run_launch,
    watching,
)
from xtdrone_interaction.monitoring.ended_nodes import EndedNodes

_START_LIMIT = 60.0  # s of wall time without progress before it is ready


@dataclass(frozen=True)
class LaunchSettings(Settings):
    """Ports of a launched simulation on this machine."""

    instance: int | None = setting(
        None,
        parse=parse_instance,
        metavar="N",
        text="number of this simulation on this machine: moves the UDP ports, and --port, by N x "
        f"{INSTANCE_STEP} (default: 0)",
    )
    master_port: int | None = setting(
        None,
        low=1024,
        high=65535,
        option="--port",
        metavar="PORT",
        text="TCP port of its own ROS master (default: a free one)",
    )


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    parser.description = (
        "Run a launch file with its own ROS master until it ends or Ctrl-C is pressed. Reports when all nodes "
        "have joined, and each node that dies with the path of its log. Exit status 0 only after a clean end."
    )
    add = parser.add_argument
    add("file", metavar="FILE", help="a launch file, or the name of one of launch/")
    add("arguments", nargs="*", metavar="NAME:=VALUE", help="arguments of the launch file; unknown ones are rejected")
    add("--out", "--log-dir", type=Path, metavar="FOLDER", dest="out",
        help="new folder for the logs (default: runs/<time>)")  # fmt: skip
    LaunchSettings.add_arguments(parser, ("instance",))
    master = parser.add_mutually_exclusive_group()
    LaunchSettings.add_arguments(master, ("master_port",))
    master.add_argument("--use-master", action="store_true", help="use the running master of ROS_MASTER_URI")


def parse(parser: argparse.ArgumentParser, words: Sequence[str]) -> argparse.Namespace:
    """Parse a command line in which options may stand between the arguments of the launch file."""
    return parser.parse_intermixed_args(list(words))


def _prepare(words: argparse.Namespace) -> tuple[LaunchFile, Launch]:
    """Return the launch file and how it is run, after all checks that need no master.

    Raises:
        OptionError, FleetError: a value is not allowed.
    """
    path = launch_file.find(words.file)
    arguments = launch_file.split_arguments(words.arguments)
    settings = LaunchSettings.from_arguments(words)
    if settings.instance is not None:
        if arguments.get("instance", str(settings.instance)) != str(settings.instance):
            raise OptionError(
                f"instance: --instance {settings.instance} and instance:={arguments['instance']} contradict"
            )
        arguments["instance"] = str(settings.instance)
    launch_file.check_arguments(path, arguments)
    file = launch_file.load(path, arguments)
    vehicles = file.vehicles
    instance = vehicles[0].instance if vehicles else 0
    if file.has_mavlink:
        command_options.take_instance(file.fleet, instance, with_mavros=file.has_mavros, ports=file.ports)
    port = instance_port(settings.master_port, instance) if settings.master_port else None
    number = master_port(port, use_running=words.use_master)
    out = command_options.results_folder(words.out)
    return file, Launch(str(path), arguments, out, number, True, instance, needs_all=False)


def _run(file: LaunchFile, launch: Launch, console: Console) -> int:
    """Run a launch file to its end and return the exit status."""
    ended_nodes = EndedNodes(launch.log)

    def go() -> int:
        vehicles = [vehicle.name for vehicle in file.vehicles]
        with watching(launch, console, ended_nodes, {}, vehicles) as watch:
            _Monitor(file, launch, watch).run()
        if ended_nodes.failure is not None or any(ended.matters and ended.died for ended in ended_nodes.all()):
            console.print("[red]Error:[/red] not all processes have ended cleanly", highlight=False)
            print_log_errors(launch, console)
            return 1
        return 0

    return run_launch(launch, console, go)


class _Monitor:
    """Messages on the terminal while a launch runs."""

    def __init__(self, file: LaunchFile, launch: Launch, watch: Watch) -> None:
        self._file = file
        self._launch = launch
        self._watch = watch
        self._ready = False

    def run(self) -> None:
        """Watch the launch until it has ended.

        Raises:
            DemoError: it does not start.
        """
        watch = self._watch
        while watch.running():
            for message in watch.poll(starting=not self._ready):
                self._show(message)
            if not self._ready and self._is_ready():
                self._ready = True
                watch.display.note(self._ready_words())
            if not self._ready:
                check_progress(watch, _START_LIMIT, "the launch is not ready: no progress")
        watch.show_ended_nodes()
        if not watch.started():
            raise DemoError("roslaunch ended before it started a node")

    def _show(self, message: dict[str, Any]) -> None:
        if message["kind"] == "estimators":
            time = message["time"]
            self._watch.display.note(f"[green]estimators ready[/green] at {time:.1f} s: every vehicle can be armed")

    def _is_ready(self) -> bool:
        if not self._file.has_simulator:
            return self._watch.startup.started >= len(self._file.nodes)
        return self._watch.startup.runs and self._watch.status is not None

    def _ready_words(self) -> str:
        uri, logs = self._launch.master_uri, self._launch.out / "logs"
        if not self._file.has_simulator:
            return escape(f"ready: {len(self._file.nodes)} nodes; ROS master {uri}; logs {logs}")
        startup = self._watch.startup
        parts = [self._file.fleet]
        world = self._file.of_simulator("world")
        if world:
            parts.append(f"world {world}")
        parts.append(_speed_words(self._file.of_simulator("speed"), paused=bool(self._file.of_simulator("paused"))))
        if startup.joined:
            parts.append(f"{startup.joined} participant{'s' * (startup.joined > 1)}")
        parts += [f"ROS master {uri}", *self._ports(), f"logs {logs}"]
        return escape("ready: " + "; ".join(parts))

    def _ports(self) -> list[str]:
        if not self._file.has_mavlink:
            return []
        first, last = self._file.vehicles[0], self._file.vehicles[-1]
        return [
            f"UDP ground stations {_range(first.gcs_local_port, last.gcs_local_port)} -> {first.gcs_remote_port}",
            f"offboard {_range(first.offboard_local_port, last.offboard_local_port)} -> "
            f"{_range(first.offboard_remote_port, last.offboard_remote_port)}",
        ]


def _range(first: int, last: int) -> str:
    return str(first) if first == last else f"{first}-{last}"


def _speed_words(speed: Any, *, paused: bool) -> str:
    text = "as fast as it goes" if not speed else f"{float(speed):g} x real time"
    return f"{text}, paused" if paused else text


def run(arguments: argparse.Namespace) -> int:
    """Run a launch file and return the exit status."""
    try:
        file, launch = _prepare(arguments)
        return _run(file, launch, PatientConsole())
    except (OptionError, FleetError) as error:
        print(f"xtdrone launch: {error}", file=sys.stderr)
        return 2
    except OSError as error:
        print(f"xtdrone launch: {error.filename or 'system'}: {error.strerror or error}", file=sys.stderr)
        return 1
