"""Benchmark of the lockstep's barrier alone: ``python -m benchmarks.programs.barrier``.

Takes the place of the simulator, without a world: starts a ROS master and a number of idle participants
(``lockstep_idle`` of xtdrone_lockstep, in Python or C++) that are all due at every base step, and measures the time
of each tick. Ends all processes that it has started.

Exit status: 0 after a measurement, 1 after a failed one, 130 when interrupted.
"""

from __future__ import annotations

import argparse
import logging
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import rosgraph
import roslib.packages

from benchmarks.process_use import CpuSample
from benchmarks.programs.program_frame import Column, Row, run
from xtdrone_common.fleet import MAX_VEHICLES
from xtdrone_common.settings import Settings, setting
from xtdrone_interaction import command_options
from xtdrone_lockstep.protocol import BASE_STEP_US
from xtdrone_lockstep.server import LockstepServer

PROGRAMS = {"python": "lockstep_idle.py", "cpp": "lockstep_idle"}
"""Programs of xtdrone_lockstep by kind."""
NO_PARTICIPANTS = "none"
"""The kind of a barrier without participants."""
RATE = 1e6 / BASE_STEP_US  # Hz
WARM_UP = 50  # unmeasured ticks

_MASTER_LIMIT = 15.0  # s of wall time
_START_LIMIT = 30.0  # s of wall time until all have joined, and _START_LIMIT_EACH more for each
_START_LIMIT_EACH = 3.0
_STOP_LIMIT = 10.0  # s of wall time for all participants to end
_POLL = 0.05  # s
_HANG_LIMIT = 20.0  # s

Figures = dict[str, Any]


class BarrierError(RuntimeError):
    """A measurement that failed; the message gives the reason."""


def run_ticks(server: LockstepServer, seconds: float, ticks: int) -> list[int]:
    """Run ticks and return their wall times, ns.

    Args:
        server: with all participants.
        seconds: minimum wall time of the measurement.
        ticks: minimum number of measured ticks.
    """
    server.tick(0)
    now = 0
    durations: list[int] = []
    end = float("inf")
    while len(durations) < WARM_UP + ticks or time.monotonic() < end:
        if len(durations) == WARM_UP:
            end = time.monotonic() + seconds
        start = time.perf_counter_ns()
        now = server.next_due_us(now) or now + BASE_STEP_US
        server.tick(now)
        durations.append(time.perf_counter_ns() - start)
    return durations[WARM_UP:]


def figures(durations: Sequence[int]) -> Figures:
    """Return the figures of ticks that took ``durations``, ns: their number, and microseconds per tick."""
    micros = np.asarray(durations) * 1e-3
    return {
        "ticks": len(durations),
        "mean_us": float(micros.mean()),
        "median_us": float(np.median(micros)),
        "p99_us": float(np.percentile(micros, 99)),
    }


def measure(kind: str, participants: int, seconds: float, ticks: int) -> Figures:
    """Measure the barrier.

    Args:
        kind: of the participants, a key of PROGRAMS; not used without participants.
        participants: number of participants.
        seconds: minimum wall time of the measurement.
        ticks: minimum number of measured ticks.

    Returns:
        ticks, mean_us, median_us, p99_us (wall time of a tick), server_cpu_us and participants_cpu_us (CPU time of a
        tick, of all participants together), others_cpu (cores used by other programs).

    Raises:
        BarrierError: it failed.
    """
    server = LockstepServer(hang_limit=_HANG_LIMIT, log=_log)
    try:
        with _master() as uri, _participants(kind, participants, uri, server):
            limit = _START_LIMIT + _START_LIMIT_EACH * participants
            if not server.wait_for(participants, limit):
                raise BarrierError(f"after {limit:.0f} s: {server.missing(participants)}")
            before, began = CpuSample.take(os.getpid()), time.monotonic()
            durations = run_ticks(server, seconds, ticks)
            elapsed, use = time.monotonic() - began, CpuSample.take(os.getpid()).since(before)
            if len(server.participants) != participants:
                raise BarrierError(f"only {len(server.participants)} of {participants} participants lasted to the end")
    finally:
        server.close()
    per_tick = 1e6 / (len(durations) + WARM_UP)
    idle = Path(PROGRAMS.get(kind, "")).stem
    own = {name: cpu for name, cpu in use.programs.items() if name not in (idle, "rosmaster")}
    return figures(durations) | {
        "server_cpu_us": sum(own.values()) * per_tick,
        "participants_cpu_us": use.programs.get(idle, 0.0) * per_tick,
        "others_cpu": use.others / elapsed,
    }


@contextmanager
def _master() -> Iterator[str]:
    """Run a ROS master on a free port; yields its URI.

    Raises:
        BarrierError: it does not start.
    """
    program = shutil.which("rosmaster")
    if program is None:
        raise BarrierError("rosmaster: not found; source the workspace's devel/setup.bash first")
    port = command_options.free_port()
    uri = f"http://127.0.0.1:{port}"
    process = subprocess.Popen([program, "--core", "-p", str(port)], stdout=subprocess.DEVNULL)
    try:
        end = time.monotonic() + _MASTER_LIMIT
        while not rosgraph.is_master_online(uri):
            if process.poll() is not None or time.monotonic() > end:
                raise BarrierError(f"rosmaster: does not answer on port {port}")
            time.sleep(_POLL)  # the master signals no event for this
        yield uri
    finally:
        _end([process])


@contextmanager
def _participants(kind: str, count: int, uri: str, server: LockstepServer) -> Iterator[None]:
    """Run participants of ``server`` at the master ``uri``.

    Raises:
        BarrierError: their program does not exist.
    """
    rosgraph.Master("/simulator", master_uri=uri).setParam("/lockstep/uri", server.uri)
    program = node_program(PROGRAMS[kind]) if count else ""
    environment = {**os.environ, "ROS_MASTER_URI": uri, "ROS_IP": "127.0.0.1"}
    environment.pop("ROS_HOSTNAME", None)
    started: list[subprocess.Popen[bytes]] = []
    try:
        for number in range(count):
            command = [program, f"idle_{number}", f"{RATE:g}"]
            started.append(subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL))
        yield
    finally:
        _end(started)


def node_program(name: str) -> str:
    """Return the path of a program of xtdrone_lockstep.

    Raises:
        BarrierError: it does not exist.
    """
    found = roslib.packages.find_node("xtdrone_lockstep", name)
    if not found:
        raise BarrierError(f"{name}: not found in xtdrone_lockstep; is the workspace built?")
    return str(found[0])


def _end(processes: Sequence[subprocess.Popen[bytes]]) -> None:
    """End processes with SIGINT, and with SIGKILL after a time limit."""
    for process in processes:
        process.send_signal(signal.SIGINT)
    end = time.monotonic() + _STOP_LIMIT
    for process in processes:
        with suppress(subprocess.TimeoutExpired):
            process.wait(max(0.0, end - time.monotonic()))
    for process in processes:
        if process.poll() is None:
            process.kill()
            process.wait()


def _log(level: int, text: str) -> None:
    if level >= logging.WARNING:
        print(f"{logging.getLevelName(level)}: {text}", file=sys.stderr)


COLUMNS = (
    Column("participants", "{participants}"),
    Column("kind", "{kind}"),
    Column("median us", "{median_us:.1f}"),
    Column("p99 us", "{p99_us:.1f}"),
    Column("ticks", "{ticks}"),
)


@dataclass(frozen=True, kw_only=True)
class BarrierSettings(Settings):
    """Settings of a measurement."""

    kind: str = setting("python", choices=(*PROGRAMS, NO_PARTICIPANTS), text="program of the participants")
    participants: int = setting(9, low=0, high=MAX_VEHICLES, text="number of participants")
    seconds: float = setting(2.0, low=0.0, high=3600.0, unit="s", text="minimum wall time of the measurement")
    ticks: int = setting(200, low=1, high=10_000_000, text="minimum number of ticks")


def main() -> int:
    """Measure the number of participants of the command line and return the exit status."""
    parser = argparse.ArgumentParser(description="Measure the lockstep's barrier with idle participants.")
    BarrierSettings.add_arguments(parser)
    return run(parser, _cases, COLUMNS, (BarrierError,))


def _cases(arguments: argparse.Namespace) -> Iterator[Row]:
    chosen = BarrierSettings.from_arguments(arguments)
    yield {
        "participants": chosen.participants,
        "kind": chosen.kind,
        **measure(chosen.kind, chosen.participants, chosen.seconds, chosen.ticks),
    }


if __name__ == "__main__":
    sys.exit(main())
