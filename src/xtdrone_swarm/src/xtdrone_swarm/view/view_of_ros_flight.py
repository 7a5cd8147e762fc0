"""``visualize.py TYPE NUM``: the picture of a running ROS flight, simplified or full physics, or of real vehicles.

==================================  ============================  ===================================================
subscribed                          type                          purpose
==================================  ============================  ===================================================
/gazebo/model_states                gazebo_msgs/ModelStates       positions of the vehicles, from a simulator
/T/mavros/local_position/pose       geometry_msgs/PoseStamped     likewise, without a simulator
/xtdrone/formation_pattern          std_msgs/Float32MultiArray    slots
/xtdrone/communication_topology     std_msgs/Int32MultiArray      edges
/clock                              rosgraph_msgs/Clock           the window's time
==================================  ============================  ===================================================

The window does not participate in the lockstep: the flight never waits for it, and it deserializes only the messages
that it draws. A film does participate: it contains every frame of simulated time, however long drawing takes.
"""

from __future__ import annotations

import contextlib
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import rospy
from gazebo_msgs.msg import ModelStates
from geometry_msgs.msg import PoseStamped
from rosgraph_msgs.msg import Clock
from rospy.client import load_command_line_node_params
from std_msgs.msg import Float32MultiArray, Int32MultiArray

import xtdrone_lockstep as lockstep
from xtdrone_common.programs.node_command_line import (
    ArgumentError,
    check_multirotor,
    fleet_of,
    parse_count,
    run_program,
)
from xtdrone_common.programs.plain_node import init_plain_node
from xtdrone_common.settings import check_range
from xtdrone_coordination.patterns import Patterns, with_leader
from xtdrone_swarm.view.film import FPS, FilmError, check_film, film
from xtdrone_swarm.view.projection_and_zoom import Array
from xtdrone_swarm.view.swarm_picture import TRAILS, Frame, SwarmView
from xtdrone_swarm.view.view_of_swarm import RealTimeFactor
from xtdrone_swarm.view.window_and_mouse import Window, WindowError, check_display

MODEL_STATES = "/gazebo/model_states"
PATTERN_TOPIC = "/xtdrone/formation_pattern"
TOPOLOGY_TOPIC = "/xtdrone/communication_topology"
USAGE = "visualize.py TYPE NUM   (~film:=/path/film.mp4 ~fps:=25, or a live window)"

_SAME = 1e-3  # m, distance below which two slots are equal; offsets are sent as 32-bit floats
_SEARCH_PERIOD = 0.5  # s of wall time between two searches for a publisher of positions
_REMINDER = 10.0  # s of wall time between two log lines about the missing publisher


class ObservedFlight:
    """State of a flight, received from its topics."""

    def __init__(self, names: Sequence[str]) -> None:
        """Create an empty state for vehicles with these names, for example ``iris_0``."""
        self.names = tuple(names)
        self._rows = {name: i for i, name in enumerate(names)}
        self.restart()

    def restart(self) -> None:
        """Discard the received state."""
        self._positions = np.full((len(self.names), 3), np.nan)
        self._offsets: Array | None = None
        self._edges: Any = None
        self._title = ""

    def handlers(self, source: str) -> dict[str, tuple[Any, Callable[[Any], None]]]:
        """Return the topics with their types and message handlers.

        Args:
            source: source of the positions: ``/gazebo/model_states``, or another value for the vehicles' local poses.
        """
        topics: dict[str, tuple[Any, Callable[[Any], None]]] = {
            PATTERN_TOPIC: (Float32MultiArray, self._on_pattern),
            TOPOLOGY_TOPIC: (Int32MultiArray, self._on_topology),
        }
        if source == MODEL_STATES:
            topics[MODEL_STATES] = (ModelStates, self._on_models)
        else:
            for i, name in enumerate(self.names):
                topics[pose_topic(name)] = (PoseStamped, partial(self._on_pose, i))
        return topics

    def frame(self, moment: float, note: str = "") -> Frame | None:
        """Return the state as a frame; None until a vehicle's position is known."""
        if not np.isfinite(self._positions).any():
            return None
        positions = self._positions.copy()
        slots = None if self._offsets is None else positions[0] + self._offsets
        return Frame(moment, positions, slots, self._edges, self._title, note)

    def _on_models(self, message: ModelStates) -> None:
        for name, pose in zip(message.name, message.pose, strict=False):
            row = self._rows.get(name)
            if row is not None:
                p = pose.position
                self._positions[row] = p.x, p.y, p.z

    def _on_pose(self, index: int, message: PoseStamped) -> None:
        p = message.pose.position
        self._positions[index] = p.x, p.y, p.z

    def _on_pattern(self, message: Float32MultiArray) -> None:
        """Store the slots; a message of another size, such as an empty one that cancels a pattern, means no slots."""
        width = len(self.names) - 1
        if not width or len(message.data) != 3 * width:
            self._offsets, self._title = None, ""
            return
        offsets = with_leader(np.asarray(message.data, dtype=float).reshape(3, width).T)
        if self._offsets is None or not np.array_equal(offsets, self._offsets):
            self._offsets, self._title = offsets, pattern_name(offsets)

    def _on_topology(self, message: Int32MultiArray) -> None:
        count = len(self.names)
        fits = len(message.data) == count * count
        self._edges = np.argwhere(np.asarray(message.data).reshape(count, count) > 0) if fits else None


def pose_topic(name: str) -> str:
    """Return the topic of a vehicle's estimated pose."""
    return f"/{name}/mavros/local_position/pose"


def pattern_name(offsets: Array) -> str:
    """Return the name of the pattern with these slots in any assignment; "" for an unknown pattern.

    Args:
        offsets: positions of all slots relative to the leader, shape (N, 3), m.
    """
    wanted = _sort(offsets)
    patterns = Patterns(len(offsets))
    for name in patterns.names:
        if np.abs(_sort(with_leader(patterns.offsets(name))) - wanted).max() < _SAME:
            return name
    return ""


def _sort(points: Array) -> Array:
    """Return points sorted by their coordinates."""
    grid = np.round(points / _SAME).astype(np.int64)
    return points[np.lexsort(grid.T)]


class Latest:
    """Subscribes to topics and keeps the last message of each in serialized form until it is needed.

    Subscribers outside the lockstep receive thousands of messages a second from a fast simulation and draw thirty.
    """

    def __init__(self, topics: Mapping[str, tuple[Any, Callable[[Any], None]]]) -> None:
        """Subscribe to ``topics``, a mapping of names to type and handler."""
        self._topics = dict(topics)
        self._packed: dict[str, bytes] = {}
        self._subscribers = [
            rospy.Subscriber(name, rospy.AnyMsg, self._keep, callback_args=name, queue_size=1, tcp_nodelay=True)
            for name in topics
        ]

    def _keep(self, message: rospy.AnyMsg, name: str) -> None:
        self._packed[name] = message._buff

    def serve(self) -> bool:
        """Call the handlers of the messages since the last call; return whether a message had arrived."""
        fresh = [name for name in self._topics if name in self._packed]
        for name in fresh:
            kind, handler = self._topics[name]
            message = kind()
            message.deserialize(self._packed.pop(name))
            handler(message)
        return bool(fresh)


def vehicle_names(arguments: Sequence[str]) -> list[str]:
    """Return the names of the vehicles selected by TYPE and NUM.

    Raises:
        ArgumentError: unknown type, or NUM is not a number or exceeds the fleet.
    """
    if len(arguments) != 2:
        raise ArgumentError(f"2 arguments are needed, {len(arguments)} were given")
    kind, number = arguments
    count = parse_count(number)
    there = check_multirotor(kind, fleet_of(rospy.get_param("/xtdrone/fleet", None)))
    if there is not None and count > there:
        raise ArgumentError(f"number of vehicles: {count}, but the fleet (/xtdrone/fleet) has {there} of type {kind}")
    return [f"{kind}_{i}" for i in range(count)]


# ---- the window ----


class _Rider:
    """Provides the window with the newest state, without participating in the lockstep."""

    def __init__(self, names: Sequence[str], window: Window, ended: threading.Event) -> None:
        self._flight = ObservedFlight(names)
        self._window = window
        self._ended = ended  # returns whether to close the window
        self._hint = window.view.hint
        self._latest: Latest | None = None
        self._looked = -np.inf
        self._factor = RealTimeFactor()
        self._began = time.monotonic()
        self._time: float | None = None  # s, of /clock; None: no message received

    def __call__(self) -> Frame | None:
        if rospy.is_shutdown() or self._ended.is_set():
            self._window.close()
        elif self._latest is None:
            self._look()
        elif not self._window.paused and self._latest.serve():
            if self._time is None:
                return self._flight.frame(time.monotonic() - self._began)
            return self._flight.frame(self._time, self._factor.update(self._time))
        return None

    def _look(self) -> None:
        """Subscribe when a publisher of positions appears."""
        if time.monotonic() - self._looked < _SEARCH_PERIOD:
            return
        self._looked = time.monotonic()
        source = positions_source(self._flight.names)
        if source is None:
            self._window.say(f"waiting for {MODEL_STATES} or {pose_topic(self._flight.names[0])}")
            return
        self._window.say("")
        self._latest = Latest({"/clock": (Clock, self._on_clock), **self._flight.handlers(source)})

    def _on_clock(self, message: Clock) -> None:
        self._time = message.clock.to_sec()


def positions_source(names: Sequence[str]) -> str | None:
    """Return the topic of the positions, preferably a simulator's; None if they are not published."""
    published = {topic for topic, _ in rospy.get_published_topics()}
    return next((topic for topic in (MODEL_STATES, *map(pose_topic, names)) if topic in published), None)


def _watch(names: Sequence[str]) -> None:
    """Show a live window until it is closed or the node shuts down."""
    check_display()
    # Tk runs in the main thread; only the newest message on /clock is used.
    init_plain_node("visualize", anonymous=True, disable_signals=True, disable_rostime=True)
    # Not by KeyboardInterrupt: imports and destructors during the first drawing suppress some of them.
    ended = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):  # shells make background jobs ignore SIGINT
        signal.signal(number, lambda *_: ended.set())
    window = Window(SwarmView(names, trails=_trails()), f"XTDrone: {len(names)} UAVs")
    try:
        window.run(_Rider(names, window, ended))
    finally:
        rospy.signal_shutdown("the window is closed")


# ---- the film ----


def _film(names: Sequence[str], path: Path, fps: float) -> None:
    """Film the flight until the node shuts down; the flight waits for every frame of simulated time."""
    check_film(path, fps)
    lockstep.init_node("visualize", rate=fps)
    view = SwarmView(names, trails=_trails())
    flight = ObservedFlight(names)
    for topic, (kind, handler) in flight.handlers(_film_source(names)).items():
        lockstep.Subscriber(topic, kind, handler)
    lockstep.start()
    rospy.loginfo(f"visualize: {fps:g} frames a simulated second into {path}")
    film(_turns(flight), path, fps, view=view, progress=sys.stderr.isatty())
    rospy.loginfo(f"visualize: the film is complete: {path}")


def _film_source(names: Sequence[str]) -> str:
    """Return the topic of the positions; without a simulator, wait until it is published."""
    if rospy.get_param("/lockstep/uri", "") or rospy.get_param("/lockstep/wait", False):
        return MODEL_STATES
    while not rospy.is_shutdown():
        source = positions_source(names)
        if source is not None:
            return source
        rospy.loginfo_throttle(_REMINDER, f"visualize: waiting for {MODEL_STATES} or {pose_topic(names[0])}")
        time.sleep(_SEARCH_PERIOD)  # the master reports new publishers only on request
    raise rospy.ROSInterruptException("shut down")


def _turns(flight: ObservedFlight) -> Iterator[Frame]:
    """Yield a frame each turn, from the first vehicle position until the node shuts down."""
    rate = lockstep.Rate()
    with contextlib.suppress(rospy.ROSInterruptException):
        while not rospy.is_shutdown():
            frame = flight.frame(rospy.get_time())
            if frame is not None:
                yield frame
            rate.sleep()


# ---- the program ----


def _own_parameter(name: str, default: Any) -> Any:
    """Return a private parameter from the command line or the master, before the node is initialized."""
    given = load_command_line_node_params(sys.argv)
    return given[name] if name in given else rospy.get_param(f"{lockstep.future_name('visualize')}/{name}", default)


def _trails() -> float:
    return check_range("~trails", _own_parameter("trails", TRAILS), 0.0, unit="s")


def visualize(arguments: Sequence[str]) -> None:
    """Run the program with its arguments, TYPE and NUM.

    Raises:
        ArgumentError: the arguments, or ~film, ~fps or ~trails, are not allowed.
        ROSInitException: no display is available.
    """
    names = vehicle_names(arguments)
    _trails()
    path = str(_own_parameter("film", "") or "")
    try:
        if path:
            _film(names, Path(path).expanduser().absolute(), _own_parameter("fps", FPS))
        else:
            _watch(names)
    except FilmError as error:
        raise ArgumentError(f"~film: {error}") from error
    except WindowError as error:
        raise rospy.ROSInitException(str(error)) from error


def main() -> int:
    """Run ``visualize.py`` with ``sys.argv``; return the exit status."""
    return run_program(visualize, sys.argv, USAGE)
