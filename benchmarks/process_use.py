"""CPU time and memory of a tree of processes, from Linux's /proc; needs the standard library only."""

from __future__ import annotations

import os
from collections import defaultdict
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

PROC = Path("/proc")
_TICKS = os.sysconf("SC_CLK_TCK")  # unit of the CPU times in /proc, 1/s
_UTIME, _STIME = 11, 12  # fields of /proc/PID/stat after the program's name
_BUSY = (0, 1, 2, 5, 6)  # user, nice, system, irq, softirq among the numbers of /proc/stat
_STEAL = 7


@dataclass(frozen=True)
class CpuUse:
    """CPU time between two samples.

    Attributes:
        programs: CPU s by program, of all its processes that are alive at the second sample.
        others: CPU s of all other programs and of other machines on the hypervisor; at least 0.
    """

    programs: dict[str, float]
    others: float


@dataclass(frozen=True)
class CpuSample:
    """CPU time since the start of each process.

    Attributes:
        processes: program and CPU s of each process of a tree, by process id.
        machine: CPU s of all programs since the start of the machine, plus those stolen by the hypervisor.
    """

    processes: dict[int, tuple[str, float]]
    machine: float

    @classmethod
    def take(cls, root: int, proc: Path = PROC) -> CpuSample:
        """Sample the tree of process ``root``."""
        processes = {}
        for pid in process_tree(root, proc):
            with suppress(OSError):  # it has ended in between
                fields = _stat(pid, proc)
                processes[pid] = (program(pid, proc), (int(fields[_UTIME]) + int(fields[_STIME])) / _TICKS)
        numbers = [int(text) for text in (proc / "stat").read_text(encoding="ascii").splitlines()[0].split()[1:]]
        return cls(processes, sum(numbers[i] for i in (*_BUSY, _STEAL)) / _TICKS)

    def since(self, before: CpuSample) -> CpuUse:
        """Return the use between ``before`` and this sample."""
        programs: defaultdict[str, float] = defaultdict(float)
        for pid, (name, seconds) in self.processes.items():
            programs[name] += seconds - before.processes.get(pid, (name, 0.0))[1]
        own = sum(programs.values())
        return CpuUse(dict(programs), max(0.0, self.machine - before.machine - own))


def overlap(programs: Mapping[str, float], elapsed: float) -> float:
    """Return the share of this machine's cores that programs used, 0 to 1: 1 if none ever waited for another.

    Args:
        programs: CPU s by program.
        elapsed: wall time, s, above 0.
    """
    return sum(programs.values()) / (elapsed * len(os.sched_getaffinity(0)))


def process_tree(root: int, proc: Path = PROC) -> list[int]:
    """Return the ids of ``root`` and of all processes below it, without zombies."""
    children: dict[int, list[int]] = {}
    for entry in proc.iterdir():
        if not entry.name.isdigit():
            continue
        with suppress(OSError):  # it has ended in between
            state, parent = _stat(int(entry.name), proc)[:2]
            if state not in "ZX":
                children.setdefault(int(parent), []).append(int(entry.name))
    found = [root]
    for pid in found:  # grows during the iteration
        found += children.get(pid, [])
    return found


def memory(pids: Iterable[int], proc: Path = PROC) -> int:
    """Return the memory of processes, bytes: the sum of their proportional set sizes.

    A page shared by k processes counts 1/k in each, so that the sum is the memory occupied by all of them together.
    """
    total = 0
    for pid in pids:
        with suppress(OSError):  # it has ended in between
            lines = (proc / str(pid) / "smaps_rollup").read_text(encoding="ascii").splitlines()
            total += sum(int(line.split()[1]) * 1024 for line in lines if line.startswith("Pss:"))
    return total


def program(pid: int, proc: Path = PROC) -> str:
    """Return the name of the script or binary of a process, without folder and ``.py``.

    Raises:
        OSError: it has ended.
    """
    text = (proc / str(pid) / "cmdline").read_bytes().decode("utf-8", errors="replace")
    words = [word for word in text.split("\0") if word]
    if not words:
        return "unknown"
    if Path(words[0]).name.startswith("python"):
        words = [word for word in words[1:] if not word.startswith("-")] or words
    return Path(words[0]).name.removesuffix(".py")


def _stat(pid: int, proc: Path) -> list[str]:
    """Return the fields of /proc/PID/stat after the name of the program, which may contain any character."""
    text = (proc / str(pid) / "stat").read_text(encoding="utf-8", errors="replace")
    return text.rsplit(")", 1)[1].split()
