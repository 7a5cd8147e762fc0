"""Compares flights by their digest files (see ``xtdrone_sim.runtime.digests``). No ROS here.

A digest file says, for each second of simulated time, how many messages a node had published on each of its topics, how
many bytes these were, and their checksum; and the checksum of all vehicles' true states at every tick. The comparison
is by topic, so that a flight with one process for all followers can be compared with one that has a process for each.
"""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

TRUTH = "truth"  # as xtdrone_sim.runtime.digests names it
State = tuple[int, int, int]
"""Messages, bytes, checksum."""
Key = tuple[str, str]
"""Topic and publisher; the publisher is left empty where the topic has only one."""


class DigestError(ValueError):
    """A file that is no digest file."""


@dataclass(frozen=True)
class Digests:
    """What a digest file holds.

    Attributes:
        lines: simulated time in microseconds to the states at that time.
        name: of the file, for messages.
    """

    lines: Mapping[int, Mapping[Key, State]]
    name: str

    @property
    def end(self) -> int:
        """The last time, in microseconds; 0 without any."""
        return max(self.lines, default=0)

    def truth(self) -> Digests:
        """Return the part of it that tells of the vehicles' true states alone."""
        return Digests(
            {t: {k: s for k, s in keys.items() if k[0] == TRUTH} for t, keys in self.lines.items()}, self.name
        )


@dataclass(frozen=True)
class Comparison:
    """How two flights compare.

    Attributes:
        time: up to which they were compared, simulated s.
        topics: how many were compared.
        messages: how many were published on them in the first flight.
        bytes: how many bytes these had.
        difference_time: of the first difference, simulated s; None if there is none.
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
        """Whether there is no difference, and something was compared."""
        return self.difference_time is None and self.topics > 0


def read_digests(path: Path) -> Digests:
    """Read a digest file; a last line that was cut short by a crash is left out.

    Raises:
        DigestError: it is not there or no digest file.
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
        until_us: microseconds; what is later does not count.

    Returns:
        The comparison; a topic that only one flight has counts as a difference.
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
