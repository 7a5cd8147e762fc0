"""``./xtdrone soak``: run one simulation for hours under changing load, and hold its growth against limits.

Exit status: 0 if memory and speed are flat, all logs and bags can be read and no log has a traceback; 1 if not; 2 for a
value that is not allowed; 128 + n when stopped by signal n, with a report of the part that was run.
"""

from __future__ import annotations

import argparse
import contextlib
import csv
import json
import os
import shutil
import sys
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from benchmarks.process_use import CpuSample
from validation.soak import limits, soak_script
from validation.soak.actions import Actions, read_files
from validation.soak.simulation_under_test import Node, Nodes, SoakError, Stack
from validation.soak.soak_script import Episode
from xtdrone_common.files import write_whole
from xtdrone_common.fleet import FleetError, parse_fleet
from xtdrone_common.programs.node_command_line import speed_setting
from xtdrone_common.programs.plain_node import init_plain_node
from xtdrone_common.settings import Settings, setting
from xtdrone_interaction import command_options
from xtdrone_interaction.command_options import OptionError, seed_setting, vehicles_setting
from xtdrone_interaction.console import PatientConsole
from xtdrone_interaction.launching.scripted_launch import LaunchError, Stopped, StopRequest
from xtdrone_interaction.machine_facts import machine_facts
from xtdrone_interaction.simulation_services import SimError

_LINE_PERIOD = 10.0  # s of wall time between two lines of progress
_MICRO = 1_000_000
_TRACEBACK = "Traceback (most recent call last)"
_ROSOUT_CLOSED = "publish() to a closed topic"  # of a node that logs during its shutdown


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
        "descriptors, threads and speed remain constant."
    )
    length = parser.add_mutually_exclusive_group()
    SoakSettings.add_arguments(length, ("hours",))
    length.add_argument("--short", action="store_true",
                        help="every kind of event once, in two minutes; growth and speed are not judged")  # fmt: skip
    SoakSettings.add_arguments(parser, ("seed", "n", "speed"))
    kinds = ", ".join(soak_script.KINDS)
    parser.add_argument("--only", metavar="KINDS", default="",
                        help=f"kinds of episodes, with commas between, of {kinds} (default: all)")  # fmt: skip
    parser.add_argument("--out", type=Path, metavar="FOLDER", help="new folder for the results (default: runs/<time>)")
    parser.add_argument("--script", action="store_true", help="print the script and run nothing")


def run(arguments: argparse.Namespace) -> int:
    """Run the soak and return its exit status."""
    console = PatientConsole()
    try:
        settings = SoakSettings.from_arguments(arguments)
        if arguments.short and not hasattr(arguments, "n"):
            settings = replace(settings, n=3)
        episodes = _episodes(settings, arguments.only, short=arguments.short)
        if arguments.script:
            _print_script(episodes, console)
            return 0
        command_options.check_vehicle_ports(parse_fleet(f"iris:{settings.n}"))
        folder = command_options.results_folder(arguments.out, recorded=True)
        folder.mkdir(parents=True, exist_ok=True)
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


def _episodes(settings: SoakSettings, only: str, *, short: bool) -> list[Episode]:
    """Return the script.

    Raises:
        OptionError: ``--only`` names an unknown kind, or chooses kinds for the short soak.
    """
    if short and only:
        raise OptionError("--only: not allowed with --short, which has an episode of every kind")
    if short:
        return list(soak_script.generate_short(settings.seed, settings.n))
    kinds = only.split(",") if only else soak_script.KINDS
    for kind in kinds:
        if kind not in soak_script.KINDS:
            raise OptionError(f"--only: {kind!r} is not allowed, one of {', '.join(soak_script.KINDS)}")
    return list(soak_script.generate(settings.seed, settings.n, settings.hours, kinds))


def _print_script(episodes: Sequence[Episode], console: Console) -> None:
    begin = 0.0
    for episode in episodes:
        console.print(f"{_clock(begin)} {episode.number} {episode.kind}, {episode.length:.0f} s", highlight=False)
        for event in episode.events:
            values = " ".join(f"{name}={value}" for name, value in event.arguments.items())
            text = f"  {begin + event.time:10.2f} {event.action} {values}"
            console.print(text, highlight=False, soft_wrap=True, markup=False)
        begin += episode.length


def _clock(seconds: float) -> str:
    return f"{int(seconds) // 3600}:{int(seconds) // 60 % 60:02d}:{int(seconds) % 60:02d}"


class Soak:
    """Executes a script against a running simulation and takes a sample after each episode.

    Attributes:
        rows: Samples, by the columns of ``samples.csv``.
        wrong: Failures of nodes and files, and tracebacks.
        messages: Number of messages in the flight logs and bags that were read.
        late: Maximum delay of an event, simulated s.
    """

    def __init__(self, stack: Stack, settings: SoakSettings, hours: float, console: Console) -> None:
        """Prepare the execution; ``hours``: length of the script, simulated h."""
        self.stack = stack
        self.nodes = Nodes(stack, self._check_ended)
        self.actions = Actions(stack, self.nodes, settings.n, settings.speed)
        self.rows: list[dict[str, Any]] = []
        self.wrong: list[str] = []
        self.messages = 0
        self.late = 0.0
        self._hours, self._console, self._line_due = hours, console, 0.0
        self._begun = time.monotonic()
        self._file = (stack.folder / "samples.csv").open("w", encoding="utf-8", newline="")
        self._writer = csv.DictWriter(self._file, limits.COLUMNS)
        self._writer.writeheader()

    def run(self, script: Iterable[Episode]) -> None:
        """Execute the whole script.

        Raises:
            SoakError: The simulation has failed.
            Stopped: A signal was received.
        """
        for episode in script:
            begin, began, cpu = self.stack.soak_us, time.monotonic(), self._processor_time()
            for event in episode.events:
                self._advance(begin + round(event.time * _MICRO), episode)
                self.actions.do(event.action, dict(event.arguments))
            self._advance(begin + round(episode.length * _MICRO), episode)
            seconds = (self.stack.soak_us - begin) / _MICRO
            self._sample(episode, seconds, time.monotonic() - began, self._processor_time() - cpu)
            self.read_files()

    def _advance(self, due: int, episode: Episode) -> None:
        if self.stack.soak_us < due:
            self.actions.settle()
        while self.stack.soak_us < due:
            self.stack.advance(due)
            self._show_progress(episode)
        self.late = max(self.late, (self.stack.soak_us - due) / _MICRO)

    def _processor_time(self) -> float:
        """Return the processor time of simulator and MAVROS layer, s."""
        pids = self.stack.pids()
        sample = CpuSample.take(os.getpid())
        return sum(
            sample.processes[pids[name]][1] for name in ("simulator", "mavros") if pids.get(name) in sample.processes
        )

    def _sample(self, episode: Episode, seconds: float, wall: float, cpu: float) -> None:
        row: dict[str, Any] = {
            "wall": round(time.monotonic() - self._begun, 2),
            "soak_time": self.stack.soak_us / _MICRO,
            "kind": episode.kind,
            "episode": episode.number,
            "rtf": round(seconds / wall, 3),
            "cpu_per_second": round(cpu / seconds, 5),
            "participants": len(self.stack.status().participants),
        }
        for process, pid in self.stack.pids().items():
            row |= {f"{process}_{name}": value for name, value in limits.process_figures(pid).items()}
        self.rows.append(row)
        self._writer.writerow(row)
        self._file.flush()

    def _show_progress(self, episode: Episode) -> None:
        now = time.monotonic()
        if now >= self._line_due:
            self._line_due = now + _LINE_PERIOD
            done, whole = self.stack.soak_us / _MICRO, self._hours * 3600.0
            factor = done / max(now - self._begun, 1e-3)
            self._console.print(
                f"{_clock(done)} of {_clock(whole)} simulated, {factor:.1f} x, {episode.kind} {episode.number}, ETA "
                f"{_clock(max(0.0, whole - done) / max(factor, 1e-3))}", highlight=False, soft_wrap=True, markup=False,
            )  # fmt: skip

    # ---- files

    def _check_ended(self, node: Node) -> None:
        """Look for a traceback in the logs of a node that was not killed, and remove those of a good one."""
        found = [] if node.harmed else list(_tracebacks(node.folder.rglob("*.log")))
        self.wrong += found
        if not found and (node.ended or node.process.returncode in node.allowed):
            shutil.rmtree(node.folder, ignore_errors=True)

    def read_files(self, *, all_closed: bool = False) -> None:
        """Read the finished flight logs and bags to their end and remove them, so that the disk does not fill.

        Args:
            all_closed: Whether the simulator has ended, so that it writes no log any more.
        """
        pid = self.stack.pids().get("simulator")
        written: set[str] = set()
        if pid is not None and not all_closed:
            for entry in Path(f"/proc/{pid}/fd").iterdir():
                with contextlib.suppress(OSError):  # closed in between
                    written.add(os.readlink(entry))
        logs = [path for path in sorted(self.stack.flight_logs.rglob("*.ulg")) if str(path) not in written]
        messages, damaged = read_files([*logs, *sorted(self.actions.bags.iterdir())])
        self.messages += messages
        self.wrong += damaged

    def close(self) -> None:
        """End everything and collect the last findings."""
        import rospy

        self.stack.concluding = True
        self.nodes.end_all()
        rospy.signal_shutdown("the soak has ended")
        self.stack.end()
        self.read_files(all_closed=True)
        # The master logs a traceback for each update that it cannot deliver to a killed node; rosout repeats all logs.
        logs = [path for path in self.stack.logs.glob("**/*.log") if not path.name.startswith(("master", "rosout"))]
        self.wrong += [*self.nodes.wrong, *_tracebacks(path for path in logs if "nodes" not in path.parts)]
        self.stack.close()
        self._file.close()


def _tracebacks(logs: Iterable[Path]) -> Iterator[str]:
    """Yield a line for each log with a traceback: its path and the last line of the text."""
    for path in logs:
        text = path.read_text(encoding="utf-8", errors="replace") if path.is_file() and not path.is_symlink() else ""
        _, found, rest = text.partition(_TRACEBACK)
        if found and _ROSOUT_CLOSED not in rest:
            yield f"{path}: {rest.strip().splitlines()[-1] if rest.strip() else found}"


def _soak(settings: SoakSettings, episodes: Sequence[Episode], folder: Path, console: Console, *, short: bool) -> int:
    """Run, and write a report in any case."""
    hours = sum(episode.length for episode in episodes) / 3600.0
    console.print(f"Results: {folder}", highlight=False, soft_wrap=True)
    with StopRequest() as stop:
        stack = Stack(folder, settings.n, settings.seed, settings.speed, command_options.free_port(), stop)
        soak: Soak | None = None
        end = ""
        try:
            stack.wait_until_up()
            # On wall time, as /clock has a thousand messages a second.
            init_plain_node("soak", disable_signals=True, disable_rostime=True)
            soak = Soak(stack, settings, hours, console)
            soak.run(episodes)
        except Stopped as stopped:
            end = f"stopped by {stopped}"
        except (SoakError, SimError) as error:
            end = str(error)
        number, stop.number = stop.number, 0  # the conclusion is not interrupted
        if soak is None:
            stack.close()
            raise SoakError(end)
        soak.close()
    failed = _report(soak, settings, end, console, short=short)
    return 128 + number if number else int(failed)


def _report(soak: Soak, settings: SoakSettings, end: str, console: Console, *, short: bool) -> bool:
    """Write report.json and soak.png, print the table; return whether a limit was exceeded."""
    actions, folder = soak.actions, soak.stack.folder
    failures = limits.failures(soak.rows, actions.flights, actions.expected, judge_growth=not short)
    failures += [*soak.wrong, *([end] if end else [])]
    found = {} if short else limits.growths(soak.rows)
    content = {
        "settings": {"n": settings.n, "seed": settings.seed, "speed": settings.speed, "short": short},
        "machine": machine_facts(command_options.repository()),
        "failures": failures,
        "simulated_hours": soak.stack.soak_us / 3600.0 / _MICRO,
        "growth_per_hour": {name: one._asdict() for name, one in found.items() if one.slope == one.slope},
        "counts": {
            "actions": dict(actions.counts), "nodes_started": soak.nodes.started, "expected": actions.expected,
            "flights": actions.flights, "forced": actions.forced, "refused": dict(actions.refused),
            "words_without_listener": actions.lost_words, "latest_event": soak.late, "messages": soak.messages,
        },
    }  # fmt: skip
    write_whole(folder / "report.json", json.dumps(content, indent=1) + "\n")
    if len(soak.rows) > 1:
        _draw(soak.rows, f"Soak of {settings.n} vehicles, seed {settings.seed}", folder / "soak.png")
    if found:
        table = Table("per simulated hour", "slope", "99 % within", "allowed")
        for name, (slope, low, high) in found.items():
            table.add_row(name, f"{slope:+.3f}", f"{low:+.3f} .. {high:+.3f}", f"{limits.ALLOWED_GROWTH[name]:g}")
        console.print(table)
    console.print(
        f"{content['simulated_hours']:.2f} h simulated, {actions.flights} of {actions.expected} vehicles took off when "
        f"commanded, {soak.messages} messages read from logs and bags", highlight=False, soft_wrap=True,
    )  # fmt: skip
    for failure in failures:
        console.print(f"not good: {failure}", highlight=False, soft_wrap=True, markup=False)
    console.print(f"{'not good' if failures else 'good'}: {folder / 'report.json'}", highlight=False, soft_wrap=True)
    return bool(failures)


def _draw(rows: Sequence[dict[str, Any]], title: str, path: Path) -> None:
    """Draw memory, descriptors, threads and real-time factor over simulated time."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    from xtdrone_interaction.pictures.picture_style import save_figure

    figure, axes = plt.subplots(2, 2, figsize=(13, 8), sharex=True, layout="constrained")
    drawn = (("rss", "memory (resident set) [MiB]"), ("descriptors", "open descriptors"), ("threads", "threads"))
    for axis, (name, label) in zip(axes.flat, drawn, strict=False):
        for process in limits.PROCESSES:
            known = [row for row in rows if f"{process}_{name}" in row]
            hours = [row["soak_time"] / 3600 for row in known]
            axis.plot(hours, [row[f"{process}_{name}"] for row in known], "o-", ms=2.5, lw=0.7, label=process)
        axis.set(ylabel=label, ylim=(0, None))
    for kind in dict.fromkeys(row["kind"] for row in rows):
        own = [row for row in rows if row["kind"] == kind]
        axes[1, 1].plot([row["soak_time"] / 3600 for row in own], [row["rtf"] for row in own], "o-", ms=3, lw=0.7,
                        label=kind.replace("_", " "))  # fmt: skip
    axes[1, 1].set(ylabel="simulated s / wall s, of each episode", ylim=(0, None))
    for axis in axes.flat:
        axis.grid(alpha=0.3)
        axis.legend(fontsize=8)
        axis.set(xlabel="simulated time [h]")
    figure.suptitle(f"{title}: between episodes, when nothing flies and no other node runs")
    save_figure(figure, path, dpi=110)
