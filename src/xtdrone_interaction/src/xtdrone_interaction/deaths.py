"""Nodes that end while a flight goes on, as roslaunch's log tells of them. No ROS is needed."""

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
_ONLOOKER = "visualize"  # the live window, which may be closed at any time
_MAY_END = (_ONLOOKER, "upload_plans")  # a ground station that has done its work
_ALL_END = re.compile(r"^\[[^\]]+-\d+\] killing on exit|Initiating shutdown|REQUIRED process")
# roslaunch: "====REQUIRED process [simulator-2] has died!", and in the next line how
_REQUIRED = re.compile(r"REQUIRED process \[(?P<node>[^\]]+?)(?:-\d+)?\] has died!")
_REQUIRED_HOW = re.compile(r"^process has (?P<how>died|finished cleanly)(?:.*?exit code (?P<code>-?\d+))?")
SIMULATOR = "simulator"
MASTER = "master"
_GAVE_UP = (_DIED, f"{_DIED} (exit code 1)", _BY_ITSELF)  # what becomes of a participant whose simulator fails
_TOGETHER = 2.0  # wall s before the simulator's end in which a participant's is taken for its consequence


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

    @property
    def died(self) -> bool:
        """Whether it has not ended by itself."""
        return self.how.startswith(_DIED)

    @property
    def dropped(self) -> bool:
        """Whether the simulator no longer waits for it, though it may run."""
        return self.how.startswith(_DROPPED)

    def __str__(self) -> str:
        """Return it in a sentence."""
        when = "" if self.time is None else f" at {self.time:.1f} s"
        return f"{self.node} {self.how}{when}, see {self.log}"


class Deaths:
    """The nodes that have ended, each once.

    Attributes:
        found: in the order in which they ended, those left out that ended with the simulator.
        required: the required node with which the launch ended; None while it goes on.
        consequences: nodes that ended because the simulator did.
    """

    def __init__(self, log: Path) -> None:
        """Have read nothing yet of roslaunch's ``log``."""
        self._log = log
        self._read = 0
        self._closed = False
        self._ending = ""  # the required node of which the next line says how it ended
        self._wall: dict[str, float] = {}  # when each was found, s
        self.found: dict[str, Death] = {}
        self.required: Death | None = None
        self.consequences: list[str] = []

    @property
    def failure(self) -> Death | None:
        """The required node that died, as against one that has done its work."""
        return None if self.required is None or self.required.how == _BY_ITSELF else self.required

    def all(self) -> list[Death]:
        """Return all that ended: first the required node that took the others with it, then in their order."""
        first = [] if self.failure is None else [self.failure]
        return [*first, *self.found.values()]

    def look(self, sim_time: float | None) -> list[Death]:
        """Read what the log has got since the last look and return the nodes that are new.

        Args:
            sim_time: s, of now.
        """
        new = []
        for line in self._lines():
            self._look_for_required(line, sim_time)
            self._closed = self._closed or _ALL_END.search(line) is not None
            death = None if self._closed else self._death(line, sim_time)
            if death is None or (death.node in _MAY_END and death.how == _BY_ITSELF):
                continue
            if death.node not in self.found:
                new.append(death.node)
                self.found[death.node] = death
                self._wall[death.node] = time.monotonic()
            elif self.found[death.node].how == _DIED:  # roslaunch knows more of the end than the simulator does
                self.found[death.node] = replace(self.found[death.node], how=death.how, log=death.log)
        return [self.found[node] for node in new if node in self.found]

    def _look_for_required(self, line: str, sim_time: float | None) -> None:
        """Note the required node that ends the launch, and what ended with it."""
        required = _REQUIRED.search(line)
        if required:
            self._ending = required["node"]
            return
        how = _REQUIRED_HOW.search(line) if self._ending else None
        if how is None:
            return
        node, self._ending = self._ending, ""
        self.required = Death(node, sim_time, _how(how["how"], how["code"]), self._where(node))
        self.found.pop(node, None)
        if node in (SIMULATOR, MASTER) and self.failure is not None:
            begin = time.monotonic() - _TOGETHER
            late = [death for name, death in self.found.items() if self._wall[name] >= begin]
            self.consequences = [death.node for death in late if death.how in _GAVE_UP]
            for name in self.consequences:
                del self.found[name]

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
            when = float(lost["time"]) if lost["time"] else sim_time
            return Death(node, when, _lost(lost["crash"], lost["why"]), self._where(node))
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
