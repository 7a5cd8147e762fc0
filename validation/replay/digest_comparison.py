"""Compares flights by their digest files (see ``xtdrone_sim.runtime.digest_file``); needs no ROS.

For each second of simulated time, a digest file contains the number, bytes and checksum of the messages published by a
node on each of its topics so far, and the checksum of the true states of all vehicles at every tick. The comparison is
by topic, so that a flight with one process for all followers can be compared with one that has a process for each.
"""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

TRUTH = "truth"  # as xtdrone_sim.runtime.digest_file names it
State = tuple[int, int, int]
"""Messages, bytes, checksum."""
Key = tuple[str, str]
"""Topic and publisher; the publisher is empty for a topic with only one."""


class DigestError(ValueError):
    """A file is not a digest file."""


@dataclass(frozen=True)
class Digests:
    """Content of a digest file.

    Attributes:
        lines: states by simulated time, us.
        name: of the file, for messages.
    """

    lines: Mapping[int, Mapping[Key, State]]
    name: str

    @property
    def end(self) -> int:
        """The last time, in microseconds; 0 without any."""
        return max(self.lines, default=0)

    def truth(self) -> Digests:
        """Return only the true states of the vehicles."""
        return Digests(
            {t: {k: s for k, s in keys.items() if k[0] == TRUTH} for t, keys in self.lines.items()}, self.name
        )


@dataclass(frozen=True)
class Comparison:
    """Result of comparing two flights.

    Attributes:
        time: end of the compared part, simulated s.
        topics: number of compared topics.
        messages: number of messages published on them in the first flight.
        bytes: total size of these messages.
        difference_time: of the first difference, simulated s; None without one.
        differing: topics that differ at that time.
    """

    time: float
    topics: int
    messages: int
    bytes: int
    difference_time: float | None
    differing: tuple[str, ...]

    @property
    def same(self) -> bool:
        """Whether anything was compared without a difference."""
        return self.difference_time is None and self.topics > 0


def read_digests(path: Path) -> Digests:
    """Read a digest file, without a last line truncated by a crash.

    Raises:
        DigestError: the file does not exist or is not a digest file.
    """
    rows: list[tuple[int, str, dict[str, list[int]]]] = []
    try:
        with path.open(encoding="utf-8") as file:
            for line in file:
                if line.endswith("\n"):
                    row = json.loads(line)
                    rows.append((row["time"], row["name"], row["topics"]))
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise DigestError(f"digest file {str(path)!r} cannot be read: {error}") from error
    publishers = defaultdict(set)
    for _, name, topics in rows:
        for topic in topics:
            publishers[topic].add(name)
    lines: dict[int, dict[Key, State]] = defaultdict(dict)
    for time, name, topics in rows:
        for topic, state in topics.items():
            key = (topic, name if len(publishers[topic]) > 1 else "")
            lines[time][key] = (state[0], state[1], state[2])
    return Digests(lines, path.name)


def compare(first: Digests, second: Digests, until_us: int) -> Comparison:
    """Compare two flights up to a simulated time.

    Args:
        first: one flight.
        second: the other.
        until_us: end of the comparison, simulated us.

    Returns:
        The comparison; a topic of only one flight is a difference.
    """
    seen: dict[Key, State] = {}
    end = 0
    for time in sorted(first.lines.keys() | second.lines.keys()):
        if time > until_us:
            break
        ours, theirs = first.lines.get(time, {}), second.lines.get(time, {})
        differing = {key[0] for key in ours.keys() | theirs.keys() if ours.get(key) != theirs.get(key)}
        if differing:
            return _comparison(time, seen, time, differing)
        seen.update(ours)
        end = time
    return _comparison(end, seen, None, set())


def _comparison(time: int, seen: Mapping[Key, State], difference: int | None, differing: set[str]) -> Comparison:
    return Comparison(
        time=time * 1e-6,
        topics=len(seen),
        messages=sum(state[0] for state in seen.values()),
        bytes=sum(state[1] for state in seen.values()),
        difference_time=None if difference is None else difference * 1e-6,
        differing=tuple(sorted(differing)),
    )
