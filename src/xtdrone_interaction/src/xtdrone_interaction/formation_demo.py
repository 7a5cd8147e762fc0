"""Runs launch/formation.launch to its end, shows its progress and makes the report and the pictures."""

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
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any
from urllib.parse import urlparse

from rich.console import Console

from xtdrone_interaction.deaths import Death, Deaths
from xtdrone_interaction.display import Display, LineDisplay, LiveDisplay
from xtdrone_interaction.geometry import EVENTS_TOPIC, PROGRESS_TOPIC
from xtdrone_interaction.options import OptionError, check_master_port, free_port, repository
from xtdrone_interaction.processes import ProcessTree
from xtdrone_interaction.record import RecordError, read_events, read_record
from xtdrone_interaction.report import make_report, print_report, write_report
from xtdrone_interaction.sim_cli import MASTER_FILE, announce

_POLL = 0.2  # s, how often the processes are looked after
_START_LIMIT = 60.0  # s until the first progress, and _START_LIMIT_VEHICLE more for each vehicle
_START_LIMIT_VEHICLE = 2.0
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
class DemoSettings:
    """What is flown, and how.

    Attributes:
        n: number of vehicles.
        type: vehicle type.
        patterns: flown in turn.
        pattern_file: YAML with patterns of the user's own, or empty.
        processes: ``per_uav`` or ``shared``.
        follower: program of xtdrone_coordination.
        follower_class: the user's own follower class, ``/absolute/file.py`` or ``/absolute/file.py:Class``, or empty.
        control: ``vel`` or ``accel``.
        avoidance: ``own``: every follower computes its own; ``python`` or ``cpp``: one node for all.
        clearance: least height of any slot above the ground, m.
        world: name.
        seed: of sensor noise and biases.
        speed: target real-time factor, 0 for unlimited.
        out: folder of the results.
        master_port: TCP port of the flight's own ROS master; 0: the one of ROS_MASTER_URI, which runs already.
        headless: plain lines instead of the live display.
        logs: write the vehicles' flight logs into ``out / "logs"``.
        simulator: ``full`` or ``simplified``.
        model: of simplified vehicles: ``first-order``, ``second-order``, a YAML file; empty: the type's.
        leader_class: the user's own leader class, as ``follower_class``, or empty.
        window: a live window beside the flight.
    """

    n: int
    type: str
    patterns: list[str]
    pattern_file: str
    processes: str
    follower: str
    follower_class: str
    control: str
    avoidance: str
    clearance: float
    world: str
    seed: int
    speed: float
    out: Path
    master_port: int
    headless: bool
    logs: bool
    simulator: str = "full"
    model: str = ""
    leader_class: str = ""
    window: bool = False


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


def run_demo(settings: DemoSettings, console: Console) -> int:
    """Fly the demo.

    Returns:
        The exit status: 0 for a good flight, 1 for one that failed or missed its figures, 128 + signal when stopped.
    """
    command_wall = time.time()
    (settings.out / "logs").mkdir(parents=True)
    console.print(f"Results: {settings.out}", highlight=False, soft_wrap=True)
    console.print(_how_to_control(settings), highlight=False, soft_wrap=True)
    deaths = Deaths(_roslaunch_log(settings))
    with signals_raise():
        try:
            _fly(settings, console, deaths)
            return _conclude(settings, console, command_wall, deaths)
        except DemoError as error:
            console.print(f"[red]Error:[/red] {_escape(str(error))}", highlight=False, soft_wrap=True)
            for death in deaths.found.values():
                console.print(f"  {_escape(str(death))}", highlight=False, soft_wrap=True)
            _print_trouble(settings, console)
            return 1
        except Interrupted as signalled:
            console.print(f"stopped by {signalled}; nothing is left running", highlight=False)
            return 128 + signalled.number


def _how_to_control(settings: DemoSettings) -> str:
    uri = _master_uri(settings)
    return (
        f"ROS master {uri}; './xtdrone sim --master {settings.master_port or uri} pause' (step, speed, ...) controls it"
    )


def _fly(settings: DemoSettings, console: Console, deaths: Deaths) -> None:
    """Run the launch file to its end.

    Raises:
        DemoError: the flight failed.
    """
    uri = _master_uri(settings)
    environment = _environment(settings, uri)
    os.environ.update({k: environment[k] for k in environment if k.startswith("ROS_")})  # for our own rospy
    master = settings.out / MASTER_FILE
    master.write_text(uri + "\n", encoding="utf-8")
    pointer = announce(settings.out)
    tree = ProcessTree(_command(settings), environment, _roslaunch_log(settings))
    display: Display = LineDisplay(console) if settings.headless or not console.is_terminal else LiveDisplay(console)
    try:
        _watch(tree, settings, uri, display, deaths)
    finally:
        with _signals_wait():
            display.close()
            _close_feed()
            tree.stop(_PATIENCE)
            master.unlink(missing_ok=True)
            if pointer is not None:
                pointer.unlink(missing_ok=True)
            _mend_bag(settings.out / "flight.bag", environment)


def _command(settings: DemoSettings) -> list[str]:
    program = shutil.which("roslaunch")
    if program is None:
        raise DemoError("roslaunch: not found; source the workspace's devel/setup.bash first")
    arguments = {
        "n": settings.n,
        "type": settings.type,
        "patterns": ",".join(settings.patterns),
        "pattern_file": settings.pattern_file,
        "processes": settings.processes,
        "follower": settings.follower,
        "follower_class": settings.follower_class,
        "leader_class": settings.leader_class,
        "control": settings.control,
        "avoidance": settings.avoidance,
        "clearance": settings.clearance,
        "world": settings.world,
        "seed": settings.seed,
        "speed": settings.speed,
        "out": settings.out,
        "log": settings.out / "logs" if settings.logs else "",
        "view": "true" if settings.window else "false",
    }
    if settings.simulator != "full":
        arguments |= {"simulator": settings.simulator, "model": settings.model}
    port = ["-p", str(settings.master_port)] if settings.master_port else ["--wait"]
    return [
        program, "--sigint-timeout", str(_NODE_PATIENCE), *port,
        str(repository() / "launch" / "formation.launch"),
        *(f"{name}:={value}" for name, value in arguments.items()),
    ]  # fmt: skip


def _master_uri(settings: DemoSettings) -> str:
    if settings.master_port:
        return f"http://127.0.0.1:{settings.master_port}"
    return os.environ["ROS_MASTER_URI"]


def _environment(settings: DemoSettings, uri: str) -> dict[str, str]:
    environment = dict(os.environ)
    environment["ROS_MASTER_URI"] = uri
    environment["ROS_LOG_DIR"] = str(settings.out / "logs")
    # nodes start by /usr/bin/env python3 where the workspace was not built: it must be this Python
    environment["PATH"] = f"{Path(sys.executable).parent}{os.pathsep}{environment.get('PATH', '')}"
    if settings.master_port and not {"ROS_IP", "ROS_HOSTNAME"} & environment.keys():
        environment["ROS_IP"] = "127.0.0.1"
    return environment


def _roslaunch_log(settings: DemoSettings) -> Path:
    return settings.out / "logs" / "roslaunch.log"


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


def _watch(tree: ProcessTree, settings: DemoSettings, uri: str, display: Display, deaths: Deaths) -> None:
    """Show the flight's progress until roslaunch has ended.

    Raises:
        DemoError: it ended before the flight did, a node died at the start, or the director fell silent.
    """
    limit = _START_LIMIT + _START_LIMIT_VEHICLE * settings.n
    last, begun, outcome = time.monotonic(), False, ""
    sim_time: float | None = None
    feed = _Feed()
    connected = False
    while not tree.wait(0.0):
        if not connected and _listens(uri):
            _open_feed(feed)
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
                show_event(message, display)
                outcome = message["event"]
            if outcome in ("done", "failed"):
                break
        if not begun and _died(settings):
            raise DemoError("a node died before the flight began")
        if time.monotonic() - last > limit:
            what = "no message from the director" if begun else "the flight did not begin"
            raise DemoError(f"{what} within {limit:.0f} s of wall time")
    _show_deaths(deaths, sim_time, display)
    if outcome in ("done", "failed"):
        with _signals_wait():
            _close_feed()
            tree.wait(_PATIENCE)
    events = _events(settings)
    if not events or events[-1]["event"] not in ("done", "failed"):
        raise DemoError("the flight ended early")
    if events[-1]["event"] == "failed":
        raise DemoError(events[-1]["reason"])


def _show_deaths(deaths: Deaths, sim_time: float | None, display: Display) -> None:
    for death in deaths.look(sim_time):
        display.note(f"  [red]{_escape(str(death))}[/red]")


def show_event(event: dict[str, Any], display: Display) -> None:
    """Show an event of the director that a user wants to read."""
    time_text = f"  {event['time']:6.1f} s "
    if event["event"] == "settled":
        display.note(f"{time_text} {event['what']}: settled after {event['after']:.1f} s")
    elif event["event"] == "unsettled":
        display.note(f"{time_text} {event['what']}: not settled, {event['vehicle']} is {event['error']:.2f} m off")
    elif event["event"] == "giving up":
        display.note(f"{time_text} giving up, landing: {_escape(event['reason'])}")
    elif event["event"] == "refused":
        display.note(f"{time_text} {_escape(event['reason'])}")


def _open_feed(feed: _Feed) -> None:
    """Subscribe to the director's messages."""
    import rospy
    from std_msgs.msg import String
    from xtdrone_msgs.msg import SimulationStatus

    rospy.init_node("formation_demo_display", anonymous=True, disable_signals=True)
    rospy.Subscriber(PROGRESS_TOPIC, String, feed.callback("progress"))
    rospy.Subscriber(EVENTS_TOPIC, String, feed.callback("event"))
    rospy.Subscriber("/simulator/status", SimulationStatus, feed.on_status)


def _close_feed() -> None:
    """Leave the master before it goes."""
    rospy = sys.modules.get("rospy")
    if rospy is not None and not rospy.is_shutdown():
        rospy.signal_shutdown("the flight has ended")


def _events(settings: DemoSettings) -> list[dict[str, Any]]:
    return read_events(settings.out / "events.jsonl")


def _log_lines(settings: DemoSettings) -> list[str]:
    path = _roslaunch_log(settings)
    if not path.is_file():
        return []
    return _COLOURS.sub("", path.read_text(encoding="utf-8", errors="replace")).splitlines()


def _died(settings: DemoSettings) -> bool:
    return any("has died" in line for line in _log_lines(settings))


def _print_trouble(settings: DemoSettings, console: Console) -> None:
    """Print what the launch's log says of the cause."""
    lines = [line for line in _log_lines(settings) if _TROUBLE.search(line)]
    for line in lines[:_TROUBLE_LINES]:
        console.print(f"  {_escape(line.strip())}", highlight=False, soft_wrap=True)
    console.print(f"All of it: {_roslaunch_log(settings).parent}", highlight=False, soft_wrap=True)


def _escape(text: str) -> str:
    return text.replace("[", r"\[")


def _conclude(settings: DemoSettings, console: Console, command_wall: float, deaths: Deaths) -> int:
    """Make report and pictures of the finished flight and return the exit status."""
    stored = {k: v for k, v in asdict(settings).items() if k not in ("out", "master_port", "headless", "window")}
    return report_flight(
        settings.out / "flight.bag", {**stored, "command_wall": command_wall}, console, list(deaths.found.values())
    )


def report_again(file: Path, console: Console) -> int:
    """Make report and pictures of a recorded flight again, and keep what only an earlier report knows.

    Raises:
        DemoError: the file is no flight record.
    """
    known: dict[str, Any] = {}
    with contextlib.suppress(FileNotFoundError, ValueError):
        known = json.loads((file.parent / "report.json").read_text(encoding="utf-8"))
    kept: dict[str, Any] = {key: known[key] for key in ("startup_time", "comparison") if key in known}
    deaths = [Death(**death) for death in known.get("died", [])]
    return report_flight(file, known.get("settings", {}), console, deaths, kept)


def report_flight(
    bag: Path,
    settings: dict[str, Any],
    console: Console,
    deaths: Sequence[Death] = (),
    kept: Mapping[str, Any] = MappingProxyType({}),
) -> int:
    """Write report.json and the pictures beside ``bag``, print the table, and return 0 for a good flight, else 1.

    Args:
        bag: the flight's record.
        settings: see :func:`~xtdrone_interaction.report.make_report`.
        console: gets the table.
        deaths: nodes that ended in flight, where that is known.
        kept: goes into the report as it is.

    Raises:
        DemoError: the bag is no flight record.
    """
    from xtdrone_interaction.plots import save_plots  # matplotlib takes a while to import

    try:
        record = read_record(bag)
        report = make_report(record, settings)
        report |= {"died": [asdict(death) for death in deaths], **kept}
        report["shortcomings"] = [*(str(death) for death in deaths if death.matters), *report["shortcomings"]]
        write_report(report, bag.parent / "report.json")
        pictures = save_plots(record, bag.parent)
    except RecordError as error:
        raise DemoError(str(error)) from error
    print_report(report, console)
    for path in [bag, bag.parent / "report.json", *pictures]:
        console.print(f"  {path}", highlight=False, soft_wrap=True)
    return 1 if report["shortcomings"] else 0


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
def _signals_wait() -> Iterator[None]:
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
