"""``./xtdrone record-view VIEW``: a film of a flight as rviz shows it, without a screen.

The flight is a recorded one (``--bag``), one that a demo flies first (``--demo``), or else the one that is running.
For a bag this process stands for the simulator: it has the lockstep's server and sends the bag's messages in their
simulated time, so each frame shows exactly what there was at its moment. Of a running flight the nodes become
participants: it waits for them, and flies as it would without.

Exit status: 0 when there is a film, 1 when there is none, 2 for a value that is not allowed, 128 + n when stopped by
signal n (what there is of the film is kept).
"""

from __future__ import annotations

import argparse
import contextlib
import logging
import os
import re
import select
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import rosgraph
from rich.console import Console

from xtdrone_control.fleet import parse_fleet
from xtdrone_control.lockstep.server import LockstepServer
from xtdrone_interaction import options, sim_cli
from xtdrone_interaction.launched import DemoError, Interrupted, signals_raise
from xtdrone_interaction.options import OptionError, checked
from xtdrone_interaction.processes import ProcessTree
from xtdrone_interaction.rviz.node import SEARCH_EVENTS
from xtdrone_interaction.rviz.stage import DRAWER, Stage, StageError, check_tools, node_environment
from xtdrone_interaction.rviz.views import LABELS, SHIPPED, make_view
from xtdrone_sim.vehicle_model import load_vehicle

DEMOS = ("formation", "simplified", "search")
_RATES = (1.0, 50.0)  # Hz of simulated time, least and most frames
_SIZES = (64, 4096)  # pixels
_JOIN_LIMIT = 90.0  # wall s for the nodes to start
_MASTER_LIMIT = 20.0  # wall s
_HANG_LIMIT = 60.0  # wall s
_REPORT_PERIOD = 5.0  # wall s between two lines of progress
_SLICE = 0.1  # wall s
_END = 1e9  # s, later than any flight
_LAST_TICKS = 2  # after the bag's end: what it says last is drawn two turns later


@dataclass(frozen=True)
class FilmSettings:
    """What is filmed, and how.

    Attributes:
        view: of SHIPPED, or an .rviz file.
        bag: recorded flight; None: the running one.
        demo: flown first, or empty; then ``bag`` is None.
        demo_options: of that demo.
        fps: frames a second of the film.
        faster: how many simulated seconds pass in a second of the film.
        size: width and height, pixels.
        begin, end: part of the flight that is filmed, s of simulated time.
        out: the film.
        frames: folder for PNG files too, or None.
        master: of the running flight: port or URI, or empty: it is looked for.
    """

    view: str
    bag: Path | None
    demo: str
    demo_options: tuple[str, ...]
    fps: float
    faster: float
    size: tuple[int, int]
    begin: float
    end: float
    out: Path
    frames: Path | None
    master: str

    @property
    def rate(self) -> float:
        """Frames a simulated second."""
        return self.fps / self.faster


def _size(text: str) -> tuple[int, int]:
    found = re.fullmatch(r"(\d+)x(\d+)", text)
    size = (int(found[1]), int(found[2])) if found else (0, 0)
    if not all(_SIZES[0] <= side <= _SIZES[1] for side in size):
        raise OptionError(f"size: {text!r} is not allowed; WIDTHxHEIGHT, each {_SIZES[0]} to {_SIZES[1]}, as 1280x720")
    return size


def _positive(name: str) -> Any:
    return checked(lambda text: options.positive(name, text))


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="xtdrone record-view",
        description="Film a flight as rviz shows it, without a screen: a recorded one, one that a demo flies first, or "
        "the one that is running. Options of the demo go after --.",
    )
    add = parser.add_argument
    add("view", metavar="VIEW", help=f"{', '.join(SHIPPED)} (made for the vehicles that fly), or an .rviz file")
    source = parser.add_mutually_exclusive_group()
    source.add_argument("--bag", type=Path, metavar="FILE", help="flight.bag of a run")
    source.add_argument("--demo", choices=DEMOS, help="fly this demo, then film it")
    add("--out", type=Path, metavar="FILM", help="ends with .mp4 (default: VIEW.mp4 beside the bag, else here)")
    add("--fps", type=_positive("fps"), default=30.0, metavar="N", help="frames a second of the film (default: 30)")
    add("--faster", type=_positive("faster"), default=1.0, metavar="N",
        help="simulated seconds in a second of the film (default: 1)")  # fmt: skip
    add("--size", type=checked(_size), default=(1280, 720), metavar="WxH", help="pixels (default: 1280x720)")
    add(
        "--from", dest="begin", type=float, default=0.0, metavar="S", help="simulated time at which a bag's film begins"
    )
    add(
        "--to",
        dest="end",
        type=float,
        default=float("inf"),
        metavar="S",
        help="of a bag: simulated time of the last frame",
    )
    add("--frames", type=Path, metavar="FOLDER", help="write each frame as PNG file too, into a new folder")
    add("--master", default="", metavar="PORT|URI", help="of the running flight (default: it is looked for)")
    return parser


def film_settings(argv: Sequence[str]) -> FilmSettings:
    """Return what is to be filmed, after all checks that need no ROS.

    Args:
        argv: options, and after ``--`` those of the demo.

    Raises:
        OptionError: a value that is not allowed.
        SystemExit: argparse's.
    """
    own = list(argv)
    cut = own.index("--") if "--" in own else len(own)
    arguments, demo_options = _parser().parse_args(own[:cut]), own[cut + 1 :]
    view = arguments.view
    name = Path(view).stem if view.endswith(".rviz") and not Path(view).is_file() else view
    if name not in SHIPPED:
        if not Path(view).is_file():
            raise OptionError(f"view: {view!r} is neither an .rviz file nor one of {', '.join(SHIPPED)}")
        name = str(Path(view).resolve())
    if demo_options and not arguments.demo:
        raise OptionError(f"{demo_options[0]!r}: options of a demo are for --demo only")
    if arguments.bag is not None and not arguments.bag.is_file():
        raise OptionError(f"bag: {arguments.bag} does not exist")
    if not arguments.begin < arguments.end:
        raise OptionError(f"from, to: {arguments.begin:g} s is not before {arguments.end:g} s")
    out = arguments.out or (arguments.bag.parent if arguments.bag else Path()) / f"{Path(name).stem}.mp4"
    if out.suffix != ".mp4":
        raise OptionError(f"out: {str(out)!r} is not allowed; a film ends with .mp4")
    if not out.resolve().parent.is_dir():
        raise OptionError(f"out: {out.resolve().parent} is no folder")
    settings = FilmSettings(
        view=name,
        bag=arguments.bag,
        demo=arguments.demo or "",
        demo_options=tuple(demo_options),
        fps=arguments.fps,
        faster=arguments.faster,
        size=arguments.size,
        begin=arguments.begin,
        end=arguments.end,
        out=out.resolve(),
        frames=options.new_folder(arguments.frames) if arguments.frames else None,
        master=arguments.master,
    )
    if not _RATES[0] <= settings.rate <= _RATES[1]:
        raise OptionError(
            f"fps, faster: {settings.rate:g} frames a simulated second are not allowed; {_RATES[0]:g} to {_RATES[1]:g}"
        )
    return settings


def main(argv: Sequence[str]) -> int:
    """Film and return the exit status."""
    console = Console()
    try:
        settings = film_settings(argv)
        with signals_raise():
            return _film(settings, console)
    except OptionError as error:
        print(f"xtdrone: {error}", file=sys.stderr)
        return 2
    except (DemoError, ValueError) as error:  # a bag that cannot be shown, too
        print(f"xtdrone: {error}", file=sys.stderr)
        return 1
    except OSError as error:
        print(f"xtdrone: {error.filename or 'system'}: {error.strerror or error}", file=sys.stderr)
        return 1
    except Interrupted as signalled:
        console.print(f"stopped by {signalled}; nothing is left running", highlight=False)
        return 128 + signalled.number


def _film(settings: FilmSettings, console: Console) -> int:
    check_tools()
    flown = 0
    if settings.demo:
        folder = options.results_folder(None)
        command = [sys.executable, "-m", "xtdrone_interaction", "demo", settings.demo, "--out", str(folder)]
        flown = subprocess.run([*command, *settings.demo_options], check=False).returncode
        if not (folder / "flight.bag").is_file():
            raise StageError(f"demo {settings.demo}: status {flown}, and no flight was recorded in {folder}")
        settings = replace(settings, bag=folder / "flight.bag")
    if settings.frames is not None:
        settings.frames.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="xtdrone-view-") as work:
        if settings.bag is not None:
            film_bag(settings, settings.bag, Path(work), console)
        else:
            film_running(settings, Path(work), console)
    console.print(f"{settings.out}", highlight=False, soft_wrap=True)
    return flown


def _start_nodes(stage: Stage, settings: FilmSettings, fleet: str, work: Path, running: set[str]) -> None:
    """Start the nodes that are not running yet, with what they find on the master."""
    vehicles = parse_fleet(fleet)
    master = rosgraph.Master("/record_view")
    for vehicle in vehicles:
        # The simplified simulator, and a bag, tell nobody what vehicles look like.
        if not master.hasParam(f"/{vehicle.name}/robot_description"):
            master.setParam(f"/{vehicle.name}/robot_description", load_vehicle(vehicle.type).urdf.text)
    config = Path(settings.view)
    if settings.view in SHIPPED:
        config = work / f"{settings.view}.rviz"
        config.write_text(make_view(settings.view, [vehicle.name for vehicle in vehicles]), encoding="utf-8")
    if "/robot_tf" not in running:
        stage.start("xtdrone_sim", "robot_tf", {"rate": settings.rate})
    if "/swarm_markers" not in running:
        label = LABELS.get(settings.view)
        stage.start("xtdrone_interaction", "swarm_markers", {"rate": settings.rate, "label": label})
    stage.start("xtdrone_rviz", DRAWER, {
        "config": config,
        "rate": settings.rate,
        "fps": settings.fps,
        "width": settings.size[0],
        "height": settings.size[1],
        "film": settings.out,
        "frames": settings.frames,
    })  # fmt: skip


# ---- a running flight


def film_running(settings: FilmSettings, work: Path, console: Console) -> None:
    """Film the running flight until it ends or Ctrl-C.

    Raises:
        StageError: no flight is running, or there is no film.
    """
    given = f"http://localhost:{settings.master}" if settings.master.isdigit() else settings.master
    try:
        uri, _ = sim_cli.choose_master(given, os.environ.get("ROS_MASTER_URI", ""), [sim_cli.RUNS])
    except sim_cli.SimError as error:
        raise StageError(f"{error}; or film a recorded flight: --bag FILE") from error
    master = rosgraph.Master("/record_view", master_uri=uri)
    try:
        fleet = str(master.getParam("/xtdrone/fleet"))
        publishers, subscribers, services = master.getSystemState()
    except (rosgraph.MasterException, OSError) as error:
        raise StageError(f"master: {uri} does not answer as that of a flight: {error}") from error
    running = {node for group in (publishers, subscribers, services) for _, nodes in group for node in nodes}
    if f"/{DRAWER}" in running:
        raise StageError(f"{DRAWER}: one films this flight already")
    os.environ.update(node_environment(uri))
    with Stage(dict(os.environ), work) as stage:
        _start_nodes(stage, settings, fleet, work, running)
        console.print(f"filming the flight at {uri} until it ends; Ctrl-C ends the film before", highlight=False)
        while not stage.wait(DRAWER, _SLICE):
            pass
        stage.finish()
    if not settings.out.is_file():
        raise StageError(f"there is no frame: {stage.last_words(DRAWER)}")


# ---- a recorded flight


@contextlib.contextmanager
def _master(work: Path) -> Iterator[str]:
    """Run a ROS master on a free port and give its URI.

    Raises:
        StageError: it does not start.
    """
    port = options.free_port()
    uri = f"http://127.0.0.1:{port}"
    tree = ProcessTree(["rosmaster", "--core", "-p", str(port)], {**os.environ, "ROS_IP": "127.0.0.1"}, work / "master")
    try:
        end = time.monotonic() + _MASTER_LIMIT
        while not rosgraph.is_master_online(uri):
            if tree.wait(_SLICE) or time.monotonic() > end:
                raise StageError(f"rosmaster: does not answer on port {port}")
        yield uri
    finally:
        tree.stop(5.0)


def film_bag(settings: FilmSettings, path: Path, work: Path, console: Console) -> None:
    """Film a recorded flight.

    Raises:
        BagError: it cannot be shown.
        StageError: there is no film.
    """
    from xtdrone_interaction.rviz.bag import FlightBag  # rosbag takes a while to import

    bag = FlightBag(path)
    with contextlib.closing(bag), _master(work) as uri:
        os.environ.update(node_environment(uri))
        _play(settings, bag, work, console)


def _play(settings: FilmSettings, bag: Any, work: Path, console: Console) -> None:
    """Be the simulator of the nodes, with what the bag has."""
    import roslib.message
    import rospy

    from xtdrone_control import lockstep

    rospy.init_node("bag_player", disable_rostime=True, disable_signals=True)
    server = LockstepServer(hang_limit=_HANG_LIMIT, log=_log)
    try:
        server.attach_host(lockstep.host())
        rospy.set_param("/use_sim_time", True)
        rospy.set_param("/xtdrone/fleet", bag.fleet)
        rospy.set_param("/lockstep/uri", server.uri)
        with Stage(dict(os.environ), work) as stage:
            _start_nodes(stage, settings, bag.fleet, work, set())

            def idle(timeout: float) -> None:
                stage.check()
                select.select([server.fileno()], [], [], min(timeout, _SLICE))

            nodes = ["/robot_tf", "/swarm_markers", f"/{DRAWER}"]
            if not server.wait_for(nodes, _JOIN_LIMIT, idle):
                raise StageError(f"after {_JOIN_LIMIT:g} s: {server.missing(nodes)}")
            wanted = {topic for topic, _ in rosgraph.Master("/bag_player").getSystemState()[1]}
            topics = sorted(wanted & bag.types.keys() - {"/rosout", "/clock", "/tf", "/tf_static"})
            publishers = {
                topic: lockstep.Publisher(topic, roslib.message.get_message_class(bag.types[topic])) for topic in topics
            }
            server.wait_for(nodes, _JOIN_LIMIT, idle)
            began = time.monotonic()
            ticks = _run(settings, bag, server, publishers, idle, console)
            rate = ticks / (time.monotonic() - began)
            stage.finish()
            console.print(f"film: {ticks} frames, {rate:.1f} a second of wall time", highlight=False)
            if not settings.out.is_file():
                raise StageError(f"no frame was drawn in {ticks} turns: {stage.last_words(DRAWER)}")
    finally:
        server.close()
        rospy.signal_shutdown("the film is finished")


def _run(settings: FilmSettings, bag: Any, server: Any, publishers: Any, idle: Any, console: Console) -> int:
    """Send all messages in their time, turn by turn; return the number of turns."""
    begin_us = max(bag.begin_us, round(settings.begin * 1e6))
    end_us = round(min(settings.end, _END) * 1e6)
    source = bag.messages(publishers)
    following = next(source, None)
    # What was before the film's beginning is not drawn; of each topic the last message is what holds then.
    held: dict[str, Any] = {}
    while following is not None and following.time_us < begin_us:
        if following.topic == SEARCH_EVENTS:  # and all finds
            publishers[following.topic].publish(following.message)
        held[following.topic] = following.message
        following = next(source, None)
    for topic in held.keys() - {SEARCH_EVENTS}:
        publishers[topic].publish(held[topic])
    now_us, ticks, after, said = begin_us - 1, 0, 0, time.monotonic()
    while after < _LAST_TICKS:
        idle(0.0)
        now_us = server.next_due_us(now_us)
        while following is not None and following.time_us <= min(now_us, end_us):
            publishers[following.topic].publish(following.message)
            following = next(source, None)
        server.tick(now_us, {}, idle)
        ticks += 1
        after += following is None or now_us >= end_us
        if time.monotonic() - said > _REPORT_PERIOD:
            said = time.monotonic()
            share = min(1.0, (now_us - begin_us) / max(1, min(bag.end_us, end_us) - begin_us))
            console.print(f"film: {ticks} frames, sim {now_us * 1e-6:.1f} s, {share:.0%}", highlight=False)
    return ticks


def _log(level: int, text: str) -> None:
    if level >= logging.WARNING:
        print(f"lockstep: {text}", file=sys.stderr)
