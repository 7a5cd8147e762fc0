"""A demo's flight: runs a launch file to its end with its own master, shows its progress, leaves nothing behind."""

from __future__ import annotations

import contextlib
import json
import os
import queue
import re
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import urlparse

from rich.console import Console

from xtdrone_interaction.deaths import Deaths
from xtdrone_interaction.display import Display, LineDisplay, LiveDisplay
from xtdrone_interaction.options import OptionError, check_master_port, free_port, repository
from xtdrone_interaction.processes import ProcessTree
from xtdrone_interaction.record import read_events
from xtdrone_interaction.sim_cli import MASTER_FILE, announce

_POLL = 0.2  # s, how often the processes are looked after
_SILENCE_LIMIT = 60.0  # s between two messages of progress
_PATIENCE = 25.0  # s that roslaunch gets to stop its nodes
_NODE_PATIENCE = 8.0  # s that a node gets to stop
_TROUBLE = re.compile(r"\b(ERROR|FATAL)\b|(Error|Exception)\b|has died|cannot launch|RLException|Invalid <")
_COLOURS = re.compile(r"\x1b\[[0-9;]*m")
_TROUBLE_LINES = 12
_NAMES_SHOWN = 3


class DemoError(RuntimeError):
    """The flight did not start, or not end as it should."""


class Interrupted(BaseException):
    """SIGINT, SIGTERM or SIGHUP came.

    Attributes:
        number: the signal.
    """

    def __init__(self, number: int) -> None:
        """Keep the signal's number."""
        super().__init__(signal.Signals(number).name)
        self.number = number


@dataclass(frozen=True)
class Flight:
    """A launch file whose director tells how it goes, and ends it.

    Attributes:
        file: in launch/.
        arguments: of the launch file.
        out: folder of the results; the director writes its events into ``out / "events.jsonl"``.
        bag: record in ``out``, made readable if its recorder was killed.
        master_port: TCP port of the flight's own ROS master; 0: the one of ROS_MASTER_URI, which runs already.
        headless: plain lines instead of the live display.
        start_limit: wall s until the first message of the director.
        progress_topic, events_topic: the director's, std_msgs/String with JSON.
        last_events: with which of them the flight ends.
        show_event: shows an event that a user wants to read.
    """

    file: str
    arguments: Mapping[str, object]
    out: Path
    bag: str
    master_port: int
    headless: bool
    start_limit: float
    progress_topic: str
    events_topic: str
    last_events: tuple[str, ...]
    show_event: Callable[[dict[str, Any], Display], None]

    @property
    def master_uri(self) -> str:
        """The ROS master's address."""
        return f"http://127.0.0.1:{self.master_port}" if self.master_port else os.environ["ROS_MASTER_URI"]

    @property
    def log(self) -> Path:
        """What roslaunch writes."""
        return self.out / "logs" / "roslaunch.log"

    def command(self) -> list[str]:
        """Return the command that runs it.

        Raises:
            DemoError: there is no roslaunch.
        """
        program = shutil.which("roslaunch")
        if program is None:
            raise DemoError("roslaunch: not found; source the workspace's devel/setup.bash first")
        port = ["-p", str(self.master_port)] if self.master_port else ["--wait"]
        return [
            program, "--sigint-timeout", str(_NODE_PATIENCE), *port,
            str(repository() / "launch" / self.file),
            *(f"{name}:={value}" for name, value in self.arguments.items()),
        ]  # fmt: skip

    def environment(self) -> dict[str, str]:
        """Return the environment of its processes."""
        environment = dict(os.environ)
        environment["ROS_MASTER_URI"] = self.master_uri
        environment["ROS_LOG_DIR"] = str(self.out / "logs")
        # nodes start by /usr/bin/env python3 where the workspace was not built: it must be this Python
        environment["PATH"] = f"{Path(sys.executable).parent}{os.pathsep}{environment.get('PATH', '')}"
        if self.master_port and not {"ROS_IP", "ROS_HOSTNAME"} & environment.keys():
            environment["ROS_IP"] = "127.0.0.1"
        return environment

    def events(self) -> list[dict[str, Any]]:
        """Return the director's events so far."""
        return read_events(self.out / "events.jsonl")


@dataclass
class _Feed:
    """Messages of the director, put here by rospy's threads."""

    messages: queue.SimpleQueue[tuple[str, dict[str, Any]]] = field(default_factory=queue.SimpleQueue)

    def callback(self, kind: str) -> Callable[[Any], None]:
        return lambda message: self.messages.put((kind, json.loads(message.data)))

    def on_status(self, status: Any) -> None:
        self.messages.put(("status", {"text": standstill(status), "held": bool(status.paused or status.waiting_for)}))


def standstill(status: Any) -> str:
    """Return why the world stands still, in a few words; empty while it moves.

    Args:
        status: an xtdrone_msgs/SimulationStatus.
    """
    if status.waiting_for:
        names = ", ".join(sorted(status.waiting_for)[:_NAMES_SHOWN])
        rest = len(status.waiting_for) - _NAMES_SHOWN
        more = f" and {rest} more" if rest > 0 else ""
        return f"waiting for {names}{more} ({status.waiting.to_sec():.0f} s)"
    if status.stepping:
        return ""
    return "paused" if status.paused else str(status.reason)


def run_flight(flight: Flight, console: Console, conclude: Callable[[Deaths], int]) -> int:
    """Fly to the end, then conclude.

    Args:
        flight: what is flown.
        console: for progress and errors.
        conclude: makes report and pictures of the finished flight, given the nodes that ended in it, and returns the
            exit status; it may raise DemoError.

    Returns:
        The exit status: what ``conclude`` returned, 1 for a flight that failed, 128 + signal when stopped.
    """
    flight.log.parent.mkdir(parents=True)
    console.print(f"Results: {flight.out}", highlight=False, soft_wrap=True)
    console.print(_how_to_control(flight), highlight=False, soft_wrap=True)
    deaths = Deaths(flight.log)
    with signals_raise():
        try:
            _fly(flight, console, deaths)
            return conclude(deaths)
        except DemoError as error:
            console.print(f"[red]Error:[/red] {escape(str(error))}", highlight=False, soft_wrap=True)
            for death in deaths.found.values():
                console.print(f"  {escape(str(death))}", highlight=False, soft_wrap=True)
            _print_trouble(flight, console)
            return 1
        except Interrupted as signalled:
            console.print(f"stopped by {signalled}; nothing is left running", highlight=False)
            return 128 + signalled.number


def _how_to_control(flight: Flight) -> str:
    uri = flight.master_uri
    return (
        f"ROS master {uri}; './xtdrone sim pause --master {flight.master_port or uri}' (step, speed, ...) controls it"
    )


def _fly(flight: Flight, console: Console, deaths: Deaths) -> None:
    """Run the launch file to its end.

    Raises:
        DemoError: the flight failed.
    """
    environment = flight.environment()
    os.environ.update({k: environment[k] for k in environment if k.startswith("ROS_")})  # for our own rospy
    master = flight.out / MASTER_FILE
    master.write_text(flight.master_uri + "\n", encoding="utf-8")
    pointer = announce(flight.out)
    tree = ProcessTree(flight.command(), environment, flight.log)
    plain = flight.headless or not console.is_terminal
    display: Display = LineDisplay(console) if plain else LiveDisplay(console)
    try:
        _watch(tree, flight, display, deaths)
    finally:
        with signals_wait():
            display.close()
            _close_feed()
            tree.stop(_PATIENCE)
            master.unlink(missing_ok=True)
            if pointer is not None:
                pointer.unlink(missing_ok=True)
            _mend_bag(flight.out / flight.bag, environment)


def master_port(wanted: int | None, *, use_running: bool) -> int:
    """Return the TCP port of the flight's own ROS master, 0 where the one of ROS_MASTER_URI is used.

    Raises:
        OptionError: the port is taken, or no master answers.
    """
    if use_running:
        if "ROS_MASTER_URI" not in os.environ:
            raise OptionError("master: --use-master needs ROS_MASTER_URI, which is not set")
        check_master(os.environ["ROS_MASTER_URI"])
        return 0
    return check_master_port(wanted) if wanted else free_port()


def check_master(uri: str) -> None:
    """Check that somebody listens at a master's URI.

    Raises:
        OptionError: nobody does.
    """
    if not _listens(uri):
        raise OptionError(f"master: none answers at ROS_MASTER_URI {uri!r}; start roscore, or leave out --use-master")


def _listens(uri: str) -> bool:
    parts = urlparse(uri)
    try:
        socket.create_connection((parts.hostname or "localhost", parts.port or 11311), timeout=1.0).close()
    except OSError:
        return False
    return True


def _watch(tree: ProcessTree, flight: Flight, display: Display, deaths: Deaths) -> None:
    """Show the flight's progress until roslaunch has ended.

    Raises:
        DemoError: it ended before the flight did, a node died at the start, or the director fell silent.
    """
    limit = flight.start_limit
    last, begun, outcome = time.monotonic(), False, ""
    sim_time: float | None = None
    feed = _Feed()
    connected = False
    while not tree.wait(0.0):
        if not connected and _listens(flight.master_uri):
            _open_feed(feed, flight)
            connected = True
        _show_deaths(deaths, sim_time, display)
        with contextlib.suppress(queue.Empty):
            kind, message = feed.messages.get(timeout=_POLL)
            if kind == "status":
                display.standstill(message["text"])
                if message["held"]:  # a pause, or a node at a breakpoint: however long, nothing is wrong
                    last = time.monotonic()
                continue
            last = time.monotonic()
            begun, limit = True, _SILENCE_LIMIT
            if kind == "progress":
                sim_time = message["sim_time"]
                display.update(message)
            else:
                flight.show_event(message, display)
                outcome = message["event"]
            if outcome in flight.last_events:
                break
        if not begun and _died(flight):
            raise DemoError("a node died before the flight began")
        if time.monotonic() - last > limit:
            what = "no message from the director" if begun else "the flight did not begin"
            raise DemoError(f"{what} within {limit:.0f} s of wall time")
    _show_deaths(deaths, sim_time, display)
    if outcome in flight.last_events:
        with signals_wait():
            _close_feed()
            tree.wait(_PATIENCE)
    events = flight.events()
    if not events or events[-1]["event"] not in flight.last_events:
        raise DemoError("the flight ended early")


def _show_deaths(deaths: Deaths, sim_time: float | None, display: Display) -> None:
    for death in deaths.look(sim_time):
        display.note(f"  [red]{escape(str(death))}[/red]")


def _open_feed(feed: _Feed, flight: Flight) -> None:
    """Subscribe to the director's messages."""
    import rospy
    from std_msgs.msg import String
    from xtdrone_msgs.msg import SimulationStatus

    rospy.init_node("demo_display", anonymous=True, disable_signals=True)
    rospy.Subscriber(flight.progress_topic, String, feed.callback("progress"))
    rospy.Subscriber(flight.events_topic, String, feed.callback("event"))
    rospy.Subscriber("/simulator/status", SimulationStatus, feed.on_status)


def _close_feed() -> None:
    """Leave the master before it goes."""
    rospy = sys.modules.get("rospy")
    if rospy is not None and not rospy.is_shutdown():
        rospy.signal_shutdown("the flight has ended")


def _log_lines(flight: Flight) -> list[str]:
    if not flight.log.is_file():
        return []
    return _COLOURS.sub("", flight.log.read_text(encoding="utf-8", errors="replace")).splitlines()


def _died(flight: Flight) -> bool:
    return any("has died" in line for line in _log_lines(flight))


def _print_trouble(flight: Flight, console: Console) -> None:
    """Print what the launch's log says of the cause."""
    lines = [line for line in _log_lines(flight) if _TROUBLE.search(line)]
    for line in lines[:_TROUBLE_LINES]:
        console.print(f"  {escape(line.strip())}", highlight=False, soft_wrap=True)
    console.print(f"All of it: {flight.log.parent}", highlight=False, soft_wrap=True)


def escape(text: str) -> str:
    """Return ``text`` so that rich prints it as it is."""
    return text.replace("[", r"\[")


def _mend_bag(bag: Path, environment: dict[str, str]) -> None:
    """Make a bag readable whose recorder was killed."""
    active = bag.with_suffix(".bag.active")
    program = shutil.which("rosbag")
    if not active.is_file() or program is None:
        return
    command = [program, "reindex", "-q", str(active)]
    subprocess.run(command, env=environment, check=False, capture_output=True, timeout=300)
    active.replace(bag)
    active.with_suffix(".orig.active").unlink(missing_ok=True)


@contextlib.contextmanager
def signals_raise() -> Iterator[None]:
    """Raise :class:`Interrupted` in the main thread at SIGINT, SIGTERM and SIGHUP."""

    def handler(number: int, _: Any) -> None:
        raise Interrupted(number)

    with _handlers(handler):
        yield


@contextlib.contextmanager
def signals_wait() -> Iterator[None]:
    """Let signals wait until the block has ended: cleaning up must not be cut short."""
    pending: list[int] = []
    with _handlers(lambda number, _: pending.append(number)):
        yield
    if pending and not isinstance(sys.exc_info()[1], Interrupted):
        raise Interrupted(pending[0])


@contextlib.contextmanager
def _handlers(handler: Any) -> Iterator[None]:
    numbers = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    old = {number: signal.signal(number, handler) for number in numbers}
    try:
        yield
    finally:
        for number, previous in old.items():
            signal.signal(number, previous)
