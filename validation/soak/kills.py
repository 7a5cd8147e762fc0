"""Outcome of the formation flight when one of its nodes is killed or suspended; run manually::

    python -m validation.soak.kills --out FOLDER                        # every node, signal and phase
    python -m validation.soak.kills --out FOLDER --node mavros --signal KILL --phase flying

Each case is a separate flight of two vehicles. Each writes a line of JSON to ``FOLDER/kills.jsonl`` and a row of the
table on the terminal. A suspended process is not resumed: the simulator drops it after ``HANG_LIMIT`` s of silence.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from xtdrone_interaction import command_options
from xtdrone_interaction.console import PatientConsole
from xtdrone_interaction.launching.process_tree import ProcessTree, descendants, end_descendants
from xtdrone_interaction.launching.supervised_launch import DemoError, run_flight
from xtdrone_interaction.missions.formation import cli as formation_cli
from xtdrone_interaction.missions.formation.cli import FormationSettings
from xtdrone_interaction.missions.mission import make_report, save_report
from xtdrone_interaction.monitoring.ended_nodes import EndedNodes
from xtdrone_interaction.recording.flight_events import read_events
from xtdrone_interaction.report.html_page import print_page

NODES = (
    "simulator",
    "mavros",
    "formation_director",
    "leader",
    "follower_1",
    "iris_0_communication",
    "iris_1_communication",
    "recorder",
    "rosout",
)
SIGNALS = ("KILL", "STOP")
PHASES = {"starting": "", "taking off": "takeoff", "flying": "pattern cube", "landing": "land"}
"""Names, and the director's for them."""
HANG_LIMIT = 6.0  # s of wall time

_POLL = 0.1  # s of wall time
_REACH_LIMIT = 300.0  # s of wall time until the phase begins
_END_LIMIT = 420.0  # s of wall time until the flight has ended
_SETTLE = 1.0  # s of wall time in a phase before the signal
_WORDS = 6  # last lines of the demo's output
_SETTINGS = FormationSettings(
    n=2, type="iris", patterns=("cube",), pattern_file="", processes="per_uav",
    follower=command_options.DEFAULT_FOLLOWER,
    follower_class="", control="vel", avoidance="own", clearance=3.0, world="empty", seed=0, speed=0.0, out=Path(),
    master_port=0, headless=True, logs=False,
)  # fmt: skip


@dataclass(frozen=True)
class Case:
    """A case and its outcome.

    Attributes:
        node, signal, phase: signal sent to a node in a phase.
        hit: whether the node was running and the phase was reached.
        status: exit status of the demo; None if it did not end in time and was killed.
        seconds: wall time from the signal to the end of the demo, s.
        events: last event of the director.
        words: last lines of the demo's output.
        orphans: command lines of remaining processes.
    """

    node: str
    signal: str
    phase: str
    hit: bool
    status: int | None
    seconds: float
    events: str
    words: list[str]
    orphans: list[str]


def fly(out: Path) -> int:
    """Fly the demo as its command does, with a short hang limit; return its exit status."""
    settings = replace(_SETTINGS, out=out, master_port=command_options.free_port())
    flight = formation_cli.flight(settings)
    flight = replace(flight, arguments={**flight.arguments, "hang_limit": HANG_LIMIT})
    console = PatientConsole()

    def conclude(ended_nodes: EndedNodes) -> int:
        last = flight.events()[-1]
        if last["event"] == "failed":
            raise DemoError(last["reason"])
        made = make_report(formation_cli.load_mission(), out / flight.bag, {}, list(ended_nodes.found.values()))
        print_page(made.page, console)
        return save_report(made, out, console)

    return run_flight(flight, console, conclude)


def run(node: str, number: str, phase: str, folder: Path) -> Case:
    """Run a case in ``folder``, which is made."""
    folder.mkdir(parents=True)
    out = folder / "flight"
    command = [sys.executable, "-m", "validation.soak.kills", "--fly", str(out)]
    demo = ProcessTree(command, os.environ, folder / "demo.log").process  # its orphans become children of this process
    hit = _strike(demo, out, node, signal.Signals[f"SIG{number}"], PHASES[phase])
    struck = time.monotonic()
    with contextlib.suppress(subprocess.TimeoutExpired):
        demo.wait(_END_LIMIT)
    status = demo.poll()
    if status is None:
        demo.kill()
        demo.wait()
    seconds = time.monotonic() - struck
    orphans = [text for pid in descendants() if (text := _command(pid))]
    end_descendants()
    words = [line.strip() for line in (folder / "demo.log").read_text(errors="replace").splitlines() if line.strip()]
    events = read_events(out / "events.jsonl") if (out / "events.jsonl").is_file() else []
    last = json.dumps(events[-1])[:200] if events else ""
    return Case(node, number, phase, hit, status, round(seconds, 1), last, words[-_WORDS:], orphans)


def _strike(demo: subprocess.Popen[bytes], out: Path, node: str, number: signal.Signals, phase: str) -> bool:
    """Send the signal when the phase begins; return whether it was sent."""
    end = time.monotonic() + _REACH_LIMIT
    while demo.poll() is None and time.monotonic() < end:
        pid = _pid(node)
        reached = not phase or any(
            event["event"] == "phase" and event["phase"] == phase
            for event in (read_events(out / "events.jsonl") if (out / "events.jsonl").is_file() else ())
        )
        if pid and reached:
            time.sleep(_SETTLE if phase in ("takeoff", "pattern cube", "") else 0.1)
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, number)
                return True
            return False
        time.sleep(_POLL)
    return False


def _pid(node: str) -> int:
    """Return the process of a node below this one, 0 where there is none yet."""
    for pid in descendants():
        words = _command(pid).split()
        if f"__name:={node}" in words:
            return pid
    return 0


def _command(pid: int) -> str:
    with contextlib.suppress(OSError):
        return Path(f"/proc/{pid}/cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace").strip()
    return ""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the cases; return 1 if a flight did not end or left processes."""
    parser = argparse.ArgumentParser(prog="kills", description="Kill and stop each node of the formation flight.")
    parser.add_argument("--fly", type=Path, help=argparse.SUPPRESS)
    parser.add_argument("--out", type=Path, metavar="FOLDER")
    parser.add_argument("--node", choices=NODES, action="append")
    parser.add_argument("--signal", choices=SIGNALS, action="append")
    parser.add_argument("--phase", choices=PHASES, action="append")
    arguments = parser.parse_args(argv)
    if arguments.fly:
        return fly(arguments.fly)
    if arguments.out is None:
        parser.error("--out is needed")
    good = True
    for phase in arguments.phase or PHASES:
        for node in arguments.node or NODES:
            for number in arguments.signal or SIGNALS:
                folder = arguments.out.resolve() / f"{node}-{number}-{phase.replace(' ', '-')}"
                case = run(node, number, phase, folder)
                with (arguments.out / "kills.jsonl").open("a", encoding="utf-8") as file:
                    file.write(json.dumps(asdict(case)) + "\n")
                status = "none" if case.status is None else case.status
                print(
                    f"{phase:<11} {node:<21} {number:<5} hit {case.hit!s:<5} status {status:<5} "
                    f"{case.seconds:6.1f} s  {len(case.orphans)} left  {' | '.join(case.words[-2:])[:200]}",
                    flush=True,
                )
                good = good and case.status is not None and not case.orphans
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
