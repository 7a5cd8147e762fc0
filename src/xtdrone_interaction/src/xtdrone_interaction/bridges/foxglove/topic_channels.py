"""Topics of the graph as channels of Foxglove's protocol, subscribed to only while a client needs them."""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import foxglove
from foxglove import Context, Schema

from xtdrone_interaction.topics.message_classes import MessageTypeError, installed_class
from xtdrone_interaction.topics.raw_subscriptions import RawMessage, RawSubscriptions

ENCODING = "ros1"
SCHEMA_ENCODING = "ros1msg"
MAX_CHANNELS = 5000


def schema_of(kind: type[Any], name: str = "") -> Schema:
    """Return the schema of a message class; ``name``: instead of its type."""
    return Schema(name=name or kind._type, encoding=SCHEMA_ENCODING, data=kind._full_text.encode())


class _Topic:
    """A topic with its channel, and the subscription while it has clients."""

    def __init__(self, channel: Any, kind: type[Any]) -> None:
        self.channel = channel
        self.type = kind._type
        self.md5sum = kind._md5sum
        self.listener: Any = None
        self.failed = False


class TopicChannels:
    """Keeps channels for the topics of the graph.

    The SDK's threads call ``on_subscribe`` and ``on_unsubscribe``, which must not block; subscribing to a topic waits
    for the ROS master, so a thread of this object does it.
    """

    def __init__(
        self,
        context: Context,
        raw: RawSubscriptions,
        report: Callable[[str, str], None],
        channel: Callable[..., Any] = foxglove.Channel,
    ) -> None:
        """Initialise without channels.

        Args:
            context: of the server.
            raw: the process's subscriptions.
            report: sends clients a warning; called with an identifier and a text.
            channel: creates a channel, like ``foxglove.Channel``.
        """
        self._context = context
        self._raw = raw
        self._report = report
        self._make = channel
        self._topics: dict[str, _Topic] = {}
        self._refused: set[tuple[str, str]] = set()
        self._clients: Counter[str] = Counter()
        self._worker = ThreadPoolExecutor(1, "foxglove topics")
        self._lock = threading.Lock()

    def update(self, types: Mapping[str, str]) -> None:
        """Open and close channels to match the graph.

        Args:
            types: of the current topics, by name.
        """
        for name in [name for name, topic in self._topics.items() if types.get(name) != topic.type]:
            self._close(name)
        for name, type_ in types.items():
            if name not in self._topics and (name, type_) not in self._refused:
                self._open(name, type_)

    def _open(self, name: str, type_: str) -> None:
        try:
            kind = installed_class(type_)
            if len(self._topics) >= MAX_CHANNELS:
                raise MessageTypeError(f"one more than the {MAX_CHANNELS} topics offered")
        except MessageTypeError as error:
            self._refused.add((name, type_))
            self._report(f"topic {name}", f"topic: {name} is not offered: {error}")
            return
        channel = self._make(name, schema=schema_of(kind), message_encoding=ENCODING, context=self._context)
        self._topics[name] = _Topic(channel, kind)

    def _close(self, name: str) -> None:
        topic = self._topics.pop(name)
        topic.channel.close()
        self._worker.submit(self._unlisten, topic)

    def on_subscribe(self, name: str) -> None:
        """Count a client of a topic."""
        with self._lock:
            self._clients[name] += 1
        self._worker.submit(self._listen, name)

    def on_unsubscribe(self, name: str) -> None:
        """Remove a client of a topic."""
        with self._lock:
            self._clients[name] -= 1
            if self._clients[name] <= 0:
                del self._clients[name]
                topic = self._topics.get(name)
                if topic is not None:
                    self._worker.submit(self._unlisten, topic, name)

    def _listen(self, name: str) -> None:
        """Make a new subscription for each client, so that it also receives latched messages."""
        topic = self._topics.get(name)
        if topic is None or self._clients[name] <= 0:
            return
        former, topic.listener = topic.listener, self._raw.listen(name, lambda raw: self._pass_on(topic, raw))
        if former is not None:
            former.close()

    def _unlisten(self, topic: _Topic, name: str = "") -> None:
        if topic.listener is not None and self._clients.get(name, 0) <= 0:
            topic.listener.close()
            topic.listener = None

    def _pass_on(self, topic: _Topic, raw: RawMessage) -> None:
        if raw.md5sum != topic.md5sum:
            if not topic.failed:
                topic.failed = True
                text = f"topic: {raw.topic}: {raw.publisher} publishes a different {raw.type} than the installed one"
                self._report(f"topic {raw.topic}", text)
            return
        topic.channel.log(raw.data, log_time=max(0, round(raw.time * 1e9)))

    def close(self, names: Iterable[str] | None = None) -> None:
        """Close channels, all by default."""
        for name in list(self._topics if names is None else names):
            self._close(name)
        self._worker.shutdown(wait=True)
