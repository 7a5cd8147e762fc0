"""``./xtdrone record-view VIEW``: a film of a flight in rviz, without a screen.

The source is a bag (``--bag``), a demo flown first (``--demo``), or the running flight. A bag is played back in place
of the simulator (``playback``). In a running flight the drawing nodes join the lockstep, which waits for them without
any effect on the flight.

Exit status: 0 for success, 1 without a film, 2 for an invalid argument, 128 + n after signal n (the part filmed so far
is kept).
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import rosgraph
from rich.console import Console

from xtdrone_interaction import command_options, simulation_services
from xtdrone_interaction.command_options import OptionError
from xtdrone_interaction.launching.supervised_launch import DemoError, Interrupted, defer_signals, raise_on_signals
from xtdrone_interaction.rviz.films.film_options import (
    FilmSettings,
    add_arguments,
    as_words,
    film_settings,
    parse,
    settings_of,
)
from xtdrone_interaction.rviz.films.view_nodes import (
    DRAWER,
    CrashError,
    Stage,
    StageError,
    check_tools,
    node_environment,
)

_REPORT_PERIOD = 5.0  # wall s between two lines of progress
_SLICE = 0.1  # wall s


__all__ = ["add_arguments", "film_settings", "parse", "run"]  # all but run are defined beside the film's settings


def run(arguments: argparse.Namespace) -> int:
    """Film and return the exit status."""
    try:
        return _run(settings_of(arguments))
    except OptionError as error:
        print(f"xtdrone: {error}", file=sys.stderr)
        return 2


def _run(settings: FilmSettings) -> int:
    console = Console()
    try:
        with raise_on_signals():
            return _film(settings, console)
    except OptionError as error:
        print(f"xtdrone: {error}", file=sys.stderr)
        return 2
    except (DemoError, ValueError) as error:  # ValueError: also BagError
        print(f"xtdrone: {error}", file=sys.stderr)
        return 1
    except OSError as error:
        print(f"xtdrone: {error.filename or 'system'}: {error.strerror or error}", file=sys.stderr)
        return 1
    except Interrupted as signalled:
        console.print(f"stopped by {signalled}; nothing is left running", highlight=False)
        return 128 + signalled.number


def _film(settings: FilmSettings, console: Console) -> int:
    check_tools()
    flown = 0
    if settings.demo:
        folder = command_options.results_folder(None)
        command = [sys.executable, "-m", "xtdrone_interaction", "demo", settings.demo, "--out", str(folder)]
        own = ["--no-film"] if settings.demo == "formation" else []
        flown = _fly([*command, *own, *settings.demo_options])
        if not (folder / "flight.bag").is_file():
            raise StageError(f"demo {settings.demo}: status {flown}, and no flight was recorded in {folder}")
        settings = replace(settings, bag=folder / "flight.bag")
    if settings.frames is not None:
        settings.frames.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="xtdrone-view-") as work:
        if settings.bag is not None:
            try:
                film_bag(settings, settings.bag, Path(work), console)
            except CrashError as error:
                if settings.again:
                    raise
                print(f"xtdrone: {error}\nxtdrone: the film is drawn once again", file=sys.stderr)
                return _film_again(settings) or flown
        else:
            film_running(settings, Path(work), console)
    console.print(f"{settings.out}", highlight=False, soft_wrap=True)
    return flown


def _film_again(settings: FilmSettings) -> int:
    """Film in a new process, in which rospy can start again; return its exit status."""
    return _fly([sys.executable, "-m", "xtdrone_interaction", "record-view", *as_words(settings)])


def _fly(command: Sequence[str]) -> int:
    """Run a program and return its status; a signal ends the program first."""
    with subprocess.Popen(command) as demo:
        try:
            return demo.wait()
        except Interrupted as signalled:
            # Forward the signal and let the program clean up, undisturbed by further signals.
            demo.send_signal(signalled.number)
            with defer_signals():
                demo.wait()
            raise


def film_bag(settings: FilmSettings, path: Path, work: Path, console: Console) -> None:
    """Film a recorded flight.

    Raises:
        BagError: it cannot be shown.
        OptionError: --from and --to select nothing.
        StageError: no film was made.
    """
    from xtdrone_interaction.rviz.films.messages_from_bag import FlightBag  # rosbag is slow to import
    from xtdrone_interaction.rviz.films.playback import play

    bag = FlightBag(path)
    begin_us = max(bag.begin_us, settings.begin * 1e6)
    end_us = min(bag.end_us, settings.end * 1e6)
    if not begin_us <= end_us:
        part = f"{bag.begin_us * 1e-6:.1f} to {bag.end_us * 1e-6:.1f} s"
        raise OptionError(f"from, to: the flight has no data in that interval; {path} has {part}")
    began = said = 0.0

    def on_turn(now_us: int) -> None:
        nonlocal began, said
        began, said = began or time.monotonic(), said or time.monotonic()
        if time.monotonic() - said > _REPORT_PERIOD:
            said = time.monotonic()
            share = min(1.0, (now_us - begin_us) / max(1.0, end_us - begin_us))
            console.print(f"film: sim {now_us * 1e-6:.1f} s, {share:.0%}", highlight=False)

    settings = replace(settings, world=settings.world or flown_world(path))
    frames = play(settings, bag, work, on_turn)
    rate = frames / (time.monotonic() - began)
    console.print(f"film: {frames} frames, {rate:.1f} per second of wall time", highlight=False)


def flown_world(bag: Path) -> str:
    """Return the world of a recorded flight from the files next to its bag; empty if unknown."""
    from xtdrone_interaction.missions.search.prepare import WORLD  # shapely is slow to import

    searched = bag.absolute().parent / WORLD
    if searched.is_file():
        return str(searched)
    try:
        report = json.loads((bag.parent / "report.json").read_text(encoding="utf-8"))
        return str(report["settings"]["world"])
    except (OSError, ValueError, KeyError, TypeError):
        return ""


def film_running(settings: FilmSettings, work: Path, console: Console) -> None:
    """Film the running flight until it ends or Ctrl-C.

    Raises:
        StageError: no flight is running, or no film was made.
    """
    given = f"http://localhost:{settings.master}" if settings.master.isdigit() else settings.master
    try:
        uri, _ = simulation_services.choose_master(
            given, os.environ.get("ROS_MASTER_URI", ""), [simulation_services.RUNS]
        )
    except simulation_services.SimError as error:
        raise StageError(f"{error}; or film a recorded flight: --bag FILE") from error
    master = rosgraph.Master("/record_view", master_uri=uri)
    try:
        fleet = str(master.getParam("/xtdrone/fleet"))
        publishers, subscribers, services = master.getSystemState()
    except (rosgraph.MasterException, OSError) as error:
        raise StageError(f"master: {uri} does not answer as that of a flight: {error}") from error
    running = {node for group in (publishers, subscribers, services) for _, nodes in group for node in nodes}
    if f"/{DRAWER}" in running:
        raise StageError(f"{DRAWER}: this flight is already being filmed")
    os.environ.update(node_environment(uri))
    with Stage(dict(os.environ), work) as stage:
        stage.start_all(settings, fleet, running)
        console.print(f"filming the flight at {uri} until it ends; Ctrl-C ends the film earlier", highlight=False)
        while not stage.wait(DRAWER, _SLICE):
            stage.check_others()
        frames = stage.finish()
    console.print(f"film: {frames} frames", highlight=False)
