"""Subscriptions of one client: passes messages from rospy's threads to the client, at the rate that it can receive."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any

from xtdrone_interaction.bridges.rosbridge.clients.connection import Connection, Frame
from xtdrone_interaction.bridges.rosbridge.clients.subscription_queues import SendQueue
from xtdrone_interaction.bridges.rosbridge.protocol.cbor_values import cbor_values
from xtdrone_interaction.bridges.rosbridge.protocol.encodings import encode_cbor, encode_cbor_raw, encode_json
from xtdrone_interaction.topics.message_classes import MessageTypeError
from xtdrone_interaction.topics.message_json import NotFinite, to_json
from xtdrone_interaction.topics.raw_subscriptions import RawMessage, RawSubscriptions

MAX_TOPICS = 500
"""Maximum number of topics subscribed to by one client."""
Id = str | int | None


class SubscriptionError(ValueError):
    """A rejected or failed subscription."""


def encode(raw: RawMessage, compression: str) -> Frame:
    """Return the frame of a message.

    Raises:
        MessageTypeError: its type is not installed and its definition is invalid, or its bytes do not match the type.
    """
    if compression == "cbor-raw":
        return encode_cbor_raw(raw.topic, raw.data, _time(raw.time))
    if compression == "cbor":
        return encode_cbor(raw.topic, cbor_values(raw.message))
    values = to_json(raw.message, not_finite=NotFinite.NULL)
    return encode_json({"op": "publish", "topic": raw.topic, "msg": values}, compression)


def _time(seconds: float) -> tuple[int, int]:
    nanoseconds = round(seconds * 1e9)
    return nanoseconds // 10**9, nanoseconds % 10**9


class Encoder:
    """Cache of encoded frames: the last one per topic and compression."""

    def __init__(self) -> None:
        self._kept: dict[tuple[str, str], tuple[RawMessage, Frame]] = {}

    def frame(self, raw: RawMessage, compression: str) -> Frame:
        """Return the frame of a message; raises as ``encode``."""
        key = (raw.topic, compression)
        kept = self._kept.get(key)
        if kept is None or kept[0] is not raw:
            kept = self._kept[key] = (raw, encode(raw, compression))
        return kept[1]

    def forget(self, topic: str) -> None:
        """Discard the cached frames of a topic."""
        for key in [key for key in self._kept if key[0] == topic]:
            self._kept.pop(key, None)


class _Subscription:
    """A topic to which the client has subscribed, possibly several times with different ids.

    As in rosbridge_suite, the client gets each message once: at the shortest of the intervals, with the longest queue,
    in the compression of the last request.
    """

    def __init__(self, topic: str) -> None:
        self.topic = topic
        self.requests: dict[Id, tuple[float, int]] = {}
        self.compression = "none"
        self.queue: SendQueue[RawMessage] = SendQueue(0.0, 1)
        self.timed = False  # the server's thread will look again
        self.failed = ""  # the last error that was told
        self.listener: Any = None

    def update(self) -> None:
        intervals, lengths = zip(*self.requests.values(), strict=True)
        self.queue.resize(min(intervals), max(lengths))


class Subscriptions:
    """The subscriptions of one client."""

    def __init__(
        self,
        raw: RawSubscriptions,
        encoder: Encoder,
        connection: Connection,
        report: Callable[[str], None],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Initialise without subscriptions.

        Args:
            raw: the process's subscriptions.
            encoder: of all clients.
            connection: to the client.
            report: sends the client an error.
            clock: monotonic, s.
        """
        self._raw = raw
        self._encoder = encoder
        self._connection = connection
        self._report = report
        self._clock = clock
        self._topics: dict[str, _Subscription] = {}
        self._lock = threading.Lock()
        self._woken = False

    def subscribe(self, topic: str, id_: Id, throttle_rate: float, queue_length: int, compression: str) -> None:
        """Subscribe to a topic, or change a subscription.

        Args:
            topic: resolved name; it need not exist yet.
            id_: of the request; a later one with the same id replaces it.
            throttle_rate: minimum time between two messages, ms.
            queue_length: messages queued for the client; of faster topics, the newest are sent.
            compression: ``none``, ``png``, ``cbor`` or ``cbor-raw``.

        Raises:
            SubscriptionError: the name is not allowed, or there are too many topics.
        """
        subscription = self._topics.get(topic)
        new = subscription is None
        if subscription is None:
            if len(self._topics) >= MAX_TOPICS:
                raise SubscriptionError(f"topic: {topic} is one too many, at most {MAX_TOPICS} for a client")
            subscription = self._topics[topic] = _Subscription(topic)
        subscription.requests[id_] = (1e-3 * throttle_rate, queue_length)
        subscription.compression = compression
        subscription.update()
        if new:
            self._listen(subscription)

    def _listen(self, subscription: _Subscription) -> None:
        def receive(raw: RawMessage) -> None:
            subscription.queue.add(raw, len(raw.data))
            self._wake()

        try:
            subscription.listener = self._raw.listen(subscription.topic, receive)
        except ValueError as error:
            del self._topics[subscription.topic]
            raise SubscriptionError(str(error)) from error

    def unsubscribe(self, topic: str, id_: Id) -> None:
        """End one request for a topic; without an id, all of them.

        Raises:
            SubscriptionError: the client has no such subscription.
        """
        subscription = self._topics.get(topic)
        if subscription is None or (id_ is not None and id_ not in subscription.requests):
            raise SubscriptionError(f"topic: {topic} is not subscribed to{'' if id_ is None else f' with id {id_!r}'}")
        if id_ is not None:
            del subscription.requests[id_]
        if id_ is None or not subscription.requests:
            del self._topics[topic]
            subscription.listener.close()
            self._encoder.forget(topic)
        else:
            subscription.update()

    def close(self) -> None:
        """End all subscriptions."""
        for topic in list(self._topics):
            self.unsubscribe(topic, None)

    def _wake(self) -> None:
        with self._lock:
            if self._woken:
                return
            self._woken = True
        self._connection.call_soon(self.send_waiting)

    def send_waiting(self) -> None:
        """Send due messages as the connection permits; called by the server's thread, also after the client has
        received frames."""
        with self._lock:
            self._woken = False
        for subscription in list(self._topics.values()):
            self._send(subscription)

    def _send(self, subscription: _Subscription) -> None:
        queue = subscription.queue
        while len(queue) and self._connection.has_room():
            now = self._clock()
            delay = queue.delay(now)
            if delay > 0.0:
                self._look_again(subscription, delay)
                return
            self._send_one(subscription, queue.pop(now))

    def _look_again(self, subscription: _Subscription, delay: float) -> None:
        if subscription.timed:
            return
        subscription.timed = True

        def look() -> None:
            subscription.timed = False
            if self._topics.get(subscription.topic) is subscription:
                self._send(subscription)

        self._connection.call_later(delay, look)

    def _send_one(self, subscription: _Subscription, raw: RawMessage) -> None:
        try:
            frame = self._encoder.frame(raw, subscription.compression)
        except (MessageTypeError, ValueError) as error:
            if str(error) != subscription.failed:
                subscription.failed = str(error)
                self._report(f"topic: {subscription.topic}: {error}")
            return
        self._connection.send(frame)
