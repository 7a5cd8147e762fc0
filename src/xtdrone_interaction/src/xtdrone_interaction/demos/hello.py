"""``./xtdrone demo hello``: one vehicle takes off, flies a square and lands, by a script that is shown.

Exit status: 0 for a flight to its end, 1 if the script or the launch has failed, 2 for an invalid value,
128 + n when stopped by signal n.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console
from rich.syntax import Syntax

from xtdrone_control.programs.node_command_line import speed_setting
from xtdrone_control.settings import Settings
from xtdrone_interaction import command_options
from xtdrone_interaction.command_options import MachineSettings, OptionError, seed_setting, web_setting
from xtdrone_interaction.console import PatientConsole, run_reported
from xtdrone_interaction.launching.flown_script import fly_script
from xtdrone_interaction.launching.supervised_launch import DemoError, Launch, master_port, run_launch, watching
from xtdrone_interaction.monitoring.ended_nodes import EndedNodes

FLEET = "iris:1"
SCRIPT = command_options.repository() / "src" / "xtdrone_control" / "examples" / "hello.py"


@dataclass(frozen=True, kw_only=True)
class HelloSettings(Settings):
    """Settings of the flight.

    Attributes:
        script: the file that flies the vehicle.
        world: name, or absolute path of a file.
        out: folder of the logs.
        master_port: TCP port of the flight's own ROS master.
        instance: number of the simulation on this machine.
    """

    script: Path
    world: str
    speed: float = speed_setting()
    seed: int = seed_setting()
    web: bool = web_setting()
    out: Path
    master_port: int
    instance: int


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    parser.description = (
        "Fly one vehicle: up, a square, down. The script that flies it is shown first; copy it, change it, and fly "
        "your copy with --script."
    )
    parser.add_argument(
        "--script", type=Path, default=SCRIPT, metavar="FILE.py", help="script that flies iris_0 (default: the example)"
    )
    HelloSettings.add_arguments(parser, ("speed", "seed", "web"))
    command_options.add_world(parser)
    parser.add_argument("--out", type=Path, metavar="FOLDER", help="new folder for the logs (default: runs/<time>)")
    MachineSettings.add_arguments(parser, ("master_port",))
    command_options.add_instance(parser)


def run(arguments: argparse.Namespace) -> int:
    """Fly and return the exit status."""
    return run_reported(lambda: _fly(_settings(arguments), PatientConsole()))


def _settings(arguments: argparse.Namespace) -> HelloSettings:
    """Return the settings, after all checks that need no ROS.

    Raises:
        OptionError: a value is not allowed.
    """
    script: Path = arguments.script
    if script.suffix != ".py" or not script.is_file():
        raise OptionError(f"script: {str(script)!r} is not allowed, an existing .py file")
    machine = MachineSettings.from_arguments(arguments)
    return HelloSettings.from_arguments(
        arguments,
        script=script.resolve(),
        world=command_options.world(arguments.world),
        out=command_options.results_folder(arguments.out),
        master_port=master_port(machine.master_port, use_running=False),
        instance=command_options.take_instance(FLEET, machine.instance),
    )


def _fly(settings: HelloSettings, console: Console) -> int:
    from xtdrone_control.drone.script_node import NODE  # rospy is slow to import

    launch = Launch(
        "multi_vehicle.launch",
        {
            "vehicles": FLEET,
            "world": settings.world,
            "speed": settings.speed,
            "seed": settings.seed,
            "participants": f"/mavros,/{NODE}",
            **({"instance": settings.instance} if settings.instance else {}),
            **({"web": "true"} if settings.web else {}),
        },
        settings.out,
        settings.master_port,
        headless=True,
        instance=settings.instance,
    )
    text = settings.script.read_text(encoding="utf-8")
    console.print(f"{_shown(settings.script)}:", highlight=False, soft_wrap=True)
    console.print(Syntax(text.strip(), "python", line_numbers=True, background_color="default"))

    def go() -> int:
        ended_nodes = EndedNodes(launch.log)
        with watching(launch, console, ended_nodes, {}) as watch:
            status = fly_script([settings.script], launch, watch)
        if status:
            raise DemoError(f"{settings.script.name} has ended with status {status}")
        _say_goodbye(settings, console)
        return 0

    return run_launch(launch, console, go)


def _say_goodbye(settings: HelloSettings, console: Console) -> None:
    name = _shown(settings.script)
    for line in (
        "landed. Now yours:",
        f"  cp {name} my_flight.py          # change it",
        "  ./xtdrone demo hello --script my_flight.py",
        "  docs/tutorials/fly-from-a-script.md has all verbs; './xtdrone demo formation' flies nine",
    ):
        console.print(line, highlight=False, soft_wrap=True)


def _shown(path: Path) -> str:
    """Return a path relative to the current folder if it is below it."""
    here = Path.cwd()
    return str(path.relative_to(here)) if path.is_relative_to(here) else str(path)
