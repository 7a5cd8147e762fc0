"""Errors in the log of a launch, and remedies for the usual causes. ROS is not needed."""

from __future__ import annotations

import re
from collections.abc import Iterable

_HINTS = (
    (r"UDP port (?P<port>\d+) cannot be bound|TCP port (?P<tcp>\d+) of PX4's simulator link cannot be bound",
     "another program has the port: end it, or run beside it with --instance N"),
    (r"Too many open files", "the limit of open files is too low for the fleet: ulimit -n 4096"),
    (r"MemoryError|Cannot allocate memory|can't start new thread|failed to map segment|Unable to allocate",
     "memory is short: end other programs, raise the limit (ulimit -v unlimited), or fly with fewer processes "
     "(processes:=shared; --processes shared)"),
    (r"[Nn]o ROS master (answers )?at ",
     "the ROS master has ended, or lacks memory or threads (ulimit -v unlimited, ulimit -u unlimited)"),
    (r"No space left on device", "the disk is full: free some of it, or write elsewhere with --out"),
    (r"a simulator is running on the ROS master|the node name \S+ is taken on the ROS master",
     "leave out --use-master: the launch then has its own master"),
    (r"(?i)cannot launch node of type|cannot locate node of type",
     "a node's program is missing: build (./xtdrone setup), and source the workspace that has it"),
    (r"participants have not joined|of \d+ participants have joined",
     "a participant has not joined: see its log for the reason; nodes that are started manually join when they come"),
    (r"holding time at 0: .*PX4", "start the PX4s, docs/px4-sitl.md"),
)  # fmt: skip
_KNOWN = [(re.compile(pattern), advice) for pattern, advice in _HINTS]


def advice(text: str) -> list[str]:
    """Return a line of advice for each known cause of failure in ``text``, a log."""
    return [words for pattern, words in _KNOWN if pattern.search(text)]


# rospy, roscpp: "[ERROR] [wall s, s]: ..."; roslaunch: "ERROR: cannot launch node ...", "[follower_2-12] process has
# died [...]"; C++: "terminate called after throwing ..." and, indented, "what():  ..."
_ERROR = re.compile(
    r"^\[ ?(ERROR|FATAL)\]|^(ERROR|FATAL)\b|\bhas died\b|^[\w.]*(Error|Exception): |cannot launch|^Invalid <"
    r"|^terminate called|^  what\(\):"
)
_REQUIRED = re.compile(r"REQUIRED process \[.*\] has died!")
_DONE = "process has finished cleanly"  # roslaunch's next line, if the required node has finished
_ENDING = re.compile(r"^Initiating shutdown!|^\[[^\]]+\] killing on exit")
_TRACEBACK = "Traceback (most recent call last)"
_IGNORED = "Exception ignored in"  # precedes the traceback of an error in Python's clean-up


def error_lines(lines: Iterable[str]) -> list[str]:
    """Return the distinct error lines of roslaunch's log in order.

    A traceback is represented by its last line. The end of a required node that has finished is not an error; errors
    logged while roslaunch stops all nodes are consequences and are ignored.

    Args:
        lines: without colour codes.
    """
    found: dict[str, None] = {}
    required, inside, ignored = "", False, False
    for line in lines:
        if _ENDING.search(line):
            break
        if required and line != _DONE:
            found[required] = None
        required = line.strip("= ") if _REQUIRED.search(line) else ""
        if line.startswith((_TRACEBACK, _IGNORED)):
            inside, ignored = True, ignored or line.startswith(_IGNORED)
        elif inside and line[:1] not in (
            " ",
            "[",
            "",
        ):  # the last line of the traceback; lines in brackets are from other nodes
            if not ignored:
                found[line.strip()] = None
            inside = ignored = False
        elif not required and _ERROR.search(line):
            found[line.strip("= ")] = None
    return list(found)
