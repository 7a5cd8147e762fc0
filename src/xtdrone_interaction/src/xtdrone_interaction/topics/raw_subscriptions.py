"""Subscriptions to topics of any type: one per topic in a process, shared by listeners with a rate of their own each.

Messages stay serialised until a listener decodes them; a listener that is slower than its topic gets the latest one.
The subscriptions are plain ones, out of the lockstep: the simulation never waits for them.
"""

from __future__ import annotations

import io
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import rospy

from xtdrone_interaction.topics.message_classes import decode, message_class
from xtdrone_interaction.topics.rates import RateMeter, Throttle
from xtdrone_interaction.topics.ros_names import absolute_name

BUFFER = 1 << 18  # bytes read from a connection at a time
QUEUE = 100  # serialised messages of a topic kept while its listeners are busy


@dataclass(frozen=True)
class RawMessage:
    """A serialised message.

    Attributes:
        topic: resolved name.
        type: such as ``geometry_msgs/Twist``.
        md5sum: of the type.
        definition: of the type, with the types it uses; may be empty.
        publisher: name of the node.
        latched: whether the publisher latches the topic.
        data: bytes as sent, without their length.
        arrival: time of the monotonic clock, s.
        time: ROS time of arrival, s; 0 while there is none.
    """

    topic: str
    type: str
    md5sum: str
    definition: str = field(repr=False)
    publisher: str
    latched: bool
    data: bytes = field(repr=False)
    arrival: float
    time: float

    @property
    def message_class(self) -> Any:
        """The class that decodes it.

        Raises:
            MessageTypeError: the type is not installed and its definition is not valid.
        """
        return message_class(self.type, self.md5sum, self.definition)

    @cached_property
    def message(self) -> Any:
        """The decoded message, decoded once for all listeners.

        Raises:
            MessageTypeError: as ``message_class``, or the bytes do not match the type.
        """
        return decode(self.message_class, self.data)


Callback = Callable[[RawMessage], None]


class Listener:
    """One listener of a topic; ``close`` ends it."""

    def __init__(self, owner: RawSubscriptions, topic: str, callback: Callback, most: float | None) -> None:
        self.topic = topic
        self.closed = False
        self.callback = callback
        self.throttle = Throttle(most)
        self.pending: RawMessage | None = None  # waits for its time
        self._owner = owner

    def close(self) -> None:
        """End the listening; may wait for the ROS master."""
        self._owner._remove(self)


class _SharedTopic:
    """The one subscription to a topic."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.listeners: tuple[Listener, ...] = ()
        self.meter = RateMeter()
        self.latest: dict[str, RawMessage] = {}  # by publisher, of latched ones
        self.subscriber: rospy.Subscriber | None = None


class RawSubscriptions:
    """Subscriptions of a process, by topic.

    Callbacks run in rospy's threads, or in the one of this object for messages that had to wait; they must be short.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        """Make an object without subscriptions.

        Args:
            clock: s, for the rates.
        """
        self._clock = clock
        self._lock = threading.RLock()
        self._master_lock = threading.Lock()  # orders subscribing and unsubscribing; both wait for the ROS master
        self._topics: dict[str, _SharedTopic] = {}
        self._due = threading.Condition(self._lock)
        self._waiting: dict[Listener, float] = {}
        self._closed = False
        self._thread: threading.Thread | None = None

    def listen(self, topic: str, callback: Callback, most: float | None = None) -> Listener:
        """Listen to a topic; latched messages that have arrived already are passed on at once.

        Args:
            topic: name; it need not exist yet.
            callback: called with each message that is passed on.
            most: messages per s; None for all. Of those that come faster the latest one is passed on.

        Raises:
            RosNameError: the name is not allowed.
        """
        name = str(rospy.resolve_name(absolute_name(topic, "topic")))
        listener = Listener(self, name, callback, most)
        with self._master_lock:
            with self._lock:
                shared = self._topics.setdefault(name, _SharedTopic(name))
                shared.listeners = (*shared.listeners, listener)
                latched = list(shared.latest.values())
            if shared.subscriber is None:
                shared.subscriber = self._subscribe(shared)
        for message in latched:
            self._offer(listener, message)
        return listener

    def rates(self) -> Mapping[str, tuple[float, float]]:
        """Return messages per s and bytes per s of the topics that are listened to, by name."""
        now = self._clock()
        with self._lock:
            return {name: shared.meter.rates(now) for name, shared in sorted(self._topics.items())}

    def counts(self) -> Mapping[str, int]:
        """Return the messages received so far of the topics that are listened to, by name."""
        with self._lock:
            return {name: shared.meter.count for name, shared in sorted(self._topics.items())}

    def close(self) -> None:
        """End all subscriptions."""
        with self._lock:
            listeners = [listener for shared in self._topics.values() for listener in shared.listeners]
            self._closed = True
            self._due.notify_all()
        for listener in listeners:
            listener.close()

    def receive(self, topic: str, message: Any) -> None:
        """Pass on a message; rospy's callback. ``message``: an ``AnyMsg`` with its connection's header."""
        raw = _raw(topic, message, self._clock())
        with self._lock:
            shared = self._topics.get(topic)
            if shared is None:
                return
            shared.meter.add(raw.arrival, len(raw.data))
            if raw.latched:
                shared.latest[raw.publisher] = raw
            listeners = shared.listeners
        for listener in listeners:
            self._offer(listener, raw)

    def _subscribe(self, shared: _SharedTopic) -> rospy.Subscriber:
        return rospy.Subscriber(
            shared.name,
            rospy.AnyMsg,
            lambda message: self.receive(shared.name, message),
            queue_size=QUEUE,
            buff_size=BUFFER,
            tcp_nodelay=True,
        )

    def _offer(self, listener: Listener, message: RawMessage) -> None:
        now = self._clock()
        with self._lock:
            if listener.closed:
                return
            wait = listener.throttle.wait(now)
            if wait > 0.0 or listener in self._waiting:
                listener.pending = message
                self._wait(listener, now + wait)
                return
            listener.throttle.passed(now)
        listener.callback(message)

    def _wait(self, listener: Listener, due: float) -> None:
        if listener not in self._waiting:
            self._waiting[listener] = due
            if self._thread is None:
                self._thread = threading.Thread(target=self._run, name="throttled topics", daemon=True)
                self._thread.start()
            self._due.notify_all()

    def _run(self) -> None:
        while (ready := self._next_ready()) is not None:
            listener, message = ready
            listener.callback(message)

    def _next_ready(self) -> tuple[Listener, RawMessage] | None:
        """Wait for the next message whose time has come; None after the end."""
        with self._lock:
            while not self._closed:
                now = self._clock()
                if not self._waiting:
                    self._due.wait()
                    continue
                listener = min(self._waiting, key=self._waiting.__getitem__)
                if self._waiting[listener] > now:
                    self._due.wait(self._waiting[listener] - now)
                    continue
                del self._waiting[listener]
                message, listener.pending = listener.pending, None
                if message is not None and not listener.closed:
                    listener.throttle.passed(now)
                    return listener, message
        return None

    def _remove(self, listener: Listener) -> None:
        with self._master_lock:
            with self._lock:
                if listener.closed:
                    return
                listener.closed = True
                self._waiting.pop(listener, None)
                shared = self._topics[listener.topic]
                shared.listeners = tuple(other for other in shared.listeners if other is not listener)
                if shared.listeners:
                    return
                del self._topics[listener.topic]
            if shared.subscriber is not None:
                shared.subscriber.unregister()


def _raw(topic: str, message: Any, now: float) -> RawMessage:
    header = message._connection_header or {}
    data = getattr(message, "_buff", None)
    if data is None:  # another part of the process has subscribed with the type, and rospy shares its decoder
        buffer = io.BytesIO()
        message.serialize(buffer)
        data = buffer.getvalue()
    return RawMessage(
        topic,
        header.get("type", message._type),
        header.get("md5sum", message._md5sum),
        header.get("message_definition", ""),
        header.get("callerid", ""),
        header.get("latching") == "1",
        data,
        now,
        _ros_time(),
    )


def _ros_time() -> float:
    try:
        return float(rospy.get_time())
    except rospy.exceptions.ROSInitException:
        return 0.0
