"""The keyboard as a ROS node.

==================================================  ==========================  =====================================
published, for each vehicle T as iris_0, or for the leader
/xtdrone/T/cmd, /xtdrone/leader/cmd                 std_msgs/String             ARM, OFFBOARD, AUTO.LAND, HOVER, ...
/xtdrone/T/cmd_vel_flu, /xtdrone/leader/...         geometry_msgs/Twist         with ``vel``, 10 Hz while not zero
/xtdrone/T/cmd_accel_flu, /xtdrone/leader/...       geometry_msgs/Twist         with ``accel``, likewise
subscribed
/T/mavros/state                                     mavros_msgs/State           of the vehicles in sight
/T/mavros/local_position/pose, velocity_local       PoseStamped, TwistStamped   likewise
==================================================  ==========================  =====================================

It is a person's program: it lives in wall time, so that its keys work while the simulation is paused, takes no part in
the lockstep, and needs no simulator.
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
from geometry_msgs.msg import PoseStamped, Twist, TwistStamped
from mavros_msgs.msg import State
from rosgraph.roslogging import RosStreamHandler
from std_msgs.msg import String

from xtdrone_control import lockstep
from xtdrone_control.program import ArgumentError, fleet_of, run_program
from xtdrone_coordination.patterns import PatternError, Patterns

from .arguments import USAGE, Request, parse_arguments
from .keys import PAGE_DOWN, PAGE_UP, QUIT, REDRAW, Decoder
from .pilot import AXES, Message, Pilot, Say, Steer, Target, digits
from .screen import SILENT, Layout, Sight, View, frame, help_lines, layout, sentence
from .terminal import ENDING, NoTerminalError, Signals, Terminal, TerminalGoneError

NAME = "multirotor_keyboard_control"
PERIOD = 0.1  # s of wall time: XTDrone's 10 Hz
_WIDTH = 80  # columns of the help where nothing is redrawn
_MASTER_PERIOD = 2.0  # s between two looks for the master
_LEAVE_LIMIT = 3.0  # s for the master to let the node go
_KEPT = 10  # messages kept for a vehicle that takes none


class _Ear:
    """A topic's last message, unpacked when somebody looks: few of thirty a second are looked at."""

    def __init__(self, topic: str, kind: type[genpy.Message]) -> None:
        self.heard: float | None = None  # s, of the monotonic clock
        self._kind = kind
        self._packed = b""
        self._subscriber = rospy.Subscriber(topic, rospy.AnyMsg, self._take, queue_size=1, tcp_nodelay=True)

    def _take(self, message: rospy.AnyMsg) -> None:
        self._packed, self.heard = message._buff, time.monotonic()

    def look(self) -> genpy.Message | None:
        """Return the message; None before the first, and for one of another type."""
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


class _Watch:
    """What one vehicle in sight says."""

    def __init__(self, name: str) -> None:
        self._name = name
        self._state = _Ear(f"/{name}/mavros/state", State)
        self._pose = _Ear(f"/{name}/mavros/local_position/pose", PoseStamped)
        self._velocity = _Ear(f"/{name}/mavros/local_position/velocity_local", TwistStamped)
        self._ears = (self._state, self._pose, self._velocity)

    def sight(self, listened: bool) -> Sight:
        """Return the vehicle as it is seen now."""
        state, pose, velocity = self._state.look(), self._pose.look(), self._velocity.look()
        heard = [ear.heard for ear in self._ears if ear.heard is not None]
        linear = velocity.twist.linear if velocity else None
        return Sight(
            self._name,
            armed=state.armed if state else None,
            mode=state.mode if state else "",
            height=pose.pose.position.z if pose else None,
            speed=math.hypot(linear.x, linear.y, linear.z) if linear else None,
            silence=time.monotonic() - max(heard) if heard else None,
            listened=listened,
        )

    def close(self) -> None:
        for ear in self._ears:
            ear.close()


class _Lookout:
    """Watches the vehicles in sight, and only those, and the master.

    The master is asked in a thread: rospy waits for it, without end if it is gone.

    Attributes:
        trouble: what is wrong with the master, in a few words; empty: nothing.
    """

    def __init__(self) -> None:
        self.trouble = ""
        self._watches: dict[str, _Watch] = {}
        self._wanted: Sequence[str] = ()
        self._changed = threading.Event()
        self._ended = threading.Event()
        rospy.on_shutdown(self._ended.set)
        threading.Thread(target=self._run, name="lookout", daemon=True).start()

    def sights(self, listened: Mapping[str, bool]) -> list[Sight]:
        """Return how the vehicles named are seen now; from now on they are the ones to be watched."""
        names = tuple(listened)
        if names != self._wanted:
            self._wanted = names
            self._changed.set()
        watches = {name: self._watches.get(name) for name in names}
        return [w.sight(listened[n]) if w else Sight(n, listened=listened[n]) for n, w in watches.items()]

    def _run(self) -> None:
        while not rospy.is_shutdown():
            self._changed.wait(_MASTER_PERIOD)
            self.trouble = _trouble_of_master()
            if self.trouble:
                self._ended.wait(_MASTER_PERIOD)
            elif self._changed.is_set():
                self._changed.clear()
                self._watch(self._wanted)

    def _watch(self, wanted: Sequence[str]) -> None:
        """Watch these, until others are wanted or the master is gone: rospy would wait for it, and hold locks meanwhile
        that its shutdown needs."""
        for name in set(self._watches).difference(wanted):
            self._watches.pop(name).close()
        for name in wanted:
            if self._changed.is_set():
                return
            if not rosgraph.is_master_online():
                self._changed.set()  # to be done when it is back
                return
            if name not in self._watches:
                self._watches[name] = _Watch(name)


def _trouble_of_master() -> str:
    """Return what is wrong with the ROS master, in a few words; empty: nothing.

    Connections that there are live on without it, but none is made any more; one that was started anew knows nothing of
    this node, and rospy does not tell it.
    """
    name = rospy.get_name()
    try:
        rosgraph.Master(name).lookupNode(name)
    except rosgraph.MasterException:
        return "a new ROS master: end this, start it again"
    except (OSError, http.client.HTTPException, xmlrpc.client.Error):
        return "no ROS master"
    return ""


class _Outlet:
    """Where a vehicle, or the leader, takes commands; publishing waits for nobody."""

    def __init__(self, name: str, mode: str) -> None:
        self._command = lockstep.UncountedPublisher(f"/xtdrone/{name}/cmd", String, queue_size=_KEPT)
        self._steering = lockstep.UncountedPublisher(f"/xtdrone/{name}/cmd_{mode}_flu", Twist, queue_size=_KEPT)

    @property
    def listened(self) -> bool:
        """Whether anybody takes commands."""
        return bool(self._command.get_num_connections())

    def say(self, text: str) -> None:
        self._command.publish(String(data=text))

    def steer(self, twist: Twist) -> None:
        self._steering.publish(twist)


class _Notes(logging.Handler):
    """Keeps what rospy would write across the screen."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self.texts: deque[str] = deque(maxlen=1)

    def emit(self, record: logging.LogRecord) -> None:
        """Keep a warning."""
        self.texts.append(" ".join(record.getMessage().split()))

    @contextlib.contextmanager
    def instead_of_console(self) -> Iterator[None]:
        """Take what rospy logs, within the context, in place of its own handlers for the console."""
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
    """One person at one terminal."""

    def __init__(self, request: Request, pilot: Pilot, terminal: Terminal) -> None:
        """Advertise the topics.

        Args:
            request: whom to steer, and how.
            pilot: what keys mean.
            terminal: where they come from; not taken yet.
        """
        self._request = request
        self._pilot = pilot
        self._terminal = terminal
        self._began = time.monotonic()
        self._decoder = Decoder()
        self._ending = False
        self._first = 0  # vehicle at the head of the page
        self._help: bool | None = None  # wanted by the person; None: if there is room
        self._lookout = _Lookout()
        self._said: dict[str, object] = {}  # what was written last, where nothing is redrawn
        self._notes = _Notes()
        self._lock = threading.RLock()  # the pilot's and the publishers'
        self._vehicles = {name: _Outlet(name, request.mode) for name in request.names}
        self._leader = _Outlet("leader", request.mode)
        rospy.on_shutdown(self._stop_for_good)  # rosnode kill: nothing can be published once that is complete

    def run(self) -> None:
        """Take keys until a signal, Ctrl-C or the node's shutdown ends it.

        Raises:
            TerminalGoneError: the terminal has been closed.
        """
        # From outside to inside: signals end the loop, not the restoring.
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
            print("the node was told to end: by rosnode kill, or another node of its name has started", file=sys.stderr)

    def _cycle(self, selector: selectors.BaseSelector, signals: Signals) -> None:
        """Take what comes within a period, say the speeds, show how things are."""
        end = time.monotonic() + PERIOD
        pressed = False
        while not self._ending and (left := end - time.monotonic()) > 0.0:
            ready = {key.fd for key, _ in selector.select(left)}
            if signals.descriptor in ready:
                self._take_signals(signals)
            elif self._terminal.input in ready:
                pressed = True
                for key in self._decoder.feed(self._terminal.read()):
                    self._press(key)
        if self._ending:
            return
        if not pressed:
            self._decoder.rest()
        self._tell(lambda: [self._pilot.cycle()])
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
            self._tell(lambda: self._pilot.press(key))

    def _take_signals(self, signals: Signals) -> None:
        numbers = signals.take()
        if any(number in ENDING for number in numbers):
            self._ending = True
        elif signal.SIGTSTP in numbers:
            self._suspend(signals)
        elif signal.SIGCONT in numbers:
            self._retake(signals)
        elif signal.SIGWINCH in numbers:
            self._terminal.forget()

    def _suspend(self, signals: Signals) -> None:
        """Stop as Ctrl-Z asks, those who are steered first; go on where the person comes back."""
        self._tell(lambda: [self._pilot.stop()])
        self._terminal.suspend()
        self._retake(signals)

    def _retake(self, signals: Signals) -> None:
        """Take the terminal when the process is continued, unless it is to end."""
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

    def _tell(self, act: Callable[[], Sequence[Message | None]]) -> None:
        """Let the pilot act and tell what he says, unless the end has come: nothing is said after the last stop."""
        with self._lock:
            if not self._ending:
                self._publish(act())

    def _publish(self, messages: Sequence[Message | None]) -> None:
        for message in messages:
            if isinstance(message, Say):
                self._say(message)
            elif message is not None:
                self._steer(message)

    def _outlets(self, target: Target) -> dict[str, _Outlet]:
        return {"leader": self._leader} if target is Target.LEADER else self._vehicles

    def _say(self, message: Say) -> None:
        outlets = self._outlets(message.target)
        deaf = [name for name, outlet in outlets.items() if not outlet.listened]
        for outlet in outlets.values():
            outlet.say(message.text)
        if deaf:
            more = f" and {len(deaf) - 1} more" if len(deaf) > 1 else ""
            self._pilot.note += f"; {deaf[0]}{more} took nothing: no communication node"
            if message.target is Target.LEADER:
                self._pilot.note = f"{message.text}: no leader is there, start leader.py"

    def _steer(self, message: Steer) -> None:
        twist = Twist()
        twist.linear.x, twist.linear.y, twist.linear.z = message.forward, message.left, message.up
        twist.angular.z = message.turn
        for outlet in self._outlets(message.target).values():
            outlet.steer(twist)

    def _stop_for_good(self) -> None:
        """Stop those who are steered; called in a thread of rospy's when that ends the node."""
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
        self._said.clear()

    def _page(self, rows: int) -> list[Sight]:
        """Return the vehicles on the page."""
        names = list(self._vehicles)[self._first : self._first + rows]
        return self._lookout.sights({name: self._vehicles[name].listened for name in names})

    def _show(self) -> None:
        shown = self._layout()
        page = self._page(shown.rows)
        said = self._notes.texts[-1] if self._notes.texts else self._pilot.note
        note = "; ".join(filter(None, [self._lookout.trouble, said]))
        if not self._terminal.redraws:
            self._show_lines(page, note)
            return
        view = View(
            fleet=self._fleet(),
            mode=self._request.mode,
            target=self._pilot.target,
            leader_listens=self._leader.listened,
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

    def _show_lines(self, page: Sequence[Sight], note: str) -> None:
        """Write what has changed: speeds, notes, and vehicles whose mode, arming or trouble is another."""
        speeds = self._pilot.speeds
        if self._changed("speeds", speeds):
            self._write("  ".join(f"{axis} {value:+.2f}" for axis, value in zip(AXES, speeds, strict=True)))
        if self._changed("note", note) and note:
            self._write(note)
        for sight in page:
            if sight.silence is None and time.monotonic() - self._began < SILENT:
                continue  # it may be heard of in a moment
            if self._changed(sight.name, (sight.armed, sight.mode, sight.listened, bool(sight.trouble))):
                self._write(sentence(sight))

    def _changed(self, what: str, value: object) -> bool:
        changed = self._said.get(what) != value
        self._said[what] = value
        return changed

    def _write(self, *lines: str) -> None:
        for line in lines:
            self._terminal.write_line(line)


def _keyboard(arguments: Sequence[str], terminal: Terminal) -> None:
    """Run the program with its arguments.

    Raises:
        ArgumentError: they, or ~patterns, are not allowed.
        TerminalGoneError: the terminal has been closed.
    """
    request = parse_arguments(arguments, fleet_of(rospy.get_param("/xtdrone/fleet", None)))
    _allow_many_files()
    rospy.init_node(NAME, disable_signals=True, disable_rostime=True)
    try:
        Keyboard(request, Pilot(_patterns(request.formation)), terminal).run()
    finally:
        # In a thread: a master that does not answer does not hold the person up.
        leaving = threading.Thread(target=rospy.signal_shutdown, args=("the keyboard has ended",), daemon=True)
        leaving.start()
        leaving.join(_LEAVE_LIMIT)


def _patterns(count: int) -> dict[str, str]:
    """Return the patterns of the digits for so many vehicles; one alone has none."""
    file = str(rospy.get_param("~patterns", ""))
    if count == 1:
        return {}
    try:
        return digits(Patterns(count, file or None).names)
    except PatternError as error:
        raise ArgumentError(str(error)) from error


def _allow_many_files() -> None:
    """Allow as many files as the system lets us: each vehicle has several connections."""
    _, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))


def main() -> int:
    """Run the program with ``sys.argv``; return the exit status.

    0 after Ctrl-C or another signal, 1 without a master or when the terminal is closed, 2 for wrong arguments and where
    standard input is no terminal.
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
