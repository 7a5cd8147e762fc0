"""Runs a soak's script against the simulation, and samples it."""

from __future__ import annotations

import os
import shutil
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any

from benchmarks.process_use import CpuSample
from validation.soak.actions import Actions, bag_of
from validation.soak.judging.file_checks import Judge
from validation.soak.judging.verdict import Stretch
from validation.soak.judging.warnings_in_logs import TextLogs, tracebacks_in
from validation.soak.resource_samples import PROCESSES, SampleFile, figures, folder_size, open_files
from validation.soak.simulation_under_test import Node, Nodes, Stack
from validation.soak.soak_script import Episode

_MICRO = 1_000_000
_MINUTE = 60 * _MICRO
_KEPT_LOGS = 100  # maximum number of folders kept, of nodes with errors in their logs


@dataclass
class Phase:
    """State of the current episode.

    Attributes:
        episode: of the script.
        begin_us: soak time at its beginning, us.
    """

    episode: Episode
    begin_us: int


@dataclass
class Tally:
    """Findings of a soak so far, besides its samples.

    Attributes:
        stretches: an entry for each finished episode.
        wall: wall time of episodes by kind, including all waiting, s.
        simulated: simulated time by kind, s.
        episodes: finished ones by kind.
        tracebacks: of nodes that were not killed, with their files.
        late: maximum delay of an event, simulated s.
    """

    stretches: list[Stretch] = field(default_factory=list)
    wall: dict[str, float] = field(default_factory=dict)
    simulated: dict[str, float] = field(default_factory=dict)
    episodes: dict[str, int] = field(default_factory=dict)
    tracebacks: list[str] = field(default_factory=list)
    late: float = 0.0


class _Cpu:
    """Processor time up to now."""

    def __init__(self, soaked: Iterable[int]) -> None:
        sample = CpuSample.take(os.getpid())
        times = os.times()
        self.soaked = sum(sample.processes[pid][1] for pid in soaked if pid in sample.processes)
        own = sum(seconds for _, seconds in sample.processes.values())
        self.foreign = sample.machine - own - times.children_user - times.children_system
        self.wall = time.monotonic()


class Runner:
    """Executes a script.

    Attributes:
        stack, nodes, actions, judge, texts: the parts of the soak.
        samples: the CSV file.
        tally: findings.
        begun: wall time of the start, s, monotonic.
        phase: the current one; None before the first episode.
    """

    def __init__(self, stack: Stack, count: int, speed: float, progress: Callable[[Runner], None]) -> None:
        """Prepare the execution.

        Args:
            stack: the running simulation.
            count: number of vehicles.
            speed: target real-time factor, 0: unlimited.
            progress: called at short intervals.
        """
        self.stack = stack
        self.nodes = Nodes(stack, self._ended)
        self.actions = Actions(stack, self.nodes, count, speed)
        self.judge = Judge(stack.folder / "kept", stack.environment)
        self.texts = TextLogs(stack.logs)
        self.samples = SampleFile(stack.folder / "samples.csv")
        self.tally = Tally()
        self.begun = time.monotonic()
        self.phase: Phase | None = None
        self._progress = progress
        self._sample_due = 0
        self._last_sample = (0, 0.0)  # stepped_us, stepping_wall
        self._sample_cpu = _Cpu(self._soaked())

    def run(self, script: Iterable[Episode]) -> None:
        """Execute the whole script.

        Raises:
            SoakError: the simulation has failed.
            Stopped: a signal was received.
        """
        for episode in script:
            self._run_episode(episode)

    def _run_episode(self, episode: Episode) -> None:
        stack = self.stack
        self.phase = Phase(episode, stack.soak_us)
        begin, stepped, stepping = stack.soak_us, stack.stepped_us, stack.stepping_wall
        before = _Cpu(self._soaked())
        for event in episode.events:
            due = begin + round(event.time * _MICRO)
            if stack.soak_us < due:
                self.actions.settle()
                self._advance(due)
            self.tally.late = max(self.tally.late, (stack.soak_us - due) / _MICRO)
            self.actions.do(event.action, dict(event.arguments))
            self._progress(self)
        self.actions.settle()
        self._advance(begin + round(episode.length * _MICRO))
        after = _Cpu(self._soaked())
        self._note(episode, begin, stepped, stepping, before, after)
        self._tidy()
        self._sample(resting=True)

    def _note(self, episode: Episode, begin: int, stepped: int, stepping: float, before: _Cpu, after: _Cpu) -> None:
        tally, kind = self.tally, episode.kind
        wall = after.wall - before.wall
        simulated = (self.stack.soak_us - begin) / _MICRO
        timed = (self.stack.stepped_us - stepped) / _MICRO
        others = max(0.0, after.foreign - before.foreign) / max(wall, 1e-3)
        cpu = (after.soaked - before.soaked) * timed / max(simulated, 1e-3)
        tally.stretches.append(Stretch(kind, begin / _MICRO, timed, self.stack.stepping_wall - stepping, cpu, others))
        tally.wall[kind] = tally.wall.get(kind, 0.0) + wall
        tally.simulated[kind] = tally.simulated.get(kind, 0.0) + simulated
        tally.episodes[kind] = tally.episodes.get(kind, 0) + 1

    def _advance(self, soak_us: int) -> None:
        """Advance to ``soak_us``, with a sample each minute."""
        while self.stack.soak_us < soak_us:
            self.stack.advance(min(soak_us, max(self._sample_due, self.stack.soak_us + 1)))
            if self.stack.soak_us >= self._sample_due:
                self._sample(resting=False)
            self._progress(self)

    def _soaked(self) -> list[int]:
        pids = self.stack.pids()
        return [pids[name] for name in ("simulator", "mavros") if name in pids]

    def _sample(self, *, resting: bool) -> None:
        stack = self.stack
        self._sample_due = (stack.soak_us // _MINUTE + 1) * _MINUTE
        self.texts.update()
        status = stack.status()
        cpu, last = _Cpu(self._soaked()), self._sample_cpu
        seconds = (stack.stepped_us - self._last_sample[0]) / _MICRO
        wall = stack.stepping_wall - self._last_sample[1]
        self._last_sample, self._sample_cpu = (stack.stepped_us, stack.stepping_wall), cpu
        row: dict[str, Any] = {
            "wall": round(time.monotonic() - self.begun, 2),
            "soak_time": stack.soak_us / _MICRO,
            "sim_time": status.sim_time.to_sec(),
            "phase": self.phase.episode.kind if self.phase else "",
            "episode": self.phase.episode.number if self.phase else 0,
            "resting": int(resting),
            "rtf": round(seconds / wall, 3) if wall > 0.0 and seconds > 1.0 else "",
            "cpu_per_second": round((cpu.soaked - last.soaked) / seconds, 5) if seconds > 1.0 else "",
            "others": round(max(0.0, cpu.foreign - last.foreign) / max(cpu.wall - last.wall, 1e-3), 3),
            "participants": len(status.participants),
            "children": len(self.nodes.alive),
            "log_bytes": folder_size((stack.logs, stack.flight_logs, self.actions.bags)),
            "warnings": sum(self.texts.warnings.values()),
            "lost": self.texts.lost,
        }
        pids = stack.pids()
        for name in PROCESSES:
            if name in pids:
                row.update({f"{name}_{figure}": value for figure, value in figures(pids[name]).items()})
        self.samples.add(row)

    # ---- files

    def _ended(self, node: Node) -> None:
        """Process the files left by a node."""
        if node.name.split("_")[2] == "record":
            bag = bag_of(self.actions.bags, node)
            if bag is not None:
                self.judge.give("bag", bag, node.harmed)
            elif not node.harmed:
                self.nodes.wrong.append(f"{node.name}: ended normally without a bag")
        found = [] if node.harmed else tracebacks_in(node.folder)
        self.tally.tracebacks += found
        expected = node.ended or node.process.returncode in node.allowed
        if (not found and expected) or len(self.tally.tracebacks) > _KEPT_LOGS:
            shutil.rmtree(node.folder, ignore_errors=True)

    def give_logs(self, *, ended: bool = False) -> None:
        """Queue the completed flight logs for the judge; ``ended``: the simulator has ended."""
        pid = self.stack.pids().get("simulator")
        written = set() if ended or pid is None else open_files(pid)
        for path in sorted(self.stack.flight_logs.glob("*/*/*.ulg")):
            if str(path) not in written:
                self.judge.give("ulog", path)

    def _tidy(self) -> None:
        """Keep the disk free."""
        self.give_logs()
        self.stack.wait_for(lambda: not self.judge.overloaded, 3600.0)
