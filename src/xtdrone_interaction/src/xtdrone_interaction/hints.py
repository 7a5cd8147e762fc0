"""What to do about the usual causes that keep a simulation from starting, as the logs show them. No ROS is needed."""

from __future__ import annotations

import re

_HINTS = (
    (r"UDP port (?P<port>\d+) cannot be bound|TCP port (?P<tcp>\d+) of PX4's simulator link cannot be bound",
     "another program has the port: end it, or run beside it with --instance N"),
    (r"Too many open files", "the limit of open files is too low for the fleet: ulimit -n 4096"),
    (r"MemoryError|Cannot allocate memory|can't start new thread|failed to map segment|Unable to allocate",
     "memory is short: end other programs, raise the limit (ulimit -v unlimited), or fly with fewer processes "
     "(processes:=shared; --processes shared)"),
    (r"No space left on device", "the disk is full: free some of it, or write elsewhere with --out"),
    (r"a simulator is running on the ROS master|the node name \S+ is taken on the ROS master",
     "leave out --use-master: the launch has a master of its own then"),
    (r"(?i)cannot launch node of type|cannot locate node of type",
     "a node's program is missing: build (./xtdrone setup), and source the workspace that has it"),
    (r"participants have not joined|of \d+ participants have joined",
     "a participant has not joined: look into its log for why; nodes that are started by hand join when they come"),
    (r"holding time at 0: .*PX4", "start the PX4s, docs/px4-sitl.md"),
)  # fmt: skip
_KNOWN = [(re.compile(pattern), advice) for pattern, advice in _HINTS]


def advice(text: str) -> list[str]:
    """Return what to do about the causes that ``text``, a log, shows; a line each, none for what is not known."""
    return [words for pattern, words in _KNOWN if pattern.search(text)]
