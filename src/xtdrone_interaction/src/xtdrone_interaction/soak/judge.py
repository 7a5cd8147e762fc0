"""Reads flight logs and bags to their end and judges them: ``python -m xtdrone_interaction.soak.judge``.

A process of its own, at low priority: it takes a JSON list ``[kind, path, may_be_cut]`` a line on its standard input,
answers with a JSON object of a :class:`Finding` a line, and ends with its input.
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

from xtdrone_interaction.analysis.ros1bag import BagError, BagFile
from xtdrone_interaction.analysis.source import Layouts, by_connection, large_batches, whole_messages
from xtdrone_interaction.analysis.ulog import LogError, read_log

_NICE = 10
_KEPT = 3  # whole files of each kind that are kept
_CUT_WORDS = ("cut off", "did not end it")  # of the bag reader's notes, for what a killed recorder leaves
_MIB = 1 << 20
_BACKLOG = 3 << 30  # bytes of files that may wait; the soak waits for the judge beyond


@dataclass(frozen=True)
class Finding:
    """What became of a file.

    Attributes:
        kind: ``ulog`` or ``bag``.
        path: of the file.
        verdict: ``whole``, ``cut`` (readable up to its end, of a recorder that was killed), or ``damaged``.
        size: bytes.
        messages: how many were read.
        notes: what was wrong, in words.
    """

    kind: str
    path: str
    verdict: str
    size: int
    messages: int
    notes: list[str]


def judge_log(path: Path) -> Finding:
    """Return whether a ULog is whole; one that is cut is damaged, as the autopilot that wrote it went on."""
    size = path.stat().st_size
    try:
        log = read_log(path, ())
    except LogError as error:
        return Finding("ulog", str(path), "damaged", size, 0, [str(error)])
    return Finding("ulog", str(path), "damaged" if log.cut else "whole", size, sum(log.counts.values()), log.notes)


def judge_bag(path: Path, may_be_cut: bool) -> Finding:
    """Return whether a bag is whole, every message of it as its definition says.

    Args:
        path: of the file; ``.active`` where the recorder was killed.
        may_be_cut: whether its recorder was killed, so that it need not have an index nor end with a whole record.
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
        notes.append(f"{odd} messages are not as their definition says")
    expected = not odd and all(any(word in note for word in _CUT_WORDS) for note in notes)
    verdict = "whole" if not notes else "cut" if expected and may_be_cut else "damaged"
    return Finding("bag", str(path), verdict, size, messages, notes)


def main() -> None:
    """Judge what comes on standard input."""
    os.nice(_NICE)
    for line in sys.stdin:
        kind, path, may_be_cut = json.loads(line)
        try:
            finding = judge_log(Path(path)) if kind == "ulog" else judge_bag(Path(path), may_be_cut)
        except Exception as error:  # whatever a damaged file leads to is said of the file
            finding = Finding(kind, path, "damaged", 0, 0, [f"{type(error).__name__}: {error}"])
        print(json.dumps(asdict(finding)), flush=True)


class Judge:
    """Has files judged in a process of its own, and removes those that are whole but for a few.

    Attributes:
        counts: files by kind and verdict, as ``("ulog", "whole")``.
        bytes: read, by kind.
        messages: read, by kind.
        damaged: findings of those.
    """

    def __init__(self, folder: Path, environment: Mapping[str, str]) -> None:
        """Start the process.

        Args:
            folder: where files are kept.
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
            [sys.executable, "-m", "xtdrone_interaction.soak.judge"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env=dict(environment),
            start_new_session=True,
            text=True,
        )
        self._reader = threading.Thread(target=self._read, name="judge", daemon=True)
        self._reader.start()

    def give(self, kind: str, path: Path, may_be_cut: bool = False) -> None:
        """Have a file judged; it must not be written any more. One that was given before is not taken again."""
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
        """How many files wait."""
        with self._lock:
            return len(self._waiting)

    @property
    def overloaded(self) -> bool:
        """Whether so much waits that the disk should not get more."""
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
        """Let all be judged, up to ``limit`` s of wall time; return how many were not."""
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
