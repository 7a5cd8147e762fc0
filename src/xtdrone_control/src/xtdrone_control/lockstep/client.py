"""The node's half of the lockstep: what a node uses in rospy's place.

A node that takes part (a *participant*) has its time from the simulator's TICK, runs its callbacks in its own thread in
a fixed order (in `start` and `Rate.sleep`), and tells the simulator with DONE how many messages it has sent. Without a
simulator the same calls are rospy.Rate and plain topics, with the callbacks in the same place.

In a participant never call `rospy.sleep` or `rospy.Rate` in the main thread: time stands still until the node says that
it is done. Use `Rate`, `sleep` or `spin` of this module.
"""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import sys
import threading
import time
import traceback
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any
from urllib.parse import urlparse

import rosgraph
import rosgraph.names
import rospy
import rospy.core
import rospy.impl.simtime
import rospy.rostime
import rospy.topics
from rospy.impl.registration import Registration

from xtdrone_control.log_output import survive_full_disk

from .names import future_name
from .protocol import (
    ALIVE_FRAME,
    DIGEST_PERIOD_US,
    NEEDS_TIME_FRAME,
    VERSION,
    Barrier,
    Digest,
    FrameReader,
    Kind,
    ProtocolError,
    Schedule,
    pack_barrier,
    pack_object,
    printable,
    process_namespace,
    same_machine,
    tune,
    unpack_barrier,
    unpack_object,
)
from .reader import Inbox, Reader
from .topics import BufferingSubscriber, CountingPublisher, Outlet, acquire_publisher, acquire_subscriber

Serve = Callable[[Mapping[int, int] | None, float], Mapping[int, int]]

WAIT_LIMIT = 60.0
"""Wall seconds that a participant waits for a message that was counted while its publisher's connection is open."""
WAIT_REPORT = 5.0
"""Wall seconds after which it says that it waits."""
DATAGRAM_LIMIT = 10.0
"""Wall seconds that it waits for a counted datagram from its own machine, where none gets lost on the way."""
REMOTE_DATAGRAM_LIMIT = 0.25
"""Wall seconds that it waits for a counted datagram from another machine, where some do."""
CONNECT_LIMIT = 10.0
"""Wall seconds for the simulator to answer at its address."""
NAME_LIMIT = 3.0
"""Wall seconds for a participant that has the node's name to go."""
ALIVE_PERIOD = 1.0
"""Wall seconds between keep-alives."""
SLICE = 0.1
"""Longest single wait in wall seconds, so that a shutdown is noticed."""
LONGEST_REASON = 500
"""Characters of the simulator's last words that are logged."""

URI_PARAM = "/lockstep/uri"
WAIT_PARAM = "/lockstep/wait"
PRIVATE_PARAM = "~lockstep"


class _Node:
    """What this process has declared; there is one node in a process."""

    def __init__(self) -> None:
        self.rate = 0.0
        self.taking_part = False
        self.started = False
        self.publishers: dict[str, CountingPublisher] = {}
        self.subscribers: list[Subscriber] = []
        self.reader = Reader()
        self.dirty: deque[Outlet] = deque()
        self.digests: dict[str, Digest] | None = None
        self.time_us = 0
        self.reset_hooks: list[Callable[[], None]] = []
        self.reservation: Client | None = None
        self.crash = ""
        self.exit_status = 0
        self.client: Client | None = None
        self.host: Host | None = None
        self.udp_ports: list[int] = []
        self.serve: Serve | None = None
        self.datagrams: dict[int, int] = {}
        self.datagrams_missed: dict[int, int] = {}

    def outlet_made(self, outlet: Outlet) -> None:
        """Passes a new connection on to whoever counts."""
        counter = self.client or self.host
        if counter is not None:
            counter.outlet_made(outlet)

    def outlet_lost(self, outlet: Outlet) -> None:
        """Passes a closed connection on to whoever counts."""
        counter = self.client or self.host
        if counter is not None:
            counter.outlet_lost(outlet)

    def outlets(self) -> list[Outlet]:
        """Returns the connections that there are now."""
        return [outlet for publisher in self.publishers.values() for outlet in list(publisher.outlets.values())]

    def declaration(self) -> dict[str, list[list[str]]]:
        """Returns the topics as JOIN and DECLARE carry them."""
        subscribed = {entry.resolved_name: entry.type for entry in self.subscribers}
        return {
            "publications": [[name, impl.type] for name, impl in self.publishers.items()],
            "subscriptions": [[name, kind] for name, kind in subscribed.items()],
        }

    def topics_changed(self) -> None:
        """Tells the server of topics that came or went after the start."""
        if self.client is not None:
            self.client.declare(self.declaration())
        if self.host is not None:
            self.host.declare(self.declaration())

    def subscriptions(self) -> dict[str, BufferingSubscriber]:
        """Returns the receiving ends by topic, in the order of declaration."""
        return {entry.resolved_name: entry.impl for entry in self.subscribers}


_node = _Node()


# ---- declaring ----


class _Arrivals(rospy.SubscribeListener):
    """Tells when a subscriber has come.

    Attributes:
        come: Set with each.
    """

    def __init__(self) -> None:
        """Waits for the first."""
        super().__init__()
        self.come = threading.Event()

    def peer_subscribe(self, topic_name: str, topic_publish: Any, peer_publish: Any) -> None:
        """Called by rospy for each new connection."""
        self.come.set()


class Publisher(rospy.Publisher):
    """A publisher that counts; `publish` returns when the bytes are in the kernel.

    A subscriber that stalls does not stall the node: what it cannot take is kept and sent by a thread, and above
    `queue_size` messages the oldest are dropped, unless it is a participant.
    """

    def __init__(
        self,
        name: str,
        data_class: type[rospy.Message],
        latch: bool = False,
        queue_size: int = 100,
        subscriber_listener: rospy.SubscribeListener | None = None,
    ) -> None:
        """Advertises a topic.

        Args:
            name: Topic name, resolved as usual.
            data_class: Message type.
            latch: True to send the last message to every new subscriber.
            queue_size: Messages kept for a stalled subscriber that is no participant.
            subscriber_listener: As for rospy.Publisher.

        Raises:
            ROSException: The topic is advertised in this process by a plain rospy.Publisher.
        """
        impl = acquire_publisher(name, data_class, latch, _node)
        super().__init__(name, data_class, subscriber_listener=subscriber_listener, latch=latch, queue_size=queue_size)
        if _node.publishers.get(self.resolved_name) is not impl:
            _node.publishers[self.resolved_name] = impl
            _node.topics_changed()

    def get_num_connections(self) -> int:
        """Returns how many listen; digests count as one, so that they do not depend on who else does."""
        return int(super().get_num_connections()) + (_node.digests is not None)

    def wait_for_subscriber(self, node: str, timeout: float) -> bool:
        """Waits until a node has subscribed: one that takes no part in the lockstep would miss what comes first.

        Args:
            node: Name of the node, resolved as usual.
            timeout: Wall time, s.

        Returns:
            Whether it has subscribed.
        """
        name = rospy.resolve_name(node)
        arrivals = _Arrivals()
        self.impl.add_subscriber_listener(arrivals)
        end = time.monotonic() + timeout
        while not any(connection.endpoint_id == name for connection in self.impl.connections):
            left = end - time.monotonic()
            if left <= 0.0 or not arrivals.come.wait(left):
                return False
            arrivals.come.clear()
        return True

    def unregister(self) -> None:
        """Takes the topic back."""
        name, impl = self.resolved_name, self.impl
        super().unregister()
        if impl is not None and impl.ref_count == 0:
            _node.publishers.pop(name, None)
            _node.topics_changed()


class _Unheard:
    """A ledger that nobody reads."""

    def __init__(self) -> None:
        self.dirty: deque[Outlet] = deque()
        self.digests: dict[str, Digest] | None = None
        self.time_us = 0

    def outlet_made(self, outlet: Outlet) -> None:
        """Nobody counts."""

    def outlet_lost(self, outlet: Outlet) -> None:
        """Nobody counts."""


class UncountedPublisher(rospy.Publisher):
    """A publisher that sends as `Publisher` does, and for whose messages nobody waits: /clock's, say.

    rospy's own hands each message with a queue size to another thread, which costs several times as much.
    """

    def __init__(self, name: str, data_class: type[rospy.Message], queue_size: int = 100) -> None:
        """Advertises a topic.

        Args:
            name: Topic name, resolved as usual.
            data_class: Message type.
            queue_size: Messages kept for a subscriber that stalls.

        Raises:
            ROSException: The topic is advertised in this process by a plain rospy.Publisher.
        """
        acquire_publisher(name, data_class, False, _Unheard())
        super().__init__(name, data_class, queue_size=queue_size)


class Subscriber(rospy.topics.Topic):
    """A subscriber whose callback runs in `Rate.sleep`, in the thread that calls it."""

    def __init__(
        self,
        name: str,
        data_class: type[rospy.Message],
        callback: Callable[..., None] | None = None,
        callback_args: Any = None,
        queue_size: int | None = None,
        buff_size: int = rospy.topics.DEFAULT_BUFF_SIZE,
    ) -> None:
        """Subscribes to a topic.

        Args:
            name: Topic name, resolved as usual.
            data_class: Message type.
            callback: Called with each message, and with `callback_args` if those are given.
            callback_args: Second argument of the callback.
            queue_size: Of messages from publishers that are no participants, at most so many (the newest) are
                dispatched at a time; what participants send is never dropped.
            buff_size: Receive buffer in bytes.

        Raises:
            ROSException: The topic has a plain rospy.Subscriber in this process, or the queue size is not positive.
        """
        impl = acquire_subscriber(name, data_class, _node.reader)
        super().__init__(name, data_class, Registration.SUB)
        impl.set_queue_size(queue_size)
        if buff_size != rospy.topics.DEFAULT_BUFF_SIZE:
            impl.set_buff_size(buff_size)
        self.callback = callback
        self.callback_args = callback_args
        self.pending = impl.latches()
        known = any(entry.impl is impl for entry in _node.subscribers)
        _node.subscribers.append(self)
        if not known:
            _node.topics_changed()

    def invoke(self, message: rospy.Message) -> None:
        """Runs the callback; an exception in it is logged and does not end the node, as with rospy."""
        if self.callback is None:
            return
        try:
            if self.callback_args is None:
                self.callback(message)
            else:
                self.callback(message, self.callback_args)
        except Exception:
            rospy.logerr(f"bad callback for {self.resolved_name}: {traceback.format_exc()}")

    def unregister(self) -> None:
        """Ends the subscription."""
        if self not in _node.subscribers:
            return
        _node.subscribers.remove(self)
        self.callback = None
        super().unregister()
        _node.topics_changed()


def init_node(name: str, rate: float = 30.0, **options: Any) -> None:
    """Initialises the ROS node and decides whether it takes part in a simulator's lockstep.

    It does if `/lockstep/uri` is set, or if `/lockstep/wait` is true (a launch file says so when it starts a simulator
    along with the node), and `~lockstep` is not false.

    Args:
        name: Node name.
        rate: How often the node is due, in Hz of simulation time; above 0 and at most 250.
        options: Passed to rospy.init_node.

    Raises:
        ValueError: The rate is outside its range.
        ROSInitException: The master or the time cannot be reached, or another participant has this name.
    """
    Schedule(rate)
    if not rosgraph.is_master_online():  # rospy would wait for one without end
        advice = "start one (roscore, roslaunch) or set ROS_MASTER_URI"
        raise rospy.ROSInitException(f"no ROS master answers at {rosgraph.get_master_uri()}; {advice}")
    if not options.get("anonymous"):
        _node.reservation = _reserve(future_name(name, options.get("argv")))
    rospy.init_node(name, disable_rostime=True, **options)
    survive_full_disk()
    if not options.get("disable_signals"):
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, _on_signal)
    _notice_crash()
    _node.rate = rate
    if rospy.get_param(PRIVATE_PARAM, True):
        _node.taking_part = bool(rospy.get_param(URI_PARAM, "") or rospy.get_param(WAIT_PARAM, False))
    if _node.taking_part:
        # Time comes from TICK. The subscription to /clock that rospy makes would bring it late and in its own thread.
        rospy.rostime._set_rostime(rospy.Time(0, 0))
        _node.reader.activate()
    elif not rospy.impl.simtime.init_simtime():
        raise rospy.ROSInitException("the time could not be initialised; is the master running?")


def _on_signal(number: int, _: Any) -> None:
    # rospy's handler takes the node's topics back on top of whatever the main thread does. If that was a log call,
    # which asks the master for a parameter, it waits for ever for the lock of the master's proxy. A thread does not.
    threading.Thread(target=rospy.core._ros_signal, args=(number, None), name="lockstep shutdown").start()


def _notice_crash() -> None:
    """Has an exception that ends the program noted, so that the simulator hears of it."""
    previous = sys.excepthook

    def note(kind: type[BaseException], error: BaseException, trace: Any) -> None:
        _node.crash = f"{kind.__name__}: {error}" if str(error) else kind.__name__
        previous(kind, error, trace)

    sys.excepthook = note


def exit_status() -> int:
    """Returns with what status the program should end: 1 if the simulator has dropped the node or failed, else 0."""
    return _node.exit_status


def add_reset_hook(hook: Callable[[], None]) -> None:
    """Has a function called when simulation time has gone back, as after /gazebo/reset_simulation.

    Args:
        hook: Called in the node's own thread in `Rate.sleep`, with the new time, before any callback of that turn.
    """
    _node.reset_hooks.append(hook)


def is_active() -> bool:
    """Says whether this node takes part in a simulator's lockstep."""
    return _node.taking_part


def declare_udp(ports: Iterable[int], serve: Serve) -> None:
    """Declares, before `start`, that the node exchanges datagrams with the simulator.

    Args:
        ports: Local ports on which it receives them.
        serve: Called in `Rate.sleep` before any topic callback, as serve(expected, timeout). It serves the sockets
            until each port in `expected` has received that many datagrams in all and leaves what is beyond, at most
            `timeout` wall seconds; with `expected` None (no lockstep) it serves them for that time. It returns how
            many datagrams each port has received in all. The sockets' receive buffers must hold what comes in a period.
    """
    _node.udp_ports = list(ports)
    _node.serve = serve


def datagrams_sent(port: int, count: int) -> None:
    """Notes how many datagrams the node has sent to one of the simulator's ports.

    Args:
        port: The simulator's port.
        count: Cumulative number.
    """
    _node.datagrams[port] = count


@contextlib.contextmanager
def needs_time() -> Iterator[None]:
    """Tells the simulator, for as long as it lasts, that this node waits for what comes only when time goes on.

    An autopilot that is not the simulator's answers only then. The simulator, which else holds time for a participant
    whose turn waits for this node, lets it flow. For any thread; without lockstep it does nothing.
    """
    client = _node.client
    if client is None:
        yield
        return
    client.wait_for_time(1)
    try:
        yield
    finally:
        client.wait_for_time(-1)


def start() -> None:
    """Joins the simulator, when there is one, and waits for the first tick; all topics should be declared by now.

    Callbacks of what came before that tick (latched messages, say) run before it returns.

    Raises:
        ROSInitException: The simulator does not answer or refuses; the text says why.
        ROSInterruptException: The node was shut down meanwhile.
    """
    if _node.started:
        raise rospy.ROSInitException("lockstep.start() was called a second time")
    if not rospy.core.is_initialized():
        raise rospy.ROSInitException("lockstep.start() needs lockstep.init_node() first")
    _node.started = True
    if not _node.taking_part:
        return
    client = _join()
    rospy.loginfo(f"in lockstep with the simulator at {client.uri}, {_node.rate:g} Hz")
    client.begin()
    _dispatch()


# ---- running ----


class Rate:
    """Ends the node's turn and waits for the next; the callbacks run in `sleep`."""

    def __init__(self, hz: float | None = None) -> None:
        """Makes it.

        Args:
            hz: None or the rate given to `init_node`; a node has one.

        Raises:
            ValueError: It is another rate.
        """
        if hz is not None and hz != _node.rate:
            raise ValueError(f"lockstep.Rate({hz!r}): the node was initialised with rate={_node.rate!r}")
        # With reset, rospy does not raise when /clock goes back.
        self._rate = None if _node.taking_part else rospy.Rate(_node.rate, reset=True)

    def sleep(self) -> None:
        """Says that this turn is done, waits for the next and runs the callbacks of what has come.

        Raises:
            ROSInterruptException: The node is shut down, or the simulator is gone.
        """
        if self._rate is None:
            if _node.client is None:
                raise rospy.ROSInitException("lockstep.Rate.sleep() needs lockstep.start() first")
            _node.client.turn()
        else:
            self._sleep_free(self._rate)
        _dispatch()

    @staticmethod
    def _sleep_free(rate: rospy.Rate) -> None:
        serve, began = _node.serve, rospy.Time.now()
        if serve is None:
            rate.sleep()
        elif rospy.rostime.is_wallclock():
            while (remaining := rate.remaining().to_sec()) > 0.0 and not rospy.is_shutdown():
                serve(None, min(remaining, SLICE))
            rate.sleep()
        else:
            # /clock says when the turn is, and wakes nobody who waits for datagrams.
            rate.sleep()
            serve(None, 0.0)
        # A wall clock that is set right, as on a real vehicle, is no reset.
        if rospy.Time.now() < began and not rospy.rostime.is_wallclock():
            _run_reset_hooks()


def sleep(seconds: float) -> None:
    """Lets simulation time pass, turn by turn; callbacks run meanwhile.

    Args:
        seconds: At least so long, in ROS time; it returns early if the time is set back.

    Raises:
        ROSInterruptException: The node is shut down, or the simulator is gone.
    """
    rate, now = Rate(), rospy.Time.now()
    end = now + rospy.Duration.from_sec(seconds)
    while now < end:
        rate.sleep()
        before, now = now, rospy.Time.now()
        if now < before:
            return


def spin(step: Callable[[], None] | None = None) -> None:
    """Calls `step` once a turn until the node is shut down.

    Args:
        step: The node's work; None for a node that works in callbacks only.
    """
    rate = Rate()
    with contextlib.suppress(rospy.ROSInterruptException):
        while not rospy.is_shutdown():
            if step is not None:
                step()
            rate.sleep()


def _run_reset_hooks() -> None:
    """Tells the node that time has gone back; an exception is logged, as in a callback."""
    for hook in _node.reset_hooks:
        try:
            hook()
        except Exception:
            rospy.logerr(f"bad reset hook: {traceback.format_exc()}")


def _dispatch() -> None:
    """Runs the callbacks: subscriptions as declared, within one by publisher's name, then as sent."""
    ready: dict[int, list[Any]] = {}
    for entry in list(_node.subscribers):
        impl = entry.impl
        if impl is None:  # a callback has just unregistered it
            continue
        messages = ready.get(id(impl))
        if messages is None:
            messages = ready[id(impl)] = impl.ready()
        if entry.pending:
            messages = [*entry.pending, *messages]
            entry.pending = []
        for message in messages:
            entry.invoke(message)


# ---- what has been sent to this process ----


class Deliveries:
    """The connections from participants to this process's subscribers, and how much must have come over each."""

    def __init__(self, node: _Node) -> None:
        """Starts with none.

        Args:
            node: Has the subscribers and what reads their connections.
        """
        self._node = node
        self._inboxes: dict[int, Inbox] = {}
        self._topics: dict[int, str] = {}
        self._lost: list[int] = []
        self._void: list[tuple[int, int]] = []

    def note(self, news: Mapping[str, Any]) -> None:
        """Takes the news of a PEER frame: connections made and lost, and what is void because time has gone back."""
        ends = self._node.subscriptions() if news["made"] else {}
        for channel, topic, publisher, port in news["made"]:
            end = ends.get(topic)
            if end is None:  # a plain rospy.Subscriber of this process (a tf listener, say): its threads read it
                continue
            inbox = end.inbox(publisher, port)
            self._node.reader.count(inbox)
            self._inboxes[channel] = inbox
            self._topics[channel] = topic
        self._lost += [channel for channel in news["lost"] if channel in self._inboxes]
        self._void += [(channel, count) for channel, count in news.get("void", ()) if channel in self._inboxes]

    def fetch(self, counts: Mapping[int, int]) -> None:
        """Reads what must have come by now, waits for what has not, and forgets what is void or over.

        Args:
            counts: Channel to the number of messages sent over it in all, where that has changed.

        Raises:
            ROSInterruptException: The node is shut down meanwhile.
        """
        awaited = {}
        for channel, count in counts.items():
            inbox = self._inboxes.get(channel)
            if inbox is None:
                continue
            inbox.target = count
            if not inbox.fetch():
                awaited[channel] = inbox
        if awaited:
            self._await_messages(awaited)
        for channel, count in self._void:
            self._inboxes[channel].discard(count)
        self._void.clear()
        for channel in self._lost:
            self._inboxes.pop(channel).lost = True
            del self._topics[channel]
        self._lost.clear()

    def _await_messages(self, awaited: Mapping[int, Inbox]) -> None:
        reader, began = self._node.reader, time.monotonic()
        lacking = reader.await_messages(awaited.values(), began + WAIT_REPORT)
        if lacking and not rospy.core.is_shutdown_requested():
            names = sorted({f"{self._topics[channel]} of {inbox.publisher}" for channel, inbox in awaited.items()})
            rospy.logwarn(f"waiting for messages that were sent: {', '.join(names)}")
            lacking = reader.await_messages(awaited.values(), began + WAIT_LIMIT)
        if rospy.core.is_shutdown_requested():
            raise rospy.ROSInterruptException("ROS shutdown request")
        for channel, inbox in awaited.items():
            if inbox not in lacking:
                continue
            short = inbox.lacking()
            inbox.given_up += short
            rospy.logwarn(
                f"{short} messages on {self._topics[channel]} from {inbox.publisher} did not arrive within "
                f"{WAIT_LIMIT:g} s: going on without"
            )


# ---- the connection to the simulator ----


class _RefusedError(Exception):
    """The server does not take this node."""

    def __init__(self, code: str, reason: str) -> None:
        super().__init__(reason)
        self.code = code


def _reserve(name: str) -> Client | None:
    """Reserves the node's name with a running simulator.

    It must come before the node registers with the master, which would end the node that has this name now.

    Raises:
        ROSInitException: Another participant has it, or the simulator speaks another version.
    """
    master = rosgraph.Master(name)
    private = rosgraph.names.ns_join(name, PRIVATE_PARAM[1:])
    uri = master.getParam(URI_PARAM) if master.hasParam(URI_PARAM) else ""
    if not uri or (master.hasParam(private) and not master.getParam(private)):
        return None
    began = time.monotonic()
    while True:
        client = Client(uri)
        try:
            client.reserve(name)
            return client
        except (OSError, ProtocolError):
            client.close()
            return None  # `start` finds out, and has patience
        except _RefusedError as error:
            client.close()
            # The one that has it may be on its way out.
            if error.code != "taken" or time.monotonic() - began > NAME_LIMIT:
                raise rospy.ROSInitException(f"cannot join the simulator at {uri} ({URI_PARAM}): {error}") from error
        try:
            time.sleep(SLICE)  # the simulator tells nobody of names that become free
        except KeyboardInterrupt:  # rospy, which would handle the signal, has not begun
            raise SystemExit(128 + signal.SIGINT) from None


def _join() -> Client:
    """Finds the simulator and joins it, with patience for one that is starting and for a name that is just left."""
    client, _node.reservation = _node.reservation, None
    if client is not None:
        try:
            client.join(_node)
            return client
        except (OSError, _RefusedError, ProtocolError) as error:
            rospy.logdebug(f"the simulator at {client.uri} took the name but not the node: {error}; trying again")
            client.close()
    asked = time.monotonic()
    answered = asked
    while not rospy.is_shutdown():
        uri = rospy.get_param(URI_PARAM, "")
        if not uri:
            if time.monotonic() - asked > CONNECT_LIMIT:
                rospy.loginfo(f"waiting for a simulator ({URI_PARAM} is not set yet)")
                asked = time.monotonic()
            answered = time.monotonic()
        else:
            client = Client(uri)
            try:
                client.join(_node)
                return client
            except (OSError, _RefusedError, ProtocolError) as error:
                client.close()
                patient = not isinstance(error, _RefusedError) or error.code == "taken"
                if not patient or time.monotonic() - answered > CONNECT_LIMIT:
                    raise rospy.ROSInitException(
                        f"cannot join the simulator at {uri} ({URI_PARAM}): {error}. If there is no simulator, "
                        f"delete that parameter or set {PRIVATE_PARAM} to false."
                    ) from error
        # The parameter server has no event for a node that waits for a parameter; a simulator's start is not urgent.
        _node.reader.wait_whole(2 * SLICE)
    raise rospy.ROSInterruptException("shut down while waiting for the simulator")


class Client:
    """A participant's connection to the simulator.

    Attributes:
        uri: The simulator's address.
        tick: Number of the present tick, 0 before the first.
        time_us: The present tick's time in microseconds.
    """

    def __init__(self, uri: str) -> None:
        """Keeps the address; `join` connects."""
        self.uri = uri
        self.tick = 0
        self.time_us = 0
        self._node = _node
        self._sock: socket.socket | None = None
        self._frame_reader = FrameReader()
        self._frames: deque[tuple[int, bytes]] = deque()
        self._send_lock = threading.Lock()
        self._waiters = 0  # how many threads wait for what comes only when time goes on
        self._waiters_lock = threading.Lock()
        self._joined = False
        self._numbers = 0
        self._outlets: dict[int, Outlet] = {}
        self._deliveries = Deliveries(_node)
        self._told: dict[int, int] = {}
        self._reader = _node.reader
        self._ended = threading.Event()
        self._remote = False
        self._digested = -1
        self._gone_back = False

    # ---- joining and leaving ----

    def join(self, node: _Node) -> None:
        """Connects and joins; announces the topic connections that there are already.

        Raises:
            OSError: No connection.
            ProtocolError: The URI or the answer is none of a lockstep server.
        """
        content = {
            **self._introduction(rospy.get_name()),
            "rate": node.rate,
            "udp_ports": node.udp_ports,
            **node.declaration(),
        }
        welcome = self._ask(Kind.JOIN, content)
        if welcome.get("digest"):
            node.digests = {}
        sock = self._connected()
        sock.settimeout(None)
        self._reader.watch(sock.fileno(), self._readable)
        node.client = self
        # From here on rospy's threads announce new connections themselves; those made before are announced now.
        with self._send_lock:
            self._joined = True
            self._announce(node.outlets())
        declared = {**content, **node.declaration()}
        if declared != content:
            self.declare(node.declaration())
        rospy.core.add_client_shutdown_hook(self._on_shutdown)
        thread = threading.Thread(target=self._keep_alive, name="lockstep keep-alive", daemon=True)
        # pydevd (the debugger of PyCharm and VS Code) stops every thread at a breakpoint, but none with these marks.
        thread.__dict__.update(pydev_do_not_trace=True, is_pydev_daemon_thread=True)
        thread.start()

    def reserve(self, name: str) -> None:
        """Connects and reserves a name for the node that is to join over this connection.

        Args:
            name: Resolved name.

        Raises:
            OSError: No connection.
            ProtocolError: The URI or the answer is none of a lockstep server.
        """
        self._ask(Kind.RESERVE, self._introduction(name))

    @staticmethod
    def _introduction(name: str) -> dict[str, Any]:
        return {"version": VERSION, "name": name, "pid": os.getpid(), "host": process_namespace()}

    def _connect(self) -> socket.socket:
        address = urlparse(self.uri)
        if address.scheme != "tcp" or not address.hostname or not address.port:
            raise ProtocolError(f"{URI_PARAM} is {self.uri!r}, it must be tcp://host:port")
        sock = socket.create_connection((address.hostname, address.port), timeout=CONNECT_LIMIT)
        tune(sock)
        self._remote = not same_machine(sock.getpeername()[0], sock.getsockname()[0])
        return sock

    def _ask(self, kind: Kind, content: Mapping[str, Any]) -> dict[str, Any]:
        """Sends RESERVE or JOIN, over a new connection if there is none, and returns WELCOME's content."""
        if self._sock is None:
            self._sock = self._connect()
        self._sock.settimeout(CONNECT_LIMIT)
        self._sock.sendall(pack_object(kind, content))
        while not self._frames:
            self._read()
        answer, payload = self._frames.popleft()
        if answer == Kind.REFUSED:
            refusal = unpack_object(payload)
            raise _RefusedError(str(refusal.get("code")), _reason(refusal))
        if answer != Kind.WELCOME:
            raise ProtocolError(f"the answer to {kind.name} was a frame of type {answer}")
        return unpack_object(payload)

    def close(self) -> None:
        """Closes the connection."""
        self._joined = False
        self._ended.set()
        if self._sock is not None:
            self._sock.close()

    def _on_shutdown(self) -> None:
        # This may run in a signal handler on top of the main thread, which may hold the lock: then without a farewell.
        if self._send_lock.acquire(timeout=0.2):
            try:
                if self._joined and self._sock is not None:
                    self._joined = False
                    crash = self._node.crash
                    reason = f"it has crashed: {printable(crash)}" if crash else "shut down"
                    leave = pack_object(Kind.LEAVE, {"reason": reason, "failed": bool(crash)})
                    frames = self._digest_frame() + self._done_frame() + leave
                    with contextlib.suppress(OSError):
                        self._sock.sendall(frames)
            finally:
                self._send_lock.release()
        # Nobody takes the lock from here on: rospy closes the topics next, perhaps in this same signal handler.
        self._joined = False
        self._ended.set()
        self._reader.wake()

    def wait_for_time(self, waiters: int) -> None:
        """Tells the server when the first begins to wait for what comes only when time goes on, and the last has it.

        Args:
            waiters: 1 for one more, -1 for one less.
        """
        with self._waiters_lock:
            before, self._waiters = self._waiters, self._waiters + waiters
            if bool(before) != bool(self._waiters):
                with contextlib.suppress(OSError):
                    self._send(NEEDS_TIME_FRAME if self._waiters else ALIVE_FRAME)

    def _keep_alive(self) -> None:
        """Tells the server that the process lives, also while the main thread stands at a breakpoint."""
        while not self._ended.wait(ALIVE_PERIOD):
            try:
                self._send(NEEDS_TIME_FRAME if self._waiters else ALIVE_FRAME)
            except OSError:
                return

    # ---- publishers ----

    def outlet_made(self, outlet: Outlet) -> None:
        """A subscriber has connected: announces the channel."""
        if not self._joined:
            return
        with self._send_lock:
            if self._joined:
                self._announce([outlet])

    def outlet_lost(self, outlet: Outlet) -> None:
        """A subscriber's connection is closed."""
        if not self._joined:
            return
        with self._send_lock:
            self._outlets.pop(outlet.number, None)
            if self._joined and outlet.number and self._sock is not None:
                with contextlib.suppress(OSError):
                    self._sock.sendall(pack_object(Kind.PEER, {"made": [], "lost": [outlet.number]}))

    def _announce(self, outlets: list[Outlet]) -> None:
        made = []
        for outlet in outlets:
            if outlet.number or outlet.closed:
                continue
            self._numbers += 1
            outlet.number = self._numbers
            self._outlets[outlet.number] = outlet
            made.append([outlet.number, outlet.topic, outlet.peer, outlet.port, outlet.count])
        if made and self._sock is not None:
            # If the simulator is gone, the main thread finds out.
            with contextlib.suppress(OSError):
                self._sock.sendall(pack_object(Kind.PEER, {"made": made, "lost": []}))

    def declare(self, declaration: Mapping[str, Any]) -> None:
        """Tells the server of the topics that there are now."""
        if self._joined:
            with contextlib.suppress(OSError):
                self._send(pack_object(Kind.DECLARE, declaration))

    # ---- turns ----

    def begin(self) -> None:
        """Waits for the first tick.

        Raises:
            ROSInterruptException: The node is shut down, or the simulator is gone.
        """
        self._enter(self._await_tick())

    def turn(self) -> None:
        """Sends DONE, waits for TICK and for all that must have come by then.

        Raises:
            ROSInterruptException: The node is shut down, or the simulator is gone.
        """
        failure = ""
        with self._send_lock:
            if rospy.core.is_shutdown_requested() or self._sock is None:
                raise rospy.ROSInterruptException("ROS shutdown request")
            try:
                self._sock.sendall(self._due_digest() + self._done_frame())
            except OSError as error:
                failure = str(error)
        if failure:
            self._simulator_gone(failure)
        self._enter(self._await_tick())

    def _done_frame(self) -> bytes:
        counts = {}
        dirty = self._node.dirty
        while dirty:
            outlet = dirty.popleft()
            # In this order: a message sent by another thread just now is either in the count or marks it dirty again.
            outlet.dirty = False
            if outlet.number:
                counts[outlet.number] = outlet.count
        ports = {port: count for port, count in self._node.datagrams.items() if self._told.get(port) != count}
        self._told.update(ports)
        return pack_barrier(Kind.DONE, self.tick, self.time_us, counts, ports)

    def _due_digest(self) -> bytes:
        """Returns a DIGEST frame if it is time for one, else nothing."""
        period = self.time_us // DIGEST_PERIOD_US
        if self._node.digests is None or period == self._digested:
            return b""
        self._digested = period
        return self._digest_frame()

    def _digest_frame(self) -> bytes:
        if self._node.digests is None:
            return b""
        topics = {topic: digest.state() for topic, digest in list(self._node.digests.items())}  # threads add to it
        return pack_object(Kind.DIGEST, {"time_us": self.time_us, "topics": topics})

    def _await_tick(self) -> Barrier:
        while True:
            while self._frames:
                kind, payload = self._frames.popleft()
                if kind == Kind.TICK:
                    return unpack_barrier(payload)
                if kind == Kind.PEER:
                    self._peers(unpack_object(payload))
                elif kind in (Kind.REFUSED, Kind.LEAVE):
                    self._last_word(kind, payload)
            self._reader.wait(1.0)
            if rospy.core.is_shutdown_requested():
                raise rospy.ROSInterruptException("ROS shutdown request")

    def _enter(self, tick: Barrier) -> None:
        """Begins the turn that a TICK has opened."""
        gone_back, self._gone_back = self._gone_back or tick.time_us < self.time_us, False
        self.tick, self.time_us, self._node.time_us = tick.tick, tick.time_us, tick.time_us
        seconds, micros = divmod(tick.time_us, 1_000_000)
        rospy.rostime._set_rostime(rospy.Time(seconds, micros * 1000))
        if gone_back:
            _run_reset_hooks()
        if self._node.serve is not None and tick.datagrams:
            self._serve_datagrams(self._node.serve, tick.datagrams)
        self._deliveries.fetch(tick.channels)

    def _serve_datagrams(self, serve: Serve, counts: Mapping[int, int]) -> None:
        missed = self._node.datagrams_missed
        expected = {port: count - missed.get(port, 0) for port, count in counts.items()}
        received = serve(expected, REMOTE_DATAGRAM_LIMIT if self._remote else DATAGRAM_LIMIT)
        for port, count in expected.items():
            short = count - received.get(port, 0)
            if short < 0 < missed.get(port, 0):
                missed[port] = max(0, missed[port] + short)  # some of those given up were only late
            elif short > 0 and not rospy.is_shutdown():
                missed[port] = missed.get(port, 0) + short
                rospy.logwarn(f"{short} datagrams from the simulator to UDP port {port} did not arrive")

    def _peers(self, content: Mapping[str, Any]) -> None:
        """Publishers' connections to this node were made or lost."""
        self._deliveries.note(content)
        for number in content["counted"]:
            self._set_participant(number, True)
        for number in content["uncounted"]:
            self._set_participant(number, False)
        self._gone_back |= bool(content.get("reset"))

    def _set_participant(self, number: int, value: bool) -> None:
        outlet = self._outlets.get(number)
        if outlet is not None:
            outlet.participant = value

    # ---- socket ----

    def _send(self, data: bytes) -> None:
        if not self._joined:
            return
        with self._send_lock:
            if self._joined and self._sock is not None:
                self._sock.sendall(data)

    def _connected(self) -> socket.socket:
        if self._sock is None:
            raise ConnectionError("not connected")
        return self._sock

    def _readable(self) -> None:
        try:
            self._read()
        except (OSError, ProtocolError) as error:
            self._simulator_gone(str(error))

    def _read(self) -> None:
        """Reads what there is, at least something.

        Raises:
            OSError: The connection is closed.
        """
        data = self._connected().recv(1 << 16)
        if not data:
            raise ConnectionError("it has closed the connection")
        self._frame_reader.feed(data)
        self._frames.extend(self._frame_reader.frames())

    def _simulator_gone(self, why: str) -> None:
        # What it said last may be here, unread.
        with contextlib.suppress(OSError, ProtocolError):
            self._connected().settimeout(0.0)
            self._read()
        for kind, payload in self._frames:
            if kind in (Kind.REFUSED, Kind.LEAVE):
                self._last_word(kind, payload)
        self._end(f"the simulator at {self.uri} is gone", why)

    def _last_word(self, kind: int, payload: bytes) -> None:
        content = unpack_object(payload)
        fault = ""
        if kind == Kind.REFUSED:
            fault = "the simulator has dropped this node"
        elif content.get("failed"):
            fault = f"the simulator at {self.uri} has ended by a failure"
        self._end(fault, _reason(content))

    def _end(self, fault: str, why: str) -> None:
        """Ends the node; without a fault the simulation has ended in an orderly way."""
        if fault:
            rospy.logerr(f"{fault}: {why}")
            self._node.exit_status = 1
        else:
            rospy.loginfo(why)
        self._joined = False
        self._ended.set()
        rospy.signal_shutdown(fault or why)
        raise rospy.ROSInterruptException(fault or why)


def _reason(content: Mapping[str, Any]) -> str:
    """Returns the reason of a REFUSED or LEAVE, fit for a log."""
    return printable(str(content.get("reason")), LONGEST_REASON)


# ---- the simulator's own topics ----


class Host:
    """Counts what the simulator's own process publishes and is sent, for `LockstepServer.attach_host`.

    What participants send to its `Subscriber`s in a tick is dispatched by `receive` after that tick's barrier, what
    others send when it is called next; all in the simulator's thread, and in the same order as in a participant.

    Attributes:
        name: The simulator's node name.
    """

    def __init__(self, name: str) -> None:
        """Starts with nothing to tell."""
        self.name = name
        self._declaration: dict[str, Any] | None = None
        self._made: deque[list[Any]] = deque()
        self._lost: deque[int] = deque()
        self._numbers = 0
        self._outlets: dict[int, Outlet] = {}
        self._lock = threading.Lock()
        self._deliveries = Deliveries(_node)
        self._counts: dict[int, int] = {}

    def want_digests(self) -> Mapping[str, Digest]:
        """Has what is published from now on condensed, and returns where: by topic, for `time_passed`'s times."""
        _node.digests = {} if _node.digests is None else _node.digests
        return _node.digests

    def time_passed(self, time_us: int) -> None:
        """Notes the simulation time in microseconds, for the digests."""
        _node.time_us = time_us

    def declare(self, declaration: dict[str, Any]) -> None:
        """Notes the topics that there are now."""
        self._declaration = declaration

    def outlet_made(self, outlet: Outlet) -> None:
        """A subscriber has connected; called in a thread of rospy's."""
        with self._lock:
            if outlet.number or outlet.closed:
                return
            self._numbers += 1
            outlet.number = self._numbers
            self._outlets[outlet.number] = outlet
            self._made.append([outlet.number, outlet.topic, outlet.peer, outlet.port, outlet.count])

    def outlet_lost(self, outlet: Outlet) -> None:
        """A subscriber's connection is closed."""
        if self._outlets.pop(outlet.number, None) is not None:
            self._lost.append(outlet.number)

    def counted(self, number: int, value: bool) -> None:
        """Says whether a connection's subscriber is a participant, whose messages are never dropped."""
        outlet = self._outlets.get(number)
        if outlet is not None:
            outlet.participant = value

    def deliver(self, news: Mapping[str, Any], counts: Mapping[int, int]) -> None:
        """Takes what participants have sent by the end of a tick, see `server.HostLink`; `receive` dispatches it."""
        self._deliveries.note(news)
        self._counts.update(counts)

    def receive(self) -> None:
        """Runs the callbacks of what has come; call it after each `LockstepServer.tick`, in the same thread.

        Raises:
            ROSInterruptException: The node is shut down while it waits for a message.
        """
        _node.reader.wait(0.0)
        counts, self._counts = self._counts, {}
        self._deliveries.fetch(counts)
        _dispatch()

    def collect(self) -> tuple[dict[str, Any] | None, list[list[Any]], list[int], dict[int, int]]:
        """Returns what changed since the last call, see `server.HostLink`."""
        declaration, self._declaration = self._declaration, None
        # Counts before connections: a counted connection was announced before, now or in an earlier call.
        counts = {}
        while _node.dirty:
            outlet = _node.dirty.popleft()
            outlet.dirty = False
            counts[outlet.number] = outlet.count
        made, lost = [], []
        while self._made:
            made.append(self._made.popleft())
        while self._lost:
            lost.append(self._lost.popleft())
        return declaration, made, lost, counts


def host() -> Host:
    """Makes this process the simulator's: what its `Publisher`s send, and its `Subscriber`s get, is counted.

    Call it after rospy.init_node, in the simulator's thread, and give it to `LockstepServer.attach_host`. `Subscriber`s
    are to be made after it, and in the same thread. The process itself is no participant.

    Raises:
        ROSInitException: The node takes part in another simulator's lockstep.
    """
    if _node.taking_part:
        raise rospy.ROSInitException("a participant cannot be the simulator as well")
    if _node.host is None:
        _node.reader.activate()
        _node.host = Host(rospy.get_name())
        _node.host.declare(_node.declaration())
        for outlet in _node.outlets():
            _node.host.outlet_made(outlet)
    return _node.host
