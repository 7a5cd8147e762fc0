"""``./xtdrone demo hello``: one vehicle takes off, flies a square and lands, by a script that is shown.

Exit status: 0 for a flight to its end, 1 if the script or the launch has failed, 2 for an invalid value,
128 + n when stopped by signal n.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console
from rich.syntax import Syntax

from xtdrone_interaction import command_options
from xtdrone_interaction.console import PatientConsole, run_reported
from xtdrone_interaction.missions.demo import (
    BAG,
    DemoSettings,
    add_common_options,
    check_script,
    fly_scripted,
    scripted_launch,
    take_place,
)

if TYPE_CHECKING:
    from xtdrone_interaction.missions.mission import Mission

FLEET = "iris:1"
SCRIPT = command_options.repository() / "src" / "xtdrone_control" / "examples" / "hello.py"


@dataclass(frozen=True, kw_only=True)
class HelloSettings(DemoSettings):
    """Settings of the flight.

    Attributes:
        script: File that flies the vehicle.
    """

    UNSTORED = (*DemoSettings.UNSTORED, "script")

    script: Path


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    parser.description = (
        "Fly one vehicle: up, a square, down. The script that flies it is shown first; copy it, change it, and fly "
        "your copy with --script. Leaves runs/<time>/ with flight.bag, report.html, report.json, pictures and logs."
    )
    parser.add_argument(
        "--script", type=Path, default=SCRIPT, metavar="FILE.py", help="script that flies iris_0 (default: the example)"
    )
    add_common_options(parser, HelloSettings)


def run(arguments: argparse.Namespace) -> int:
    """Fly and return the exit status."""
    return run_reported(lambda: fly(settings_of(arguments), PatientConsole()))


def settings_of(arguments: argparse.Namespace) -> HelloSettings:
    """Return the settings, after all checks that need no ROS.

    Raises:
        OptionError: a value is not allowed.
    """
    script, world = check_script(arguments.script), command_options.world(arguments.world)
    return take_place(HelloSettings.from_arguments(arguments, script=script, world=world), arguments, FLEET)


def fly(settings: HelloSettings, console: Console) -> int:
    """Fly and return the exit status."""
    launch = scripted_launch(settings, "hello.launch", {"bag": settings.out / BAG})
    text = settings.script.read_text(encoding="utf-8")
    console.print(f"{_shown(settings.script)}:", highlight=False, soft_wrap=True)
    console.print(Syntax(text.strip(), "python", line_numbers=True, background_color="default"))
    status = fly_scripted(load_mission, launch, [settings.script], settings, console)
    if status == 0:
        _say_goodbye(settings, console)
    return status


def load_mission() -> Mission:
    """Return the kind of the flight."""
    from xtdrone_interaction.missions.any_flight import AnyFlight  # imports Matplotlib, which is slow

    return AnyFlight()


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
