"""``./xtdrone demo formation``: UAVs take off, fly through formation patterns, and land.

Exit status: 0 for a good flight, 1 for one that failed or missed a limit, 2 for an invalid value, 128 + n when stopped
by signal n.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console

from xtdrone_common.fleet import parse_fleet, with_poses
from xtdrone_common.settings import setting
from xtdrone_coordination.follower import Follower
from xtdrone_coordination.leader import Leader
from xtdrone_interaction import command_options
from xtdrone_interaction.command_options import (
    DEFAULT_FOLLOWER,
    OptionError,
    clearance_setting,
    patterns_setting,
    vehicles_setting,
)
from xtdrone_interaction.console import PatientConsole, run_reported
from xtdrone_interaction.launching.supervised_launch import Flight, escape
from xtdrone_interaction.missions.demo import (
    DemoSettings,
    add_common_options,
    directed_flight,
    fly_directed,
    take_place,
)
from xtdrone_interaction.missions.formation.criteria import waive_setting
from xtdrone_interaction.monitoring.progress_display import Display
from xtdrone_sim.vehicles.vehicle_model import load_vehicle

if TYPE_CHECKING:
    from xtdrone_interaction.missions.mission import Mission

POSES_TEXT = "start pose of each vehicle instead of the grid: a YAML list of [x, y, z, roll, pitch, yaw], m and rad ENU"
_START_LIMIT = 60.0  # s until the first progress message, plus _START_LIMIT_VEHICLE per vehicle
_START_LIMIT_VEHICLE = 2.0


@dataclass(frozen=True, kw_only=True)
class FormationSettings(DemoSettings):
    """Settings of a formation flight.

    Attributes:
        pattern_file: YAML file with the user's patterns, or empty.
        follower: Program of xtdrone_coordination.
        follower_class: The user's follower class, ``/absolute/file.py`` or ``/absolute/file.py:Class``, or empty.
        leader_class: The user's leader class, as ``follower_class``, or empty.
        simulator: Simulator of the flight: ``full`` or ``simplified``.
        model: Model of simplified vehicles: ``first-order``, ``second-order``, a YAML file; empty for the type's.
        window: Whether to open a live window.
    """

    UNSTORED = (*DemoSettings.UNSTORED, "window", "film")

    n: int = vehicles_setting()
    type: str = setting("iris", metavar="TYPE", text="vehicle type")
    poses: str = setting("", metavar="LIST", text=POSES_TEXT)
    patterns: tuple[str, ...] = patterns_setting()
    pattern_file: str = ""
    processes: str = setting(
        "per_uav",
        choices=("per_uav", "merged", "shared"),
        text="one process per vehicle and role, as in the paper; one per vehicle; or one per role",
    )
    follower: str = DEFAULT_FOLLOWER
    follower_class: str = ""
    leader_class: str = ""
    control: str = setting("vel", choices=("vel", "accel"), text="what followers command")
    avoidance: str = setting(
        "own",
        choices=("own", "python", "cpp"),
        text="where the avoidance is computed: in every follower, or in one node for all (Python, C++)",
    )
    neighbours: str = setting(
        "truth",
        choices=("truth", "estimated"),
        text="positions of the others that followers use: as these report them, or by relative localisation, for types "
        "whose UWB sensor measures bearings",
    )
    clearance: float = clearance_setting()
    waive: tuple[str, ...] = waive_setting()
    simulator: str = "full"
    model: str = ""
    window: bool = False
    film: bool = setting(True, text="no film of the flight, flight.mp4, after its end")

    def stored(self, begin: float) -> dict[str, Any]:
        """Return the settings stored in the report, and the time of the command, which gives the start-up time."""
        stored = super().stored(begin)
        del stored["wall_time"]
        return {**stored, "command_wall": begin}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    parser.description = (
        "Fly the formation demo: takeoff, origin, each pattern in turn with the leader moving between, origin, "
        "landing. Leaves runs/<time>/ with flight.bag, report.html, report.json, events.jsonl, pictures, a film "
        "and logs."
    )
    add = parser.add_argument
    FormationSettings.add_arguments(parser, ("n", "type", "poses", "patterns"))
    add("--pattern-file", type=Path, metavar="FILE", help="YAML file with your own patterns")
    add("--processes", choices=["per-uav", "merged", "shared"], default="per-uav",
        help="one process per vehicle and role, as in the paper; one per vehicle; or one per role "
        "(default: %(default)s)")  # fmt: skip
    add("--follower", default=DEFAULT_FOLLOWER, metavar="PROGRAM",
        help="follower program of xtdrone_coordination, or FILE.py[:CLASS] with your own follower class "
        "(default: %(default)s)")  # fmt: skip
    add("--leader", metavar="FILE.py:CLASS", help="your own leader class (default: the shipped one)")
    FormationSettings.add_arguments(parser, ("control", "avoidance", "neighbours", "clearance", "waive", "film"))
    add_common_options(parser, FormationSettings)


def run(arguments: argparse.Namespace) -> int:
    """Fly and return the exit status."""
    return run_reported(lambda: fly(settings_of(arguments), PatientConsole()))


def settings_of(arguments: argparse.Namespace) -> FormationSettings:
    """Return the settings of the demo, after all checks that need no ROS.

    Raises:
        OptionError, PatternError, FleetError: a value is not allowed.
    """
    follower, follower_class = command_options.follower_program(arguments.follower)
    settings = FormationSettings.from_arguments(
        arguments,
        pattern_file=str(arguments.pattern_file.resolve()) if arguments.pattern_file else "",
        processes=arguments.processes.replace("-", "_"),
        follower=follower,
        follower_class=follower_class,
        leader_class=command_options.leader_class(arguments.leader),
        world=command_options.world(arguments.world),
    )
    config = command_options.repository() / "src" / "xtdrone_worlds" / "config"
    command_options.one_of_files("vehicle type", settings.type, config / "vehicles")
    if settings.neighbours == "estimated" and not any(mount.bearing for mount in load_vehicle(settings.type).uwb):
        raise OptionError(
            f"neighbours: 'estimated' needs a type whose UWB sensor measures bearings, as iris_uwb_bearing, not "
            f"{settings.type!r}: ranges alone tell no positions while followers wait for them"
        )
    fleet = f"{settings.type}:{settings.n}"
    with_poses(parse_fleet(fleet), settings.poses)
    command_options.swarm_patterns(settings.n, settings.patterns, settings.pattern_file or None)
    command_options.checked_class(settings.follower_class, Follower, "follower")
    leader = command_options.checked_class(settings.leader_class, Leader, "leader")
    return take_place(replace(settings, waive=waive_criteria(leader, settings.waive)), arguments, fleet)


def fly(settings: FormationSettings, console: Console) -> int:
    """Fly and return the exit status."""
    return fly_directed(load_mission, flight(settings), settings, console, film=settings.film)


def load_mission() -> Mission:
    """Return the kind of the flight."""
    from xtdrone_interaction.missions.formation.report import FormationMission  # imports Matplotlib, which is slow

    return FormationMission()


def waive_criteria(leader: type[Leader], waived: Sequence[str]) -> tuple[str, ...]:
    """Return the waived criteria; of a leader that assigns the slots by its own rule, the assignment is one."""
    if leader.assignment is Leader.assignment or "assignment" in waived:
        return tuple(waived)
    return (*waived, "assignment")


def flight(settings: FormationSettings) -> Flight:
    """Return the launch file with its arguments."""
    arguments: dict[str, object] = {
        "n": settings.n,
        "type": settings.type,
        "patterns": ",".join(settings.patterns),
        "pattern_file": settings.pattern_file,
        "processes": settings.processes,
        "follower": settings.follower,
        "follower_class": settings.follower_class,
        "leader_class": settings.leader_class,
        "control": settings.control,
        "avoidance": settings.avoidance,
        "clearance": settings.clearance,
        "view": "true" if settings.window else "false",
    }
    if settings.poses:
        arguments["poses"] = settings.poses
    if settings.neighbours != "truth":
        arguments["neighbours"] = settings.neighbours
    if settings.simulator != "full":
        arguments |= {"simulator": settings.simulator, "model": settings.model}
    return directed_flight(
        settings,
        "formation.launch",
        arguments,
        show_event,
        "formation_director",
        start_limit=_START_LIMIT + _START_LIMIT_VEHICLE * settings.n,
        last_events=("done", "failed"),
    )


def show_event(event: dict[str, Any], display: Display) -> None:
    """Show an event of the director, if it is of interest to the user."""
    time_text = f"  {event['time']:6.1f} s "
    if event["event"] == "settled":
        display.note(f"{time_text} {event['what']}: settled after {event['after']:.1f} s")
    elif event["event"] == "unsettled":
        display.note(f"{time_text} {event['what']}: not settled, {event['vehicle']} is {event['error']:.2f} m off")
    elif event["event"] == "lost":
        display.note(f"{time_text} {event['vehicle']} is lost, the flight continues: {escape(event['reason'])}")
    elif event["event"] == "giving up":
        display.note(f"{time_text} giving up, landing: {escape(event['reason'])}")
    elif event["event"] == "refused":
        display.note(f"{time_text} {escape(event['reason'])}")
