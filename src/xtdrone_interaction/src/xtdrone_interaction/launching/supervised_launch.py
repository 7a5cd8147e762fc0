"""Run a launch file for a command: with its own ROS master, supervised from start to end, and cleaned up completely.

A demo flight is such a launch with a director node that reports its progress.
"""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console

from xtdrone_common.fleet import GCS_REMOTE_PORT, instance_port
from xtdrone_interaction.command_options import OptionError, check_master_port, free_port, repository
from xtdrone_interaction.launching.message_feed import Feed, answers
from xtdrone_interaction.launching.process_tree import ProcessTree, roslaunch_words
from xtdrone_interaction.monitoring.ended_nodes import EndedNode, EndedNodes
from xtdrone_interaction.monitoring.launch_log_errors import advice, error_lines
from xtdrone_interaction.monitoring.missing_nodes import not_joined
from xtdrone_interaction.monitoring.progress_display import Display, LineDisplay, LiveDisplay
from xtdrone_interaction.monitoring.startup_progress import Startup
from xtdrone_interaction.recording.flight_events import read_events
from xtdrone_interaction.simulation_services import MASTER_FILE, announce

_POLL = 0.2  # s between two polls of the processes
_LOGS_PERIOD = 1.0  # s between two reads of the logs
_GRACE = 1.0  # s to delay the report of an ended node: its cause, the end of the simulator, may be logged later
_SILENCE_LIMIT = 60.0  # s between two progress messages
_PATIENCE = 25.0  # s for roslaunch to stop its nodes
_NODE_PATIENCE = 8.0  # s for a node to stop
_OWN_ADDRESS_LIMIT = 3.0  # s for this machine to reach itself
_STOPPED = 5.0  # s between two polls; a longer gap means that this program was suspended
_VITAL = ("simulator", "mavros")  # required for any flight to continue
_RECORDER = "recorder"
_COLOURS = re.compile(r"\x1b\[[0-9;]*m")
_INCOMPLETE = "participants have "  # "joined" or "not joined": the simulator's status while it waits at the start
_ERROR_LINES = 12
_PAGE = "station "  # begins the lines in which web_station.py prints its URLs
_SIGNALLED = 128  # exit status of a process that a signal ended, less the signal's number


class DemoError(RuntimeError):
    """The flight did not start or did not end as expected."""


class Interrupted(BaseException):
    """SIGINT, SIGTERM or SIGHUP was received.

    Attributes:
        number: the signal.
    """

    def __init__(self, number: int) -> None:
        """Store the number of the signal."""
        super().__init__(signal.Signals(number).name)
        self.number = number


@dataclass(frozen=True)
class Launch:
    """A launch file with its arguments.

    Attributes:
        file: path relative to launch/, or absolute.
        arguments: of the launch file.
        out: folder of the results; the logs are in ``out / "logs"``.
        master_port: TCP port of the launch's own ROS master; 0 for the running master of ROS_MASTER_URI.
        headless: print plain lines instead of the live display.
        instance: number of the simulation on this machine.
        needs_all: whether the launch fails if time starts without a participant.
    """

    file: str
    arguments: Mapping[str, object]
    out: Path
    master_port: int
    headless: bool
    instance: int = 0
    needs_all: bool = True

    @property
    def master_uri(self) -> str:
        """The URI of the ROS master."""
        return f"http://127.0.0.1:{self.master_port}" if self.master_port else os.environ["ROS_MASTER_URI"]

    @property
    def log(self) -> Path:
        """The log file of roslaunch."""
        return self.out / "logs" / "roslaunch.log"

    @property
    def control_words(self) -> str:
        """The ROS master, and how to control the simulation."""
        uri = self.master_uri
        return (
            f"ROS master {uri}; './xtdrone sim pause --master {self.master_port or uri}' (step, speed, ...) controls it"
        )

    def command(self) -> list[str]:
        """Return the roslaunch command.

        Raises:
            DemoError: roslaunch is not installed.
        """
        program = shutil.which("roslaunch")
        if program is None:
            raise DemoError("roslaunch: not found; source the workspace's devel/setup.bash first")
        port = ["-p", str(self.master_port)] if self.master_port else ["--wait"]
        return [
            *roslaunch_words(program), "--sigint-timeout", str(_NODE_PATIENCE), *port,
            str(repository() / "launch" / self.file),
            *(f"{name}:={value}" for name, value in self.arguments.items()),
        ]  # fmt: skip

    def environment(self) -> dict[str, str]:
        """Return the environment of the launched processes."""
        environment = dict(os.environ)
        environment["ROS_MASTER_URI"] = self.master_uri
        environment["ROS_LOG_DIR"] = str(self.out / "logs")
        # in an unbuilt workspace nodes start through /usr/bin/env python3, which must be this Python
        environment["PATH"] = f"{Path(sys.executable).parent}{os.pathsep}{environment.get('PATH', '')}"
        if self.master_port and not {"ROS_IP", "ROS_HOSTNAME"} & environment.keys():
            environment["ROS_IP"] = "127.0.0.1"
        if not _is_writable(Path(environment.get("ROS_HOME") or os.path.expanduser("~/.ros"))):
            environment["ROS_HOME"] = str(self.out / "logs")  # the working directory of nodes, required by roslaunch
        return environment


def _is_writable(folder: Path) -> bool:
    """Return whether ``folder``, or the nearest existing folder above it, is writable."""
    there = next(place for place in (folder, *folder.parents) if place.exists())
    return there.is_dir() and os.access(there, os.W_OK | os.X_OK)


@dataclass(frozen=True, kw_only=True)
class Flight(Launch):
    """A launch whose director node reports the progress of the flight and ends it.

    Attributes:
        bag: file name in ``out``; the bag is reindexed if its recorder was killed. The director writes its events to
            ``out / "events.jsonl"``.
        start_limit: maximum wall time without progress before the director's first message, s; see ``startup``.
        progress_topic, events_topic: published by the director, std_msgs/String with JSON.
        last_events: names of the events that end the flight.
        show_event: displays an event that is of interest to the user.
        vital: Names of further nodes without which the flight cannot continue.
    """

    bag: str
    start_limit: float
    progress_topic: str
    events_topic: str
    last_events: tuple[str, ...]
    show_event: Callable[[dict[str, Any], Display], None]
    vital: tuple[str, ...] = ()

    def events(self) -> list[dict[str, Any]]:
        """Return the director's events so far."""
        return read_events(self.out / "events.jsonl")


class Watch:
    """Supervises a running launch: its processes, logs and topics.

    Attributes:
        ended_nodes: nodes that have ended.
        startup: progress of the start, read from the logs.
        display: shows progress and messages.
        status: latest status of the simulator, see ``message_feed``; None before the first.
        warnings: of the recorder, see ``message_feed``.
    """

    def __init__(
        self, tree: ProcessTree, launch: Launch, feed: Feed, display: Display, ended_nodes: EndedNodes
    ) -> None:
        """Supervise ``tree``, which runs ``launch``."""
        self.ended_nodes = ended_nodes
        self.display = display
        self.startup = Startup(launch.out / "logs")
        self.status: dict[str, Any] | None = None
        self.warnings: list[str] = []
        self._tree = tree
        self._launch = launch
        self._feed = feed
        self._sim_time: float | None = None
        self._moved = self._logs_read = self._looked = time.monotonic()
        self._shown: set[str] = set()
        self._first_end = 0.0
        self._incomplete_shown = False
        self._page_shown = False

    @property
    def stalled_time(self) -> float:
        """Wall time since the last progress, s."""
        return time.monotonic() - self._moved

    def started(self) -> bool:
        """Return whether roslaunch has started at least one node."""
        self.startup.update()
        return self.startup.started > 0

    def running(self) -> bool:
        """Return whether roslaunch is running."""
        return not self._tree.wait(0.0)

    def poll(self, *, starting: bool) -> list[dict[str, Any]]:
        """Poll topics, logs and processes, and return the new messages; see ``message_feed``.

        Args:
            starting: whether new log lines count as progress.

        Raises:
            DemoError: the child process that receives the topics has ended, or time has started without a participant
                that the launch needs.
        """
        messages = self._feed.take(_POLL)
        for message in messages:
            self._note(message)
        now = time.monotonic()
        gap, self._looked = now - self._looked, now
        if gap > _STOPPED:  # this program was suspended, and probably all others with it (a sleeping machine)
            self._moved += gap
        if now - self._logs_read >= _LOGS_PERIOD:
            self._logs_read = now
            if self.startup.update() and (starting or self.startup.compiling):
                self._moved = now
            self._show_incomplete()
            self._show_standstill()
            self._show_page()
        self.show_ended_nodes(now)
        if self._feed.lost and self.running() and self.stalled_time > _GRACE:
            words = self._feed.last_words()
            raise DemoError(f"the watching node has ended{': ' * bool(words)}{words}")
        return messages

    def _note(self, message: dict[str, Any]) -> None:
        now, kind = time.monotonic(), message["kind"]
        if kind == "warning":
            self.warnings.append(message["text"])
            self.display.note(f"  [red]{escape(message['text'])}[/red]")
            return
        if kind != "status":
            self._moved = now
            self._sim_time = message.get("message", {}).get("sim_time", self._sim_time)
            return
        # a pause, or a node at a breakpoint, may last any time
        if message["held"] or self.status is None or message["joined"] != self.status["joined"]:
            self._moved = now
        self.status = message
        self._show_standstill()

    def _show_incomplete(self) -> None:
        """Show once that time has started without all participants, and which nodes are missing.

        Raises:
            DemoError: the launch needs all of them.
        """
        if self.startup.incomplete and not self._incomplete_shown:
            self._incomplete_shown = True
            words = self.startup.incomplete + self.not_joined()
            if self._launch.needs_all:
                raise DemoError(words)
            self.display.note(f"  [yellow]{escape(words)}[/yellow]")

    def _show_page(self) -> None:
        """Show once where the flight's page is, for a launch with ``web:=true``."""
        if self._page_shown or str(self._launch.arguments.get("web", "")).lower() != "true":
            return
        for line in _log_lines(self._launch):
            if line.startswith(_PAGE):
                self._page_shown = True
                self.display.note(f"  page {escape(line.removeprefix(_PAGE))}")

    def _show_standstill(self) -> None:
        status = "" if self.status is None else self.status["text"]
        if self.startup.compiling or self.status is not None:
            self.display.standstill(self.startup.compiling or status)

    def show_ended_nodes(self, now: float = float("inf")) -> None:
        """Show the nodes that have ended, delayed by ``_GRACE``; ``now`` is wall time, s."""
        new = self.ended_nodes.update(self._sim_time)
        if new and not self._first_end:
            self._first_end = time.monotonic()
        if self.ended_nodes.required is None and now - self._first_end < _GRACE:
            return
        for ended in self.ended_nodes.all():
            if ended.node not in self._shown:
                self._shown.add(ended.node)
                self.display.note(f"  [red]{escape(str(ended))}[/red]")
        if self.ended_nodes.consequences:
            names, self.ended_nodes.consequences = self.ended_nodes.consequences, []
            self.display.note(f"  with it: {escape(', '.join(names))}")

    def dead(self) -> list[EndedNode]:
        """Return the nodes that died rather than finished, once the cause is known."""
        died = [ended for ended in self.ended_nodes.all() if ended.matters and ended.died]
        known = self.ended_nodes.required is not None or time.monotonic() - self._first_end >= _GRACE
        return died if known else []

    def standstill_reason(self) -> str:
        """Return the reason for the missing progress as a clause."""
        if not answers(self._launch.master_uri):
            return f"the ROS master at {self._launch.master_uri} does not answer"
        if self.status is None:
            return "no simulator has started"
        text = str(self.status["text"])
        if _INCOMPLETE in text:
            text += self.not_joined()
        return text or f"simulated time is {self.status['time']:.1f} s"

    def not_joined(self) -> str:
        """Return ": " and the nodes that have not joined the simulator with their states; empty if there are none."""
        joined = () if self.status is None else self.status["joined"]
        words = not_joined(_log_lines(self._launch), joined, self.ended_nodes.found, self._launch.log.parent)
        return f": {words}" if words else ""

    def finish(self) -> None:
        """Wait for the launch to end on its own, and close the feed."""
        with defer_signals():
            self._feed.close()
            self._tree.wait(_PATIENCE)


def run_flight(flight: Flight, console: Console, conclude: Callable[[EndedNodes], int]) -> int:
    """Fly to the end, then conclude.

    Args:
        flight: the flight to launch.
        console: for progress and errors.
        conclude: writes the report and pictures of the finished flight, given the nodes that ended during it, and
            returns the exit status; may raise DemoError.

    Returns:
        The exit status: that of ``conclude``, 1 for a flight that failed, 128 + signal when stopped.
    """
    ended_nodes = EndedNodes(flight.log)
    warnings: list[str] = []

    def fly() -> int:
        console.print(flight.control_words, highlight=False, soft_wrap=True)
        topics = {"progress": flight.progress_topic, "events": flight.events_topic}
        try:
            with watching(flight, console, ended_nodes, topics) as watch:
                watch.warnings = warnings
                _watch(watch, flight)
        finally:
            with defer_signals():
                _mend_bag(flight.out / flight.bag, flight.environment())
        # the cause comes first: what follows is made of an incomplete record
        recorder = [str(ended) for ended in ended_nodes.all() if ended.node == _RECORDER and ended.died]
        for text in dict.fromkeys([*warnings, *recorder]):
            console.print(f"[red]Not recorded to the end:[/red] {escape(text)}", highlight=False, soft_wrap=True)
        status = conclude(ended_nodes)
        return status or int(bool(warnings))

    status = run_launch(flight, console, fly)
    bag = flight.out / flight.bag
    if status > _SIGNALLED and bag.is_file():
        words = f"recorded so far: {bag}; './xtdrone report {bag}' makes the report of it"
        console.print(words, highlight=False, soft_wrap=True)
    return status


def run_launch(launch: Launch, console: Console, run: Callable[[], int]) -> int:
    """Call ``run``, and report its failure on the console.

    Returns:
        The exit status: that of ``run``, 1 if it failed, 128 + signal when stopped.
    """
    launch.log.parent.mkdir(parents=True)
    console.print(f"Results: {launch.out}", highlight=False, soft_wrap=True)
    if launch.instance:
        console.print(
            f"Instance {launch.instance} of the simulations on this machine: ground stations at UDP "
            f"{instance_port(GCS_REMOTE_PORT, launch.instance)}, './xtdrone gcs ... --instance {launch.instance}'",
            highlight=False, soft_wrap=True,
        )  # fmt: skip
    with raise_on_signals():
        try:
            return run()
        except DemoError as error:
            console.print(f"[red]Error:[/red] {escape(str(error))}", highlight=False, soft_wrap=True)
            print_log_errors(launch, console)
            return 1
        except OSError as error:
            words = f"{error.filename or launch.out}: {error.strerror or error}"
            console.print(f"[red]Error:[/red] {escape(words)}", highlight=False, soft_wrap=True)
            return 1
        except Interrupted as signalled:
            console.print(f"stopped by {signalled}; nothing is left running", highlight=False)
            return _SIGNALLED + signalled.number


@contextlib.contextmanager
def watching(
    launch: Launch, console: Console, ended_nodes: EndedNodes, topics: Mapping[str, str], vehicles: Sequence[str] = ()
) -> Iterator[Watch]:
    """Run a launch for the duration of the context; end all of its processes at the exit.

    Args:
        launch: the launch to run.
        console: shows the progress.
        ended_nodes: collects the nodes that end.
        topics, vehicles: subscribed by the feed, see ``Feed``.

    Raises:
        DemoError: the launch cannot be started.
    """
    environment = launch.environment()
    _check_own_address(environment)
    master = launch.out / MASTER_FILE
    master.write_text(launch.master_uri + "\n", encoding="utf-8")
    pointer = announce(launch.out)
    feed = display = tree = None
    try:
        try:
            tree = ProcessTree(launch.command(), environment, launch.log)
            feed = Feed(environment, launch.log.parent / "watching.log", topics, vehicles)
        except OSError as error:
            raise DemoError(f"the launch cannot be started: {error.strerror or error}") from error
        except (RuntimeError, MemoryError) as error:  # no thread, no memory
            raise DemoError(f"the launch cannot be started: {error}") from error
        plain = launch.headless or not console.is_terminal
        display = LineDisplay(console) if plain else LiveDisplay(console)
        yield Watch(tree, launch, feed, display, ended_nodes)
    finally:
        with defer_signals():
            if display is not None:
                display.close()
            if feed is not None:
                feed.close()
            if tree is not None:
                tree.stop(_PATIENCE)
            master.unlink(missing_ok=True)
            if pointer is not None:
                pointer.unlink(missing_ok=True)


def _check_own_address(environment: Mapping[str, str]) -> None:
    """Check that this machine reaches itself under the address by which nodes find each other, as roslaunch does.

    Raises:
        DemoError: it does not.
    """
    name = "ROS_HOSTNAME" if environment.get("ROS_HOSTNAME") else "ROS_IP"
    address = environment.get(name, "")
    if not address:
        return
    with socket.create_server(("", 0)) as server:
        try:
            socket.create_connection((address, server.getsockname()[1]), timeout=_OWN_ADDRESS_LIMIT).close()
        except OSError as error:
            raise DemoError(
                f"{name} is {address!r}, and this machine does not reach itself under that name ({error}); unset it, "
                "or set it to an address of this machine"
            ) from error


def master_port(wanted: int | None, *, use_running: bool) -> int:
    """Return the TCP port of the flight's own ROS master; 0 to use the one of ROS_MASTER_URI.

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
    """Check that a ROS master answers at a URI.

    Raises:
        OptionError: no master answers.
    """
    if not answers(uri):
        raise OptionError(f"master: none answers at ROS_MASTER_URI {uri!r}; start roscore, or leave out --use-master")


def _watch(watch: Watch, flight: Flight) -> None:
    """Show the flight's progress until roslaunch has ended.

    Raises:
        DemoError: roslaunch ended before the flight did, a node died at the start, or the director stopped publishing.
    """
    begun, outcome = False, ""
    while watch.running() and outcome not in flight.last_events:
        for message in watch.poll(starting=not begun):
            if message["kind"] == "progress":
                begun = True
                watch.display.update(message["message"])
            elif message["kind"] == "events":
                begun = True
                flight.show_event(message["message"], watch.display)
                outcome = message["message"]["event"]
        dead = [] if begun else watch.dead()
        if dead:
            raise DemoError(f"a node died before the flight began: {dead[0]}")
        vital = (*_VITAL, *flight.vital)
        dropped = next((ended for ended in watch.ended_nodes.all() if ended.dropped and ended.node in vital), None)
        if dropped:
            raise DemoError(f"the flight cannot continue: {dropped}")
        if begun:
            check_progress(watch, _SILENCE_LIMIT, "no message received from the director")
        else:
            check_progress(watch, flight.start_limit, "the flight did not begin: no progress")
    watch.show_ended_nodes()
    if outcome in flight.last_events:
        watch.finish()
    # on a full disk, the file has no last event
    events = [outcome, *(event["event"] for event in flight.events()[-1:])]
    if not set(events) & set(flight.last_events):
        failure = watch.ended_nodes.failure
        raise DemoError(f"the flight ended early{'' if failure is None else f': {failure}'}")


def check_progress(watch: Watch, limit: float, what: str) -> None:
    """Check that there was progress within ``limit`` s of wall time.

    Raises:
        DemoError: there was none; the message begins with ``what`` and names the cause, if it is known.
    """
    if watch.stalled_time > limit:
        raise DemoError(f"{what} for {limit:.0f} s of wall time; {watch.standstill_reason()}")


def _log_lines(flight: Launch) -> list[str]:
    if not flight.log.is_file():
        return []
    return _COLOURS.sub("", flight.log.read_text(encoding="utf-8", errors="replace")).splitlines()


def print_log_errors(launch: Launch, console: Console) -> None:
    """Print the errors in the launch's log, and how to resolve the known ones."""
    lines = _log_lines(launch)
    for line in error_lines(lines)[:_ERROR_LINES]:
        console.print(f"  {escape(line)}", highlight=False, soft_wrap=True)
    for words in advice("\n".join(lines)):
        console.print(f"What to do: {escape(words)}", highlight=False, soft_wrap=True)
    console.print(f"All logs: {launch.log.parent}", highlight=False, soft_wrap=True)


def escape(text: str) -> str:
    """Return ``text`` with rich's markup escaped."""
    return text.replace("[", r"\[")


def _mend_bag(bag: Path, environment: dict[str, str]) -> None:
    """Reindex the bag of a killed recorder; without space for that, it stays without an index."""
    active = bag.with_suffix(".bag.active")
    program = shutil.which("rosbag")
    if not active.is_file() or program is None:
        return
    with contextlib.suppress(OSError, subprocess.TimeoutExpired), tempfile.TemporaryDirectory(dir=bag.parent) as folder:
        command = [program, "reindex", "-q", "--output-dir", folder, str(active)]  # a copy: the disk may be full
        done = subprocess.run(command, env=environment, check=False, capture_output=True, timeout=300)
        if done.returncode == 0 and not done.stderr:
            Path(folder, active.name).replace(active)
    active.replace(bag)


@contextlib.contextmanager
def raise_on_signals() -> Iterator[None]:
    """Raise :class:`Interrupted` in the main thread at SIGINT, SIGTERM and SIGHUP."""

    def handler(number: int, _: Any) -> None:
        raise Interrupted(number)

    with _handlers(handler):
        yield


@contextlib.contextmanager
def defer_signals() -> Iterator[None]:
    """Defer signals until the end of the context, so that a clean-up is not interrupted."""
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
