"""Launch files as the commands run them: watched from the first moment, with a master of their own, leaving nothing.

A demo's flight is such a launch, with a director that tells how it goes.
"""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console

from xtdrone_control.fleet import GCS_REMOTE_PORT, instance_port
from xtdrone_interaction.deaths import Death, Deaths
from xtdrone_interaction.display import Display, LineDisplay, LiveDisplay
from xtdrone_interaction.feed import Feed, answers
from xtdrone_interaction.flight_events import read_events
from xtdrone_interaction.hints import advice, trouble
from xtdrone_interaction.missing import not_joined
from xtdrone_interaction.options import OptionError, check_master_port, free_port, repository
from xtdrone_interaction.processes import ProcessTree
from xtdrone_interaction.sim_cli import MASTER_FILE, announce
from xtdrone_interaction.startup import Startup

_POLL = 0.2  # s, how often the processes are looked after
_LOGS_PERIOD = 1.0  # s between two looks at all logs
_GRACE = 1.0  # s for which a death is kept back: the simulator's, if that is its cause, may be noticed later
_SILENCE_LIMIT = 60.0  # s between two messages of progress
_PATIENCE = 25.0  # s that roslaunch gets to stop its nodes
_NODE_PATIENCE = 8.0  # s that a node gets to stop
_STOPPED = 5.0  # s between two looks, from which on this program has been stopped
_VITAL = ("simulator", "mavros", "formation_director", "search_mission")  # without which no flight goes on
_COLOURS = re.compile(r"\x1b\[[0-9;]*m")
_INCOMPLETE = "participants have "  # joined, or not: the simulator's words while it waits for them at the start
_TROUBLE_LINES = 12


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
class Launch:
    """A launch file with its arguments.

    Attributes:
        file: in launch/, or an absolute path.
        arguments: of the launch file.
        out: folder of the results; the logs are in ``out / "logs"``.
        master_port: TCP port of the launch's own ROS master; 0: the one of ROS_MASTER_URI, which runs already.
        headless: plain lines instead of the live display.
        instance: of the simulations on this machine.
    """

    file: str
    arguments: Mapping[str, object]
    out: Path
    master_port: int
    headless: bool
    instance: int = 0

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
        if not _is_writable(Path(environment.get("ROS_HOME") or os.path.expanduser("~/.ros"))):
            environment["ROS_HOME"] = str(self.out / "logs")  # where nodes run: without it roslaunch starts none
        return environment


def _is_writable(folder: Path) -> bool:
    """Return whether files can be made in ``folder``, which is made where it is not there."""
    there = next(place for place in (folder, *folder.parents) if place.exists())
    return there.is_dir() and os.access(there, os.W_OK | os.X_OK)


@dataclass(frozen=True, kw_only=True)
class Flight(Launch):
    """A launch file whose director tells how it goes, and ends it.

    Attributes:
        bag: recorded in ``out``, made readable if its recorder was killed. The director writes its events into
            ``out / "events.jsonl"``.
        start_limit: wall s for which nothing may move before the first message of the director; see ``startup``.
        progress_topic, events_topic: the director's, std_msgs/String with JSON.
        last_events: with which of them the flight ends.
        show_event: shows an event that a user wants to read.
    """

    bag: str
    start_limit: float
    progress_topic: str
    events_topic: str
    last_events: tuple[str, ...]
    show_event: Callable[[dict[str, Any], Display], None]

    def events(self) -> list[dict[str, Any]]:
        """Return the director's events so far."""
        return read_events(self.out / "events.jsonl")


class Watch:
    """Looks after a launch that runs: its processes, its logs, and what it tells on its topics.

    Attributes:
        deaths: nodes that have ended.
        startup: what the logs tell of the start.
        display: shows all of it.
        status: the simulator's newest, see ``feed``; None before the first.
    """

    def __init__(self, tree: ProcessTree, launch: Launch, feed: Feed, display: Display, deaths: Deaths) -> None:
        """Watch ``tree``, which runs ``launch``."""
        self.deaths = deaths
        self.display = display
        self.startup = Startup(launch.out / "logs")
        self.status: dict[str, Any] | None = None
        self._tree = tree
        self._launch = launch
        self._feed = feed
        self._sim_time: float | None = None
        self._moved = self._logs_read = self._looked = time.monotonic()
        self._shown: set[str] = set()
        self._first_death = 0.0

    @property
    def still(self) -> float:
        """Wall s since something has moved."""
        return time.monotonic() - self._moved

    def started(self) -> bool:
        """Return whether roslaunch has started any node."""
        self.startup.look()
        return self.startup.started > 0

    def running(self) -> bool:
        """Return whether roslaunch runs."""
        return not self._tree.wait(0.0)

    def look(self, *, starting: bool) -> list[dict[str, Any]]:
        """Look at everything, for a moment, and return the messages that are new; see ``feed``.

        Args:
            starting: whether new lines of logs count as movement.

        Raises:
            DemoError: the connection to the launch's topics has broken.
        """
        messages = self._feed.take(_POLL)
        for message in messages:
            self._note(message)
        now = time.monotonic()
        gap, self._looked = now - self._looked, now
        if gap > _STOPPED:  # this program has been stopped, and the others with it as on a machine that sleeps
            self._moved += gap
        if now - self._logs_read >= _LOGS_PERIOD:
            self._logs_read = now
            if self.startup.look() and (starting or self.startup.compiling):
                self._moved = now
            self._show_standstill()
        self.show_deaths(now)
        if self._feed.lost and self.running() and self.still > _GRACE:
            words = self._feed.last_words()
            raise DemoError(f"the watching node has ended{': ' * bool(words)}{words}")
        return messages

    def _note(self, message: dict[str, Any]) -> None:
        now, kind = time.monotonic(), message["kind"]
        if kind != "status":
            self._moved = now
            self._sim_time = message.get("message", {}).get("sim_time", self._sim_time)
            return
        # a pause, or a node at a breakpoint: however long, nothing is wrong
        if message["held"] or self.status is None or message["joined"] != self.status["joined"]:
            self._moved = now
        self.status = message
        self._show_standstill()

    def _show_standstill(self) -> None:
        status = "" if self.status is None else self.status["text"]
        if self.startup.compiling or self.status is not None:
            self.display.standstill(self.startup.compiling or status)

    def show_deaths(self, now: float = float("inf")) -> None:
        """Show the nodes that have ended, at wall time ``now``, s, a moment after their end."""
        new = self.deaths.look(self._sim_time)
        if new and not self._first_death:
            self._first_death = time.monotonic()
        if self.deaths.required is None and now - self._first_death < _GRACE:
            return
        for death in self.deaths.all():
            if death.node not in self._shown:
                self._shown.add(death.node)
                self.display.note(f"  [red]{escape(str(death))}[/red]")
        if self.deaths.consequences:
            names, self.deaths.consequences = self.deaths.consequences, []
            self.display.note(f"  with it: {escape(', '.join(names))}")

    def dead(self) -> list[Death]:
        """Return the nodes that have died, as against those that have done their work, once their cause is known."""
        died = [death for death in self.deaths.all() if death.matters and death.died]
        known = self.deaths.required is not None or time.monotonic() - self._first_death >= _GRACE
        return died if known else []

    def why_still(self) -> str:
        """Say why nothing moves, as far as that can be told; empty, or ending in a full clause."""
        if not answers(self._launch.master_uri):
            return f"the ROS master at {self._launch.master_uri} does not answer"
        if self.status is None:
            return "no simulator has started"
        text = str(self.status["text"])
        if _INCOMPLETE in text:
            text += self.not_joined()
        return text or f"simulated time is {self.status['time']:.1f} s"

    def not_joined(self) -> str:
        """Name the nodes that have not joined the simulator, with what is known of each; empty, or after a colon."""
        joined = () if self.status is None else self.status["joined"]
        words = not_joined(_log_lines(self._launch), joined, self.deaths.found, self._launch.log.parent)
        return f": {words}" if words else ""

    def finish(self) -> None:
        """Have the launch end by itself."""
        with signals_wait():
            self._feed.close()
            self._tree.wait(_PATIENCE)


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
    deaths = Deaths(flight.log)

    def fly() -> int:
        console.print(_how_to_control(flight), highlight=False, soft_wrap=True)
        topics = {"progress": flight.progress_topic, "events": flight.events_topic}
        try:
            with watching(flight, console, deaths, topics) as watch:
                _watch(watch, flight)
        finally:
            with signals_wait():
                _mend_bag(flight.out / flight.bag, flight.environment())
        return conclude(deaths)

    return run_launch(flight, console, fly)


def run_launch(launch: Launch, console: Console, run: Callable[[], int]) -> int:
    """Run something, and say on the console how it fails.

    Returns:
        What ``run`` returned, 1 where it failed, 128 + signal when stopped.
    """
    launch.log.parent.mkdir(parents=True)
    console.print(f"Results: {launch.out}", highlight=False, soft_wrap=True)
    if launch.instance:
        console.print(
            f"Instance {launch.instance} of the simulations on this machine: ground stations at UDP "
            f"{instance_port(GCS_REMOTE_PORT, launch.instance)}, './xtdrone gcs ... --instance {launch.instance}'",
            highlight=False, soft_wrap=True,
        )  # fmt: skip
    with signals_raise():
        try:
            return run()
        except DemoError as error:
            console.print(f"[red]Error:[/red] {escape(str(error))}", highlight=False, soft_wrap=True)
            print_trouble(launch, console)
            return 1
        except Interrupted as signalled:
            console.print(f"stopped by {signalled}; nothing is left running", highlight=False)
            return 128 + signalled.number


def _how_to_control(launch: Launch) -> str:
    uri = launch.master_uri
    return (
        f"ROS master {uri}; './xtdrone sim pause --master {launch.master_port or uri}' (step, speed, ...) controls it"
    )


@contextlib.contextmanager
def watching(
    launch: Launch, console: Console, deaths: Deaths, topics: Mapping[str, str], vehicles: Sequence[str] = ()
) -> Iterator[Watch]:
    """Run a launch for as long as the block takes; nothing of it is left afterwards.

    Args:
        launch: what is run.
        console: shows what becomes of it.
        deaths: takes the nodes that end.
        topics, vehicles: what else the feed tells, see ``Feed``.

    Raises:
        DemoError: it cannot be started.
    """
    environment = launch.environment()
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
        yield Watch(tree, launch, feed, display, deaths)
    finally:
        with signals_wait():
            if display is not None:
                display.close()
            if feed is not None:
                feed.close()
            if tree is not None:
                tree.stop(_PATIENCE)
            master.unlink(missing_ok=True)
            if pointer is not None:
                pointer.unlink(missing_ok=True)


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
    """Check that a ROS master answers at a URI.

    Raises:
        OptionError: none does.
    """
    if not answers(uri):
        raise OptionError(f"master: none answers at ROS_MASTER_URI {uri!r}; start roscore, or leave out --use-master")


def _watch(watch: Watch, flight: Flight) -> None:
    """Show the flight's progress until roslaunch has ended.

    Raises:
        DemoError: it ended before the flight did, a node died at the start, or the director fell silent.
    """
    begun, outcome = False, ""
    while watch.running() and outcome not in flight.last_events:
        for message in watch.look(starting=not begun):
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
        dropped = next((death for death in watch.deaths.all() if death.dropped and death.node in _VITAL), None)
        if dropped:
            raise DemoError(f"the flight cannot go on: {dropped}")
        if begun:
            check_still(watch, _SILENCE_LIMIT, "no message from the director has come")
        else:
            check_still(watch, flight.start_limit, "the flight did not begin: nothing has moved")
    watch.show_deaths()
    if outcome in flight.last_events:
        watch.finish()
    events = flight.events()
    if not events or events[-1]["event"] not in flight.last_events:
        failure = watch.deaths.failure
        raise DemoError(f"the flight ended early{'' if failure is None else f': {failure}'}")


def check_still(watch: Watch, limit: float, what: str) -> None:
    """Check that something has moved within ``limit`` s of wall time.

    Raises:
        DemoError: nothing has; the message begins with ``what`` and names the cause, as far as it can be told.
    """
    if watch.still > limit:
        raise DemoError(f"{what} for {limit:.0f} s of wall time; {watch.why_still()}")


def _log_lines(flight: Launch) -> list[str]:
    if not flight.log.is_file():
        return []
    return _COLOURS.sub("", flight.log.read_text(encoding="utf-8", errors="replace")).splitlines()


def print_trouble(launch: Launch, console: Console) -> None:
    """Print what the launch's log says of the cause, and what to do about it."""
    lines = _log_lines(launch)
    for line in trouble(lines)[:_TROUBLE_LINES]:
        console.print(f"  {escape(line)}", highlight=False, soft_wrap=True)
    for words in advice("\n".join(lines)):
        console.print(f"What to do: {escape(words)}", highlight=False, soft_wrap=True)
    console.print(f"All of it: {launch.log.parent}", highlight=False, soft_wrap=True)


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
