"""Nodes that end during a flight, according to the log of roslaunch. ROS is not needed."""

from __future__ import annotations

import re
import signal
import time
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
_DROPPED = "was dropped by the simulator"
_BY_ITSELF = "has ended by itself"
_WINDOW = "visualize"  # the live window, which the user may close at any time
_MAY_END = (_WINDOW, "upload_plans")  # the ground station ends after the upload
# nodes that show a flight and take no part in it
_ONLOOKERS = (_WINDOW, "web_station", "foxglove_bridge", "rosbridge_websocket", "ros2_bridge", "rviz")
_ALL_END = re.compile(r"^\[[^\]]+-\d+\] killing on exit|Initiating shutdown|REQUIRED process")
# roslaunch: "====REQUIRED process [simulator-2] has died!", and the reason in the next line
_REQUIRED = re.compile(r"REQUIRED process \[(?P<node>[^\]]+?)(?:-\d+)?\] has died!")
_REQUIRED_HOW = re.compile(r"^process has (?P<how>died|finished cleanly)(?:.*?exit code (?P<code>-?\d+))?")
SIMULATOR = "simulator"
MASTER = "master"
_GAVE_UP = (_DIED, f"{_DIED} (exit code 1)", _BY_ITSELF)  # ends of a participant whose simulator fails
_TOGETHER = 2.0  # s of wall time; a participant that ends at most so long before the simulator ended because of it


@dataclass(frozen=True)
class EndedNode:
    """A node that has ended during the flight.

    Attributes:
        node: name without the leading slash.
        time: simulated time of detection, s; None before time has started.
        how: description of the end.
        log: file with the cause.
    """

    node: str
    time: float | None
    how: str
    log: str

    @property
    def matters(self) -> bool:
        """Whether the flight is degraded without the node."""
        return self.node not in _ONLOOKERS

    @property
    def died(self) -> bool:
        """Whether it died rather than finished."""
        return self.how.startswith(_DIED)

    @property
    def dropped(self) -> bool:
        """Whether the simulator dropped it from the lockstep; its process may still be running."""
        return self.how.startswith(_DROPPED)

    def __str__(self) -> str:
        """Return the sentence for the terminal and the report."""
        when = "" if self.time is None else f" at {self.time:.1f} s"
        return f"{self.node} {self.how}{when}, see {self.log}"


class EndedNodes:
    """The nodes that have ended, each once.

    Attributes:
        found: by name in the order in which they ended, without those in ``consequences``.
        required: the required node whose end ended the launch; None before that.
        consequences: nodes that ended because the simulator did.
    """

    def __init__(self, log: Path) -> None:
        """Prepare to read roslaunch's ``log`` from its beginning."""
        self._log = log
        self._read = 0
        self._closed = False
        self._ending = ""  # the required node whose reason is in the next line
        self._wall: dict[str, float] = {}  # when each was found, s
        self.found: dict[str, EndedNode] = {}
        self.required: EndedNode | None = None
        self.consequences: list[str] = []

    @property
    def failure(self) -> EndedNode | None:
        """The required node, if it died rather than finished."""
        return None if self.required is None or self.required.how == _BY_ITSELF else self.required

    def all(self) -> list[EndedNode]:
        """Return all nodes that ended: the required one first, then the others in their order."""
        first = [] if self.failure is None else [self.failure]
        return [*first, *self.found.values()]

    def update(self, sim_time: float | None) -> list[EndedNode]:
        """Read the new lines of the log and return the nodes that have ended since the last call.

        Args:
            sim_time: current simulated time, s.
        """
        new = []
        for line in self._lines():
            self._look_for_required(line, sim_time)
            self._closed = self._closed or _ALL_END.search(line) is not None
            ended = None if self._closed else self._ended_node(line, sim_time)
            if ended is None or (ended.node in _MAY_END and ended.how == _BY_ITSELF):
                continue
            if ended.node not in self.found:
                new.append(ended.node)
                self.found[ended.node] = ended
                self._wall[ended.node] = time.monotonic()
            elif self.found[ended.node].how == _DIED:  # roslaunch gives more detail than the simulator
                self.found[ended.node] = replace(self.found[ended.node], how=ended.how, log=ended.log)
        return [self.found[node] for node in new if node in self.found]

    def _look_for_required(self, line: str, sim_time: float | None) -> None:
        """Store the required node that ends the launch, and the nodes that ended because of it."""
        required = _REQUIRED.search(line)
        if required:
            self._ending = required["node"]
            return
        how = _REQUIRED_HOW.search(line) if self._ending else None
        if how is None:
            return
        node, self._ending = self._ending, ""
        self.required = EndedNode(node, sim_time, _how(how["how"], how["code"]), self._where(node))
        self.found.pop(node, None)
        if node in (SIMULATOR, MASTER) and self.failure is not None:
            begin = time.monotonic() - _TOGETHER
            late = [ended for name, ended in self.found.items() if self._wall[name] >= begin]
            self.consequences = [ended.node for ended in late if ended.how in _GAVE_UP]
            for name in self.consequences:
                del self.found[name]

    def _lines(self) -> list[str]:
        """Return the complete new lines."""
        try:
            with self._log.open("rb") as file:
                file.seek(self._read)
                data = file.read()
        except FileNotFoundError:
            return []
        whole = data[: data.rfind(b"\n") + 1]
        self._read += len(whole)
        return _COLOURS.sub("", whole.decode("utf-8", errors="replace")).splitlines()

    def _ended_node(self, line: str, sim_time: float | None) -> EndedNode | None:
        ended = _ENDED.search(line)
        if ended:
            node = ended["node"]
            return EndedNode(node, sim_time, _how(ended["how"], ended["code"]), self._where(node))
        lost = _LOST.search(line)
        if lost:
            node = lost["node"]
            when = float(lost["time"]) if lost["time"] else sim_time
            return EndedNode(node, when, _lost(lost["crash"], lost["why"]), self._where(node))
        return None

    def _where(self, node: str) -> str:
        """Return the file with the cause: the node's log if it has a traceback, else the log with all errors."""
        for path in sorted(self._log.parent.glob(f"*/{node.replace('/', '-')}-[0-9]*.log")):
            if b"Traceback" in path.read_bytes():
                return str(path)
        return str(self._log)


def _lost(crash: str | None, why: str | None) -> str:
    if crash is not None:
        return f"{_DIED} ({_CRASHED.sub('', crash)})"
    # A living process keeps its connection.
    return _DIED if str(why).startswith(("is gone", "it has closed")) else f"{_DROPPED} ({why})"


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
