"""Fly the formation demo: run launch/formation.launch, show its progress, and write the report and pictures."""

from __future__ import annotations

import contextlib
import json
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

from rich.console import Console

from xtdrone_control.programs.node_command_line import speed_setting
from xtdrone_control.settings import Settings, setting
from xtdrone_coordination.leader import Leader
from xtdrone_interaction.command_options import (
    DEFAULT_FOLLOWER,
    clearance_setting,
    patterns_setting,
    seed_setting,
    vehicles_setting,
    waive_setting,
    web_setting,
)
from xtdrone_interaction.formation.shared_topics_and_names import EVENTS_TOPIC, PROGRESS_TOPIC
from xtdrone_interaction.launching.supervised_launch import DemoError, Flight, escape, run_flight
from xtdrone_interaction.metrics.missions.formation_metrics import make_report, write_report
from xtdrone_interaction.monitoring.ended_nodes import EndedNode, EndedNodes
from xtdrone_interaction.monitoring.progress_display import Display
from xtdrone_interaction.recording.missions.formation_record import read_formation
from xtdrone_interaction.recording.recorded_flight import RecordError
from xtdrone_interaction.report.printed_results import print_formation, print_paths

POSES_TEXT = "start pose of each vehicle instead of the grid: a YAML list of [x, y, z, roll, pitch, yaw], m and rad ENU"
_START_LIMIT = 60.0  # s until the first progress message, plus _START_LIMIT_VEHICLE per vehicle
_START_LIMIT_VEHICLE = 2.0


@dataclass(frozen=True, kw_only=True)
class DemoSettings(Settings):
    """Settings of a formation flight.

    Attributes:
        pattern_file: YAML file with the user's patterns, or empty.
        follower: program of xtdrone_coordination.
        follower_class: the user's follower class, ``/absolute/file.py`` or ``/absolute/file.py:Class``, or empty.
        leader_class: the user's leader class, as ``follower_class``, or empty.
        out: folder of the results.
        master_port: TCP port of the flight's own ROS master; 0: use the running one of ROS_MASTER_URI.
        simulator: ``full`` or ``simplified``.
        model: of simplified vehicles: ``first-order``, ``second-order``, a YAML file; empty for the type's.
        window: open a live window.
        film: whether to film the recorded flight afterwards.
        instance: number of the simulation on this machine.
    """

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
    world: str = setting("empty", metavar="WORLD", text="name of the world")
    seed: int = seed_setting()
    speed: float = speed_setting()
    waive: tuple[str, ...] = waive_setting()
    out: Path = Path()
    master_port: int = 0
    headless: bool = setting(False, text="no live display; print a progress line every few seconds")
    logs: bool = setting(False, text="write the vehicles' flight logs (PX4's ULog) to logs/ in the results")
    simulator: str = "full"
    model: str = ""
    window: bool = False
    film: bool = False
    instance: int = 0
    web: bool = web_setting()


def waived_criteria(leader: type[Leader], waived: Sequence[str]) -> tuple[str, ...]:
    """Return the waived criteria; of a leader that assigns the slots by its own rule, the assignment is one."""
    if leader.assignment is Leader.assignment or "assignment" in waived:
        return tuple(waived)
    return (*waived, "assignment")


def run_demo(settings: DemoSettings, console: Console) -> int:
    """Fly the demo.

    Returns:
        The exit status: 0 for a good flight, 1 for one that failed or missed a limit, 128 + signal when stopped.
    """
    command_wall = time.monotonic()
    return run_flight(
        flight(settings), console, lambda ended_nodes: _conclude(settings, console, command_wall, ended_nodes)
    )


def flight(settings: DemoSettings) -> Flight:
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
        "world": settings.world,
        "seed": settings.seed,
        "speed": settings.speed,
        "out": settings.out,
        "log": settings.out / "logs" if settings.logs else "",
        "view": "true" if settings.window else "false",
    }
    if settings.poses:
        arguments["poses"] = settings.poses
    if settings.neighbours != "truth":
        arguments["neighbours"] = settings.neighbours
    if settings.simulator != "full":
        arguments |= {"simulator": settings.simulator, "model": settings.model}
    if settings.instance:
        arguments["instance"] = settings.instance
    if settings.web:
        arguments["web"] = "true"
    return Flight(
        file="formation.launch",
        arguments=arguments,
        out=settings.out,
        bag="flight.bag",
        master_port=settings.master_port,
        headless=settings.headless,
        instance=settings.instance,
        start_limit=_START_LIMIT + _START_LIMIT_VEHICLE * settings.n,
        progress_topic=PROGRESS_TOPIC,
        events_topic=EVENTS_TOPIC,
        last_events=("done", "failed"),
        show_event=show_event,
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


def _conclude(settings: DemoSettings, console: Console, command_wall: float, ended_nodes: EndedNodes) -> int:
    """Write the report and pictures of the finished flight and return the exit status.

    Raises:
        DemoError: the flight failed.
    """
    last = flight(settings).events()[-1:]  # none on a full disk
    if last and last[0]["event"] == "failed":
        raise DemoError(last[0]["reason"])
    unstored = ("out", "master_port", "headless", "window", "film", "instance", "web")
    stored = {k: v for k, v in asdict(settings).items() if k not in unstored}
    bag = settings.out / "flight.bag"
    status = report_flight(bag, {**stored, "command_wall": command_wall}, console, list(ended_nodes.found.values()))
    if settings.film:
        _film(bag, console)
    return status


def _film(bag: Path, console: Console) -> None:
    """Film the flight beside its bag; print the path, or why there is no film."""
    from xtdrone_interaction.pictures.missions.formation_film import default_file, make_film  # imports Matplotlib
    from xtdrone_swarm.view import FilmError

    try:
        print_paths([make_film(read_formation(bag), default_file(bag.parent), console)], console)
    except FilmError as error:
        console.print(f"[yellow]no film:[/yellow] {escape(str(error))}", highlight=False, soft_wrap=True)


def report_again(file: Path, console: Console) -> int:
    """Rewrite the report and pictures of a recorded flight; keep entries that are only in the earlier report.

    Raises:
        DemoError: the file is not a flight record.
    """
    known: dict[str, Any] = {}
    with contextlib.suppress(FileNotFoundError, ValueError):
        known = json.loads((file.parent / "report.json").read_text(encoding="utf-8"))
    kept: dict[str, Any] = {key: known[key] for key in ("startup_time", "comparison") if key in known}
    ended_nodes = [EndedNode(**ended) for ended in known.get("died", [])]
    return report_flight(file, known.get("settings", {}), console, ended_nodes, kept)


def report_flight(
    bag: Path,
    settings: dict[str, Any],
    console: Console,
    ended_nodes: Sequence[EndedNode] = (),
    kept: Mapping[str, Any] = MappingProxyType({}),
) -> int:
    """Write report.json and the pictures beside ``bag``, print the table, and return 0 for a good flight, else 1.

    Args:
        bag: the flight's record.
        settings: see :func:`~xtdrone_interaction.metrics.missions.formation_metrics.make_report`.
        console: prints the table.
        ended_nodes: nodes that ended in flight, if known.
        kept: entries added to the report unchanged.

    Raises:
        DemoError: the bag is not a flight record.
    """
    from xtdrone_interaction.pictures.missions.formation_pictures import figures
    from xtdrone_interaction.pictures.picture_style import save_figures  # matplotlib takes a while to import

    try:
        record = read_formation(bag)
        report = make_report(record, settings)
        report |= {"died": [asdict(ended) for ended in ended_nodes], **kept}
        report["shortcomings"] = [*(str(ended) for ended in ended_nodes if ended.matters), *report["shortcomings"]]
        print_formation(report, console)  # first: the disk may be full
        write_report(report, bag.parent / "report.json")
        pictures = save_figures(figures(record), bag.parent)
    except RecordError as error:
        raise DemoError(str(error)) from error
    print_paths([bag, bag.parent / "report.json", *(path for _, path in pictures)], console)
    return 1 if report["shortcomings"] else 0
