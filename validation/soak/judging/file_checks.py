"""Reads flight logs and bags to their end and judges them: ``python -m validation.soak.judging.file_checks``.

A separate process at low priority: it reads a JSON list ``[kind, path, may_be_cut]`` per line from standard input,
writes a JSON object of a :class:`Finding` per line, and ends with its input.
"""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path

from xtdrone_interaction.bags.bag_kinds import Layouts, by_connection, large_batches, whole_messages
from xtdrone_interaction.bags.ros1bag import BagError, BagFile
from xtdrone_interaction.recording.flight_from_ulog import LogError, read_log

_NICE = 10
_KEPT = 3  # number of whole files kept of each kind
_MIB = 1 << 20
_BACKLOG = 3 << 30  # bytes; above this size of the queue the soak waits for the judge


@dataclass(frozen=True)
class Finding:
    """Verdict on a file.

    Attributes:
        kind: ``ulog`` or ``bag``.
        path: of the file.
        verdict: ``whole``, ``cut`` (truncated by the kill of its recorder, readable up to its end), or ``damaged``.
        size: bytes.
        messages: number of messages read.
        notes: descriptions of the errors.
    """

    kind: str
    path: str
    verdict: str
    size: int
    messages: int
    notes: list[str]


def judge_log(path: Path) -> Finding:
    """Judge a ULog; a truncated one is damaged, as its autopilot was not killed."""
    size = path.stat().st_size
    try:
        log = read_log(path, ())
    except LogError as error:
        return Finding("ulog", str(path), "damaged", size, 0, [str(error)])
    return Finding("ulog", str(path), "whole" if log.whole else "damaged", size, sum(log.counts.values()), log.notes)


def judge_bag(path: Path, may_be_cut: bool) -> Finding:
    """Judge a bag; all its messages must match their definitions.

    Args:
        path: of the file; ``.active`` after a kill of the recorder.
        may_be_cut: whether its recorder was killed, so that an index and the end of the last record may be missing.
    """
    size = path.stat().st_size
    if not size and may_be_cut:
        return Finding("bag", str(path), "cut", 0, 0, ["it is empty: the recorder was killed before its first write"])
    messages, odd = 0, 0
    try:
        bag = BagFile(path)
        layouts = Layouts()
        for batch in large_batches(bag):
            for number, part in by_connection(batch):
                connection = bag.connections.get(number)
                layout = None if connection is None else layouts.of(connection)
                messages += len(part.time)
                odd += len(part.time) - (0 if layout is None else len(whole_messages(layout, part)))
    except BagError as error:
        return Finding("bag", str(path), "damaged", size, messages, [str(error)])
    notes = list(bag.notes)
    if odd:
        notes.append(f"{odd} messages do not match their definition")
    cut = may_be_cut and bag.cut and not bag.damaged and not odd
    verdict = "whole" if not notes else "cut" if cut else "damaged"
    return Finding("bag", str(path), verdict, size, messages, notes)


def main() -> None:
    """Judge the files named on standard input."""
    os.nice(_NICE)
    for line in sys.stdin:
        kind, path, may_be_cut = json.loads(line)
        try:
            finding = judge_log(Path(path)) if kind == "ulog" else judge_bag(Path(path), may_be_cut)
        except Exception as error:  # any error caused by a damaged file is a finding
            finding = Finding(kind, path, "damaged", 0, 0, [f"{type(error).__name__}: {error}"])
        print(json.dumps(asdict(finding)), flush=True)


class Judge:
    """Judges files in a separate process, and removes all but a few of the whole ones.

    Attributes:
        counts: files by kind and verdict, as ``("ulog", "whole")``.
        bytes: read, by kind.
        messages: read, by kind.
        damaged: findings of damaged files.
    """

    def __init__(self, folder: Path, environment: Mapping[str, str]) -> None:
        """Start the process.

        Args:
            folder: of kept files.
            environment: of the process.
        """
        self.counts: Counter[tuple[str, str]] = Counter()
        self.bytes: Counter[str] = Counter()
        self.messages: Counter[str] = Counter()
        self.damaged: list[Finding] = []
        self._folder = folder
        self._waiting: dict[str, int] = {}
        self._lock = threading.Lock()
        self._process = subprocess.Popen(
            [sys.executable, "-m", "validation.soak.judging.file_checks"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env=dict(environment),
            start_new_session=True,
            text=True,
        )
        self._reader = threading.Thread(target=self._read, name="judge", daemon=True)
        self._reader.start()

    def give(self, kind: str, path: Path, may_be_cut: bool = False) -> None:
        """Queue a file that is no longer written to; ignore a file queued before."""
        with self._lock:
            if str(path) in self._waiting:
                return
            self._waiting[str(path)] = path.stat().st_size
        assert self._process.stdin is not None
        with contextlib.suppress(BrokenPipeError):
            self._process.stdin.write(json.dumps([kind, str(path), may_be_cut]) + "\n")
            self._process.stdin.flush()

    @property
    def backlog(self) -> int:
        """Number of files in the queue."""
        with self._lock:
            return len(self._waiting)

    @property
    def overloaded(self) -> bool:
        """Whether the queue is so long that no more files should be written."""
        with self._lock:
            return sum(self._waiting.values()) > _BACKLOG and self._process.poll() is None

    def _read(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            finding = Finding(**json.loads(line))
            key = finding.kind, finding.verdict
            self.counts[key] += 1
            self.bytes[finding.kind] += finding.size
            self.messages[finding.kind] += finding.messages
            self._put_away(finding, self.counts[key])
            with self._lock:
                self._waiting.pop(finding.path, None)

    def _put_away(self, finding: Finding, number: int) -> None:
        path = Path(finding.path)
        if finding.verdict == "damaged":
            self.damaged.append(finding)
        if finding.verdict != "damaged" and number > _KEPT:
            path.unlink(missing_ok=True)
            return
        self._folder.mkdir(parents=True, exist_ok=True)
        name = f"{finding.verdict}-{number}-{path.parent.parent.name}-{path.name}"
        with contextlib.suppress(OSError):
            path.rename(self._folder / name)

    def close(self, limit: float) -> int:
        """Judge the remaining files for up to ``limit`` s of wall time; return the number of those left."""
        assert self._process.stdin is not None
        with contextlib.suppress(OSError):
            self._process.stdin.close()
        end = time.monotonic() + limit
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(max(0.0, end - time.monotonic()))
        if self._process.poll() is None:
            self._process.kill()
            self._process.wait()
        self._reader.join(5.0)
        return self.backlog


if __name__ == "__main__":
    main()
