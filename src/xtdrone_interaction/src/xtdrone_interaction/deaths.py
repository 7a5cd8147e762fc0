"""Nodes that end while a flight goes on, as roslaunch's log tells of them. No ROS is needed."""

from __future__ import annotations

import re
import signal
from dataclasses import dataclass, replace
from pathlib import Path

_COLOURS = re.compile(r"\x1b\[[0-9;]*m|\x1b\][^\x07]*\x07")
# roslaunch: "[follower_2-12] process has died [pid 7, exit code -9, cmd ...]." or "... has finished cleanly"
_ENDED = re.compile(
    r"^\[(?P<node>[^\]]+)-\d+\] process has (?P<how>died|finished cleanly)(?:.*?exit code (?P<code>-?\d+))?"
)
# the simulator: "[WARN] [wall s]: simulator: participant /follower_2 is gone: ...; dropped, ...", or "... leaves: why"
_LOST = re.compile(
    r"^\[WARN\] \[[\d.]+(?:, (?P<time>[\d.]+))?\]: (?:simulator: )?participant /(?P<node>[\w/]+) "
    r"(?:leaves: (?P<crash>.*)|(?P<why>.*); dropped)"
)
_CRASHED = re.compile(r"^it (?:has )?crashed: ")
_DIED = "has died"
_BY_ITSELF = "has ended by itself"
_ONLOOKER = "visualize"  # the live window, which may be closed at any time
_MAY_END = (_ONLOOKER, "upload_plans")  # a ground station that has done its work
_ALL_END = re.compile(r"^\[[^\]]+-\d+\] killing on exit|Initiating shutdown|REQUIRED process")


@dataclass(frozen=True)
class Death:
    """A node that has ended while the flight went on.

    Attributes:
        node: its name without the leading slash.
        time: simulated s when that was noticed; None before time has started.
        how: what became of it, in words.
        log: where to look for the cause.
    """

    node: str
    time: float | None
    how: str
    log: str

    @property
    def matters(self) -> bool:
        """Whether the flight is not what it should be without the node."""
        return self.node != _ONLOOKER

    def __str__(self) -> str:
        """Return it in a sentence."""
        when = "" if self.time is None else f" at {self.time:.1f} s"
        return f"{self.node} {self.how}{when}, see {self.log}"


class Deaths:
    """The nodes that have ended, each once.

    Attributes:
        found: in the order in which they ended.
    """

    def __init__(self, log: Path) -> None:
        """Have read nothing yet of roslaunch's ``log``."""
        self._log = log
        self._read = 0
        self._closed = False
        self.found: dict[str, Death] = {}

    def look(self, sim_time: float | None) -> list[Death]:
        """Read what the log has got since the last look and return the nodes that are new.

        Args:
            sim_time: s, of now.
        """
        new = []
        for line in self._lines():
            self._closed = self._closed or _ALL_END.search(line) is not None
            death = None if self._closed else self._death(line, sim_time)
            if death is None or (death.node in _MAY_END and death.how == _BY_ITSELF):
                continue
            if death.node not in self.found:
                new.append(death.node)
                self.found[death.node] = death
            elif self.found[death.node].how == _DIED:  # roslaunch knows more of the end than the simulator does
                self.found[death.node] = replace(self.found[death.node], how=death.how, log=death.log)
        return [self.found[node] for node in new]

    def _lines(self) -> list[str]:
        """Return the whole lines that are new."""
        try:
            with self._log.open("rb") as file:
                file.seek(self._read)
                data = file.read()
        except FileNotFoundError:
            return []
        whole = data[: data.rfind(b"\n") + 1]
        self._read += len(whole)
        return _COLOURS.sub("", whole.decode("utf-8", errors="replace")).splitlines()

    def _death(self, line: str, sim_time: float | None) -> Death | None:
        ended = _ENDED.search(line)
        if ended:
            node = ended["node"]
            return Death(node, sim_time, _how(ended["how"], ended["code"]), self._where(node))
        lost = _LOST.search(line)
        if lost:
            node = lost["node"]
            time = float(lost["time"]) if lost["time"] else sim_time
            return Death(node, time, _lost(lost["crash"], lost["why"]), self._where(node))
        return None

    def _where(self, node: str) -> str:
        """Return the file with the cause: the node's own where it has a traceback, else that with all nodes' errors."""
        for path in sorted(self._log.parent.glob(f"*/{node.replace('/', '-')}-[0-9]*.log")):
            if b"Traceback" in path.read_bytes():
                return str(path)
        return str(self._log)


def _lost(crash: str | None, why: str | None) -> str:
    if crash is not None:
        return f"{_DIED} ({_CRASHED.sub('', crash)})"
    # A living process keeps its connection.
    return _DIED if str(why).startswith(("is gone", "it has closed")) else f"was dropped by the simulator ({why})"


def _how(how: str, code: str | None) -> str:
    if how == "finished cleanly":
        return _BY_ITSELF
    if code is None:
        return _DIED
    number = int(code)
    if number >= 0:
        return f"{_DIED} (exit code {number})"
    try:
        return f"{_DIED} ({signal.Signals(-number).name})"
    except ValueError:
        return f"{_DIED} (signal {-number})"
