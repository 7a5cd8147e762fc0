"""The keyboard as a ROS node.

==================================================  ==========================  =====================================
published, for each vehicle T as iris_0, or for the leader
/xtdrone/T/cmd, /xtdrone/leader/cmd                 std_msgs/String             ARM, OFFBOARD, AUTO.LAND, HOVER, ...
/xtdrone/T/cmd_vel_flu, /xtdrone/leader/...         geometry_msgs/Twist         with ``vel``, 10 Hz while not zero
/xtdrone/T/cmd_accel_flu, /xtdrone/leader/...       geometry_msgs/Twist         with ``accel``, likewise
subscribed
/T/mavros/state                                     mavros_msgs/State           of visible vehicles
/T/mavros/local_position/pose, velocity_local       PoseStamped, TwistStamped   likewise
==================================================  ==========================  =====================================

It runs in wall time, so that its keys work while the simulation is paused, takes no part in the lockstep, and needs no
simulator.
"""

from __future__ import annotations

import contextlib
import http.client
import logging
import math
import resource
import selectors
import signal
import sys
import threading
import time
import xmlrpc.client
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence

import genpy
import rosgraph
import rospy
from geometry_msgs.msg import PoseStamped, TwistStamped
from mavros_msgs.msg import State
from rosgraph.roslogging import RosStreamHandler

from xtdrone_common.programs.node_command_line import ArgumentError, fleet_of, run_program
from xtdrone_common.programs.plain_node import init_plain_node
from xtdrone_coordination.patterns import PatternError, Patterns

from .arguments import USAGE, Request, parse_arguments
from .command_topics import PERIOD, CommandTopics
from .key_bindings import AXES, Command, Message, Pilot, Setpoint, Target, digits
from .screen import SILENT, Layout, ScreenContent, VehicleStatus, frame, help_lines, layout, sentence
from .terminal import (
    ENDING,
    PAGE_DOWN,
    PAGE_UP,
    QUIT,
    REDRAW,
    KeyDecoder,
    NoTerminalError,
    Signals,
    Terminal,
    TerminalGoneError,
)

NAME = "multirotor_keyboard_control"
_WIDTH = 80  # columns of the help without redrawing
_MASTER_PERIOD = 2.0  # s between two checks of the master
_NEW_MASTER = "a new ROS master: end this, start it again"
_LEAVE_LIMIT = 3.0  # s for the master to unregister the node


class _LatestMessage:
    """The last message of a topic, decoded on demand, because most of thirty a second are never shown."""

    def __init__(self, topic: str, kind: type[genpy.Message]) -> None:
        self.heard: float | None = None  # s, of the monotonic clock
        self._kind = kind
        self._packed = b""
        self._subscriber = rospy.Subscriber(topic, rospy.AnyMsg, self._store, queue_size=1, tcp_nodelay=True)

    def _store(self, message: rospy.AnyMsg) -> None:
        self._packed, self.heard = message._buff, time.monotonic()

    def decode(self) -> genpy.Message | None:
        """Return the message; None before the first one, or for another type."""
        if self.heard is None:
            return None
        message = self._kind()
        try:
            message.deserialize(self._packed)
        except (genpy.DeserializationError, UnicodeDecodeError):
            return None
        return message

    def close(self) -> None:
        self._subscriber.unregister()


class _VehicleMonitor:
    """Topics of one visible vehicle."""

    def __init__(self, name: str) -> None:
        self._name = name
        self._state = _LatestMessage(f"/{name}/mavros/state", State)
        self._pose = _LatestMessage(f"/{name}/mavros/local_position/pose", PoseStamped)
        self._velocity = _LatestMessage(f"/{name}/mavros/local_position/velocity_local", TwistStamped)
        self._topics = (self._state, self._pose, self._velocity)

    def status(self, has_subscriber: bool) -> VehicleStatus:
        """Return the current state."""
        state, pose, velocity = self._state.decode(), self._pose.decode(), self._velocity.decode()
        heard = [topic.heard for topic in self._topics if topic.heard is not None]
        linear = velocity.twist.linear if velocity else None
        return VehicleStatus(
            self._name,
            armed=state.armed if state else None,
            mode=state.mode if state else "",
            height=pose.pose.position.z if pose else None,
            speed=math.hypot(linear.x, linear.y, linear.z) if linear else None,
            silence=time.monotonic() - max(heard) if heard else None,
            has_subscriber=has_subscriber,
        )

    def close(self) -> None:
        for topic in self._topics:
            topic.close()


class _Monitor:
    """Monitors the visible vehicles and the ROS master.

    Two threads call the master: rospy waits for it while it subscribes, forever if it is gone, and the other thread
    reports just that.

    Attributes:
        trouble: short description of a problem with the master; empty for none.
    """

    def __init__(self) -> None:
        self.trouble = ""
        self._watches: dict[str, _VehicleMonitor] = {}
        self._wanted: Sequence[str] = ()
        self._changed = threading.Event()
        self._ended = threading.Event()
        rospy.on_shutdown(self._end)
        self._master = rosgraph.Master(rospy.get_name())
        self._master_pid: int | None = None
        threading.Thread(target=self._check_master, name="master", daemon=True).start()
        threading.Thread(target=self._subscribe, name="subscriptions", daemon=True).start()

    def statuses(self, has_subscriber: Mapping[str, bool]) -> list[VehicleStatus]:
        """Return the states of the named vehicles, and monitor only these from now on."""
        names = tuple(has_subscriber)
        if names != self._wanted:
            self._wanted = names
            self._changed.set()
        watches = {name: self._watches.get(name) for name in names}
        return [
            watch.status(has_subscriber[name]) if watch else VehicleStatus(name, has_subscriber=has_subscriber[name])
            for name, watch in watches.items()
        ]

    def _end(self) -> None:
        self._ended.set()
        self._changed.set()

    def _check_master(self) -> None:
        while not self._ended.is_set():
            self.trouble = self._trouble_of_master()
            self._ended.wait(_MASTER_PERIOD)

    def _trouble_of_master(self) -> str:
        """Describe a problem with the ROS master; empty for none.

        Without a master, existing connections survive but no new ones are made. A restarted master is another process,
        or does not know this node; rospy registers with it only what it subscribes from then on.
        """
        try:
            pid = self._master.getPid()
            self._master_pid = self._master_pid or pid
            self._master.lookupNode(rospy.get_name())
        except rosgraph.MasterException:
            return _NEW_MASTER
        except (OSError, http.client.HTTPException, xmlrpc.client.Error):
            return "no ROS master"
        return "" if pid == self._master_pid else _NEW_MASTER

    def _subscribe(self) -> None:
        while self._changed.wait() and not self._ended.is_set():
            self._changed.clear()
            self._watch(self._wanted)

    def _watch(self, wanted: Sequence[str]) -> None:
        """Subscribe to the wanted vehicles, until others are wanted."""
        for name in set(self._watches).difference(wanted):
            self._watches.pop(name).close()
        for name in wanted:
            if self._changed.is_set():
                return
            if name not in self._watches:
                self._watches[name] = _VehicleMonitor(name)


class _LogCapture(logging.Handler):
    """Captures log messages that would disturb the screen."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self.texts: deque[str] = deque(maxlen=1)

    def emit(self, record: logging.LogRecord) -> None:
        """Store a warning."""
        self.texts.append(" ".join(record.getMessage().split()))

    @contextlib.contextmanager
    def instead_of_console(self) -> Iterator[None]:
        """Replace rospy's console handlers within the context."""
        logger = logging.getLogger("rosout")
        before = [handler for handler in logger.handlers if isinstance(handler, RosStreamHandler)]
        for handler in before:
            logger.removeHandler(handler)
        logger.addHandler(self)
        try:
            yield
        finally:
            logger.removeHandler(self)
            for handler in before:
                logger.addHandler(handler)


class Keyboard:
    """The keyboard program at one terminal."""

    def __init__(self, request: Request, pilot: Pilot, terminal: Terminal) -> None:
        """Advertise the topics.

        Args:
            request: the parsed command line.
            pilot: mapping of keys.
            terminal: not opened yet.
        """
        self._request = request
        self._pilot = pilot
        self._terminal = terminal
        self._began = time.monotonic()
        self._decoder = KeyDecoder()
        self._ending = False
        self._first = 0  # index of the first visible vehicle
        self._help: bool | None = None  # chosen by the user; None: shown if there is room
        self._monitor = _Monitor()
        self._written: dict[str, object] = {}  # last written values, without redrawing
        self._notes = _LogCapture()
        self._lock = threading.RLock()  # for pilot and publishers
        self._vehicles = {name: CommandTopics(name, request.mode) for name in request.names}
        self._leader = CommandTopics("leader", request.mode)
        rospy.on_shutdown(self._stop_for_good)  # rosnode kill: nothing can be published after the shutdown

    def run(self) -> None:
        """Process keys until a signal, Ctrl-C or the shutdown of the node.

        Raises:
            TerminalGoneError: the terminal has been closed.
        """
        # Signals is outermost, so that a signal ends the loop but not the restoring of the terminal.
        with Signals() as signals, selectors.DefaultSelector() as selector, self._notes.instead_of_console():
            selector.register(self._terminal.input, selectors.EVENT_READ)
            selector.register(signals.descriptor, selectors.EVENT_READ)
            with self._terminal.opened():
                self._introduce()
                try:
                    while not self._ending:
                        self._cycle(selector, signals)
                finally:
                    self._stop_for_good()
        if rospy.core.is_shutdown_requested():
            print(
                "the node was requested to end: by rosnode kill, or another node of its name has started",
                file=sys.stderr,
            )

    def _cycle(self, selector: selectors.BaseSelector, signals: Signals) -> None:
        """Process keys and signals for a period, publish the setpoint and update the screen."""
        end = time.monotonic() + PERIOD
        pressed = False
        while not self._ending and (left := end - time.monotonic()) > 0.0:
            ready = {key.fd for key, _ in selector.select(left)}
            if signals.descriptor in ready:
                self._handle_signals(signals)
            elif self._terminal.input in ready:
                pressed = True
                for key in self._decoder.feed(self._terminal.read()):
                    self._press(key)
        if self._ending:
            return
        if not pressed:
            self._decoder.drop_partial()
        self._act(lambda: [self._pilot.cycle()])
        self._show()

    # keys and signals

    def _press(self, key: str) -> None:
        if self._ending:
            return
        if key == QUIT:
            self._ending = True
        elif key == REDRAW:
            self._terminal.forget()
        elif key == "h":
            self._help = not self._layout().help
            if not self._terminal.redraws:
                self._write(*help_lines(_WIDTH, self._pilot.patterns))
        elif key in ("p", PAGE_DOWN, PAGE_UP):
            self._turn_page(-1 if key == PAGE_UP else 1)
        else:
            self._notes.texts.clear()
            self._act(lambda: self._pilot.press(key))

    def _handle_signals(self, signals: Signals) -> None:
        numbers = signals.take()
        if any(number in ENDING for number in numbers):
            self._ending = True
        elif signal.SIGTSTP in numbers:
            self._suspend(signals)
        elif signal.SIGCONT in numbers:
            self._reopen(signals)
        elif signal.SIGWINCH in numbers:
            self._terminal.forget()

    def _suspend(self, signals: Signals) -> None:
        """Stop the vehicles, then this process, as Ctrl-Z does; continue afterwards."""
        self._act(lambda: [self._pilot.stop()])
        self._terminal.suspend()
        self._reopen(signals)

    def _reopen(self, signals: Signals) -> None:
        """Open the terminal after the process is continued, unless it is ending."""
        while not self._ending:
            numbers = signals.take()
            self._ending = any(number in ENDING for number in numbers)
            if self._ending:
                return
            try:
                self._terminal.open()
                return
            except InterruptedError:
                continue

    # messages

    def _act(self, act: Callable[[], Sequence[Message | None]]) -> None:
        """Run an action of the pilot and publish its messages, unless the vehicles have been stopped for good."""
        with self._lock:
            if not self._ending:
                self._publish(act())

    def _publish(self, messages: Sequence[Message | None]) -> None:
        for message in messages:
            if isinstance(message, Command):
                self._send_command(message)
            elif message is not None:
                self._send_setpoint(message)

    def _topics_of(self, target: Target) -> dict[str, CommandTopics]:
        return {"leader": self._leader} if target is Target.LEADER else self._vehicles

    def _send_command(self, message: Command) -> None:
        topics = self._topics_of(message.target)
        unheard = [name for name, topic in topics.items() if not topic.has_subscriber]
        for topic in topics.values():
            topic.send_command(message.text)
        if unheard:
            more = f" and {len(unheard) - 1} more" if len(unheard) > 1 else ""
            self._pilot.note += f"; {unheard[0]}{more} received nothing: no communication node"
            if message.target is Target.LEADER:
                self._pilot.note = f"{message.text}: no leader is running, start leader.py"

    def _send_setpoint(self, message: Setpoint) -> None:
        for topic in self._topics_of(message.target).values():
            topic.send_setpoint(message)

    def _stop_for_good(self) -> None:
        """Stop the vehicles and ignore further keys; called in rospy's thread if it shuts the node down."""
        with self._lock:
            self._ending = True
            self._publish([self._pilot.stop()])

    # the screen

    def _fleet(self) -> str:
        counts = self._request.counts.items()
        return ", ".join(f"{kind} {count}" for kind, count in counts)

    def _layout(self) -> Layout:
        return layout(*self._terminal.size, len(self._vehicles), self._pilot.patterns, self._help)

    def _turn_page(self, pages: int) -> None:
        rows = self._layout().rows
        self._first += pages * rows
        if self._first >= len(self._vehicles):
            self._first = 0
        if self._first < 0:
            self._first = (len(self._vehicles) - 1) // rows * rows
        self._written.clear()

    def _page(self, rows: int) -> list[VehicleStatus]:
        """Return the vehicles on the page."""
        names = list(self._vehicles)[self._first : self._first + rows]
        return self._monitor.statuses({name: self._vehicles[name].has_subscriber for name in names})

    def _show(self) -> None:
        shown = self._layout()
        page = self._page(shown.rows)
        said = self._notes.texts[-1] if self._notes.texts else self._pilot.note
        note = "; ".join(filter(None, [self._monitor.trouble, said]))
        if not self._terminal.redraws:
            self._show_lines(page, note)
            return
        view = ScreenContent(
            fleet=self._fleet(),
            mode=self._request.mode,
            target=self._pilot.target,
            leader_has_subscriber=self._leader.has_subscriber,
            speeds=self._pilot.speeds,
            note=note,
            page=page,
            first=self._first,
            count=len(self._vehicles),
            patterns=self._pilot.patterns,
        )
        self._terminal.draw(frame(view, *self._terminal.size, shown))

    # a terminal that cannot redraw

    def _introduce(self) -> None:
        if not self._terminal.redraws:
            self._write(f"{self._fleet()}, {self._request.mode}", *help_lines(_WIDTH, self._pilot.patterns))

    def _show_lines(self, page: Sequence[VehicleStatus], note: str) -> None:
        """Write changes of speeds, notes, and of modes, arming and problems of vehicles."""
        speeds = self._pilot.speeds
        if self._changed("speeds", speeds):
            self._write("  ".join(f"{axis} {value:+.2f}" for axis, value in zip(AXES, speeds, strict=True)))
        if self._changed("note", note) and note:
            self._write(note)
        for status in page:
            if status.silence is None and time.monotonic() - self._began < SILENT:
                continue  # its first message may still arrive
            if self._changed(status.name, (status.armed, status.mode, status.has_subscriber, bool(status.trouble))):
                self._write(sentence(status))

    def _changed(self, what: str, value: object) -> bool:
        changed = self._written.get(what) != value
        self._written[what] = value
        return changed

    def _write(self, *lines: str) -> None:
        for line in lines:
            self._terminal.write_line(line)


def _keyboard(arguments: Sequence[str], terminal: Terminal) -> None:
    """Run the program with its arguments.

    Raises:
        ArgumentError: invalid arguments or ~patterns.
        TerminalGoneError: the terminal has been closed.
    """
    request = parse_arguments(arguments, fleet_of(rospy.get_param("/xtdrone/fleet", None)))
    _allow_many_files()
    init_plain_node(NAME, disable_signals=True, disable_rostime=True)
    try:
        Keyboard(request, Pilot(_patterns(request.formation)), terminal).run()
    finally:
        # In a thread, so that a master that does not answer does not delay the end.
        leaving = threading.Thread(target=rospy.signal_shutdown, args=("the keyboard has ended",), daemon=True)
        leaving.start()
        leaving.join(_LEAVE_LIMIT)


def _patterns(count: int) -> dict[str, str]:
    """Return the patterns by digit for a number of vehicles; none for a single one."""
    file = str(rospy.get_param("~patterns", ""))
    if count == 1:
        return {}
    try:
        return digits(Patterns(count, file or None).names)
    except PatternError as error:
        raise ArgumentError(str(error)) from error


def _allow_many_files() -> None:
    """Raise the limit of open files to the maximum: each vehicle has several connections."""
    _, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))


def main() -> int:
    """Run the program with ``sys.argv`` and return the exit status.

    0 after Ctrl-C or another signal, 1 without a master or after the terminal is closed, 2 for invalid arguments or if
    standard input is not a terminal.
    """
    signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        terminal = Terminal()
    except NoTerminalError as error:
        print(error, file=sys.stderr)
        return 2
    try:
        return run_program(lambda arguments: _keyboard(arguments, terminal), sys.argv, USAGE)
    except TerminalGoneError as error:
        print(f"the terminal has been closed: {error}", file=sys.stderr)
        return 1
