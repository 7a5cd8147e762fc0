"""``./xtdrone soak``: run one simulation for hours under changing load, and judge its growth.

Exit status: 0 if memory and speed are flat, all logs and bags can be read and no log has a traceback; 1 if not; 2 for a
value that is not allowed; 128 + n when stopped by signal n, with a report of the part that was run.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from rich.console import Console

from validation.soak import soak_script
from validation.soak.judging import report
from validation.soak.judging.verdict import Outcome, judge
from validation.soak.simulation_under_test import SoakError, Stack
from validation.soak.soak_runner import Runner
from validation.soak.soak_script import Episode
from xtdrone_control.fleet import FleetError, parse_fleet
from xtdrone_control.lockstep.simulation_speed import speed_setting
from xtdrone_control.settings import Settings, setting
from xtdrone_interaction import command_options
from xtdrone_interaction.command_options import OptionError, seed_setting, vehicles_setting
from xtdrone_interaction.console import PatientConsole
from xtdrone_interaction.launching.scripted_launch import LaunchError, Stopped, StopRequest
from xtdrone_interaction.machine_facts import machine_facts
from xtdrone_interaction.sim_cli import SimError

_JUDGE_LIMIT = 1800.0  # s of wall time to judge the remaining files at the end
_JUDGE_LIMIT_STOPPED = 60.0
_LINE_PERIOD = 10.0  # s of wall time between two lines of progress
_TICKER_PERIOD = 0.5  # and on a terminal


@dataclass(frozen=True)
class SoakSettings(Settings):
    """Length and size of the simulation."""

    hours: float = setting(8.0, above=0.0, high=1000.0, metavar="H", text="simulated hours")
    seed: int = seed_setting("seed of the script and of all noise")
    n: int = vehicles_setting(text="number of vehicles (with --short: 3)")
    speed: float = speed_setting()


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    parser.description = (
        "Run one simulation for hours of simulated time at full speed while missions, formations, nodes, ground "
        "stations and recorders start and stop according to a script generated from a seed, and check that its memory, "
        "descriptors, threads and speed remain constant. See CONTRIBUTING.md."
    )
    add = parser.add_argument
    length = parser.add_mutually_exclusive_group()
    SoakSettings.add_arguments(length, ("hours",))
    length.add_argument("--short", action="store_true",
                        help="every kind of event once, in two minutes; growth and speed are not judged")  # fmt: skip
    SoakSettings.add_arguments(parser, ("seed", "n", "speed"))
    kinds = ", ".join(soak_script.KINDS)
    add("--only", metavar="KINDS", default="",
        help=f"kinds of episodes, separated by commas, of {kinds} (default: all; not with --short)")  # fmt: skip
    add("--out", type=Path, metavar="FOLDER", help="new folder for the results (default: runs/<time>)")
    add("--script", action="store_true", help="print the script and run nothing")


class _Progress:
    """The line of progress on the terminal."""

    def __init__(self, console: Console, hours: float) -> None:
        self._console = console
        self._hours = hours
        self._due = 0.0

    def __call__(self, runner: Runner) -> None:
        now = time.monotonic()
        if now < self._due:
            return
        ticker = self._console.is_terminal
        self._due = now + (_TICKER_PERIOD if ticker else _LINE_PERIOD)
        text = self._line(runner, now - runner.begun)
        if ticker:
            sys.stdout.write(f"\r\x1b[2K{text[: self._console.width - 1]}")
            sys.stdout.flush()
        else:
            self._console.print(text, highlight=False, soft_wrap=True, markup=False)

    def _line(self, runner: Runner, wall: float) -> str:
        done = runner.stack.soak_us * 1e-6
        factor = done / max(wall, 1e-3)
        left = max(0.0, self._hours * 3600.0 - done) / max(factor, 1e-3)
        phase = f"{runner.phase.episode.kind} {runner.phase.episode.number}" if runner.phase else "start"
        return (
            f"{_clock(done)} of {_clock(self._hours * 3600.0)} simulated, {factor:.1f} x, {phase}, "
            f"{len(runner.stack.status().participants)} participants, ETA {_clock(left)}"
        )

    def end(self) -> None:
        """End the line."""
        if self._console.is_terminal:
            sys.stdout.write("\n")


def _clock(seconds: float) -> str:
    return f"{int(seconds) // 3600}:{int(seconds) // 60 % 60:02d}:{int(seconds) % 60:02d}"


def run(arguments: argparse.Namespace) -> int:
    """Run the soak and return its exit status."""
    console = PatientConsole()
    try:
        settings = SoakSettings.from_arguments(arguments)
        if arguments.short and not hasattr(arguments, "n"):
            settings = replace(settings, n=3)
        episodes = list(_script(settings, _kinds(arguments.only, short=arguments.short), short=arguments.short))
        if arguments.script:
            _print_script(episodes, console)
            return 0
        command_options.check_vehicle_ports(parse_fleet(f"iris:{settings.n}"))
        folder = command_options.results_folder(arguments.out, recorded=True)
        return _soak(settings, episodes, folder, console, short=arguments.short)
    except (OptionError, FleetError) as error:
        print(f"xtdrone: {error}", file=sys.stderr)
        return 2
    except (LaunchError, SimError, SoakError) as error:
        print(f"xtdrone: {error}", file=sys.stderr)
        return 1
    except OSError as error:
        print(f"xtdrone: {error.filename or 'system'}: {error.strerror or error}", file=sys.stderr)
        return 1


def _kinds(text: str, *, short: bool) -> Sequence[str]:
    """Return the kinds of episodes named by ``--only``, in their usual order.

    Raises:
        OptionError: an unknown kind, or a choice for the short soak.
    """
    if not text:
        return soak_script.KINDS
    if short:
        raise OptionError("--only: not allowed with --short, which has an episode of every kind")
    chosen = text.split(",")
    for kind in chosen:
        if kind not in soak_script.KINDS:
            raise OptionError(f"--only: {kind!r} is not allowed, one of {', '.join(soak_script.KINDS)}")
    return [kind for kind in soak_script.KINDS if kind in chosen]


def _script(settings: SoakSettings, kinds: Sequence[str], *, short: bool) -> Iterable[Episode]:
    if short:
        return soak_script.generate_short(settings.seed, settings.n)
    return soak_script.generate(settings.seed, settings.n, settings.hours, kinds)


def _print_script(episodes: Sequence[Episode], console: Console) -> None:
    begin = 0.0
    for episode in episodes:
        console.print(f"{_clock(begin)} {episode.number} {episode.kind}, {episode.length:.0f} s", highlight=False)
        for event in episode.events:
            values = " ".join(f"{name}={value}" for name, value in event.arguments.items())
            text = f"  {begin + event.time:10.2f} {event.action} {values}"
            console.print(text, highlight=False, soft_wrap=True, markup=False)
        begin += episode.length


def _soak(settings: SoakSettings, episodes: Sequence[Episode], folder: Path, console: Console, *, short: bool) -> int:
    """Run, and write a report in any case."""
    folder.mkdir(parents=True, exist_ok=True)
    hours = sum(episode.length for episode in episodes) / 3600.0
    console.print(f"Results: {folder}", highlight=False, soft_wrap=True)
    facts = {
        "n": settings.n, "seed": settings.seed, "hours": hours, "short": short, "speed": settings.speed,
        "begun": time.strftime("%Y-%m-%d %H:%M:%S"), "machine": machine_facts(command_options.repository()),
    }  # fmt: skip
    progress = _Progress(console, hours)
    with StopRequest() as stop:
        stack = Stack(folder, settings.n, settings.seed, settings.speed, command_options.free_port(), stop)
        runner: Runner | None = None
        end = ""
        try:
            stack.wait_until_up()
            _join_graph()
            runner = Runner(stack, settings.n, settings.speed, progress)
            runner.run(episodes)
        except Stopped as stopped:
            end = f"stopped by {stopped}"
        except (SoakError, SimError) as error:
            end = str(error)
        number, stop.number = stop.number, 0  # the conclusion is not interrupted
        progress.end()
        if runner is None:
            stack.close()
            raise SoakError(end)
        outcome = _conclude(runner, facts, end, stopped=bool(number), judge_growth=not short)
        verdict = judge(outcome)
        report.write(outcome, verdict, folder)
        report.show(outcome, verdict, folder, console)
    if number:
        return 128 + number
    return 1 if verdict.failures else 0


def _join_graph() -> None:
    """Become a node to publish; on wall time, as /clock has a thousand messages a second."""

    from xtdrone_control.programs.plain_node import init_plain_node

    init_plain_node("soak", disable_signals=True, disable_rostime=True)


def _conclude(runner: Runner, settings: dict[str, Any], end: str, *, stopped: bool, judge_growth: bool) -> Outcome:
    """Stop everything and collect the findings."""
    import rospy

    runner.stack.concluding = True
    runner.nodes.end_all()
    wall = time.monotonic() - runner.begun
    rospy.signal_shutdown("the soak has ended")
    runner.stack.end()
    runner.texts.update()
    runner.give_logs(ended=True)
    unread = runner.judge.close(_JUDGE_LIMIT_STOPPED if stopped else _JUDGE_LIMIT)
    runner.stack.close()
    runner.samples.close()
    judge, tally, texts = runner.judge, runner.tally, runner.texts
    counts = {
        "phases": _phases(runner),
        "actions": dict(runner.actions.counts),
        "nodes_started": runner.nodes.started,
        "expected": runner.actions.expected,
        "flights": runner.actions.flights,
        "forced": runner.actions.forced,
        "refused": report.top(runner.actions.refused),
        "words_without_listener": runner.actions.lost_words,
        "latest_event": tally.late,
        "files": {f"{kind} {verdict}": number for (kind, verdict), number in sorted(judge.counts.items())},
        "files_bytes": dict(judge.bytes),
        "files_messages": dict(judge.messages),
        "warnings_total": sum(texts.warnings.values()),
        "warnings": report.top(texts.warnings),
        "lost": texts.lost,
    }
    damaged = [f"{finding.path}: {'; '.join(finding.notes)}" for finding in judge.damaged]
    return Outcome(
        settings, end, runner.samples.rows, tally.stretches, runner.stack.soak_us / 3.6e9, wall, counts,
        [*tally.tracebacks, *texts.tracebacks], runner.nodes.wrong, damaged, unread, judge_growth,
    )  # fmt: skip


def _phases(runner: Runner) -> dict[str, dict[str, float]]:
    """Return number, share of simulated time, real-time factor, processor and wall time by kind of episode."""
    tally = runner.tally
    total = sum(tally.simulated.values())
    found = {}
    for kind in tally.episodes:
        own = [stretch for stretch in tally.stretches if stretch.kind == kind]
        seconds, wall = sum(s.seconds for s in own), sum(s.wall for s in own)
        found[kind] = {
            "episodes": tally.episodes[kind],
            "share": tally.simulated[kind] / total,
            "rtf": seconds / max(wall, 1e-3),
            "cpu": sum(s.cpu for s in own) / max(seconds, 1e-3),
            "wall": tally.wall[kind],
            "others": sum(s.others * s.wall for s in own) / max(wall, 1e-3),
        }
    return found
