"""What a launch's log shows of trouble, and what to do about its usual causes. No ROS is needed."""

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


# rospy, roscpp: "[ERROR] [wall s, s]: ..."; roslaunch: "ERROR: cannot launch node ...", "[follower_2-12] process has
# died [...]"; C++: "terminate called after throwing ..." and, indented, "what():  ..."
_TROUBLE = re.compile(
    r"^\[ ?(ERROR|FATAL)\]|^(ERROR|FATAL)\b|\bhas died\b|^[\w.]*(Error|Exception): |cannot launch|^Invalid <"
    r"|^terminate called|^  what\(\):"
)
_REQUIRED = re.compile(r"REQUIRED process \[.*\] has died!")
_DONE = "process has finished cleanly"  # roslaunch's next line, where the required node has done its work
_ENDING = re.compile(r"^Initiating shutdown!|^\[[^\]]+\] killing on exit")
_TRACEBACK = "Traceback (most recent call last)"
_IGNORED = "Exception ignored in"  # Python's word for what fails while it cleans up; a traceback follows


def trouble(lines: Iterable[str]) -> list[str]:
    """Return the lines of roslaunch's log that tell of trouble, each once, in their order.

    Of a traceback that is the last line; the end of a required node that has done its work is none, and what nodes say
    while roslaunch ends them all is a consequence.

    Args:
        lines: without colours.
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
        elif inside and line[:1] not in (" ", "[", ""):  # its last line; those in brackets are another node's
            if not ignored:
                found[line.strip()] = None
            inside = ignored = False
        elif not required and _TROUBLE.search(line):
            found[line.strip("= ")] = None
    return list(found)
