"""Topics, like rqt_topic and ``rostopic``: list, rates, fields, echo; and one message published by hand."""

from __future__ import annotations

from concurrent.futures import Future
from typing import Any

from xtdrone_interaction.topics.connected_publishers import ConnectedPublishers
from xtdrone_interaction.topics.discovery import UNKNOWN_TYPE, MasterError, Topic, TopicGraph, read_topics
from xtdrone_interaction.topics.field_paths import fields_of
from xtdrone_interaction.topics.message_classes import MessageTypeError, installed_class
from xtdrone_interaction.topics.message_json import from_json, to_json
from xtdrone_interaction.topics.raw_subscriptions import RawMessage, RawSubscriptions
from xtdrone_interaction.topics.ros_names import absolute_name
from xtdrone_interaction.web.context import StationContext
from xtdrone_interaction.web.inspection.page_subscriptions import PageSubscriptions
from xtdrone_interaction.web.server.methods import CallError, Method, Params, needed
from xtdrone_interaction.web.server.session import Session

ECHO_RATE = 5.0  # Hz, by default
_LONGEST = 64  # elements of an array that are echoed, by default
_MOST_LONGEST = 10_000
_FIRST_MESSAGE = 3.0  # s of wall time to learn a foreign type
_MOST_PUBLISHERS = 50


class TopicRoom:
    """Answers a page's questions on topics."""

    def __init__(self, context: StationContext, topics: RawSubscriptions, pages: PageSubscriptions) -> None:
        """Store the context that the rooms share."""
        self._context = context
        self._topics = topics
        self._pages = pages
        self._publishers = ConnectedPublishers(context.master, _MOST_PUBLISHERS)

    def methods(self) -> list[Method]:
        """Return the methods of a page."""
        return [
            Method("topics.list", self._list),
            Method("topics.fields", self._fields),
            Method("topics.echo", self._echo),
            Method("topics.measure", self._measure),
            Method("topics.rates", self._rates),
            Method("topics.close", self._close),
            Method("topics.publish", self._publish, "operate"),
        ]

    async def graph(self) -> TopicGraph:
        """Return the topics of the ROS graph.

        Raises:
            CallError: the master does not answer.
        """
        try:
            return await self._context.blocking(read_topics, self._context.master)
        except MasterError as error:
            raise CallError(str(error)) from error

    async def message_class(self, topic: str) -> type[Any]:
        """Return the class of a topic's messages, of a foreign type by its first message.

        Raises:
            CallError: there is no such topic, or no node has named its type.
            MessageTypeError: its definition is not valid.
        """
        topic = absolute_name(topic, "topic")
        found = (await self.graph()).topics.get(topic, Topic(topic, UNKNOWN_TYPE))
        if found.type == UNKNOWN_TYPE:
            raise CallError(f"topic: {topic[:100]!r} is not there, or no node has named its type")
        try:
            return await self._context.blocking(installed_class, found.type)
        except MessageTypeError:
            message = await self._context.blocking(self._first_message, topic)
            return await self._context.blocking(lambda: message.message_class)

    def _first_message(self, topic: str) -> RawMessage:
        arrived: Future[RawMessage] = Future()

        def on_message(message: RawMessage) -> None:
            if not arrived.done():
                arrived.set_result(message)

        listener = self._topics.listen(topic, on_message)
        try:
            return arrived.result(_FIRST_MESSAGE)
        except TimeoutError:
            raise CallError(
                f"topic: {topic!r} has a type that is not installed, and no message within 3 s to learn it"
            ) from None
        finally:
            listener.close()

    async def _list(self, _session: Session, _params: Params) -> dict[str, Any]:
        graph = await self.graph()
        return {
            "topics": [
                {"name": t.name, "type": t.type, "publishers": t.publishers, "subscribers": t.subscribers}
                for t in graph.topics.values()
            ]
        }

    async def _fields(self, _session: Session, params: Params) -> dict[str, Any]:
        kind = await self.message_class(needed(params, "topic", str, "a topic's name"))
        fields = [{"path": f.path, "type": f.type, "plottable": f.plottable} for f in fields_of(kind)]
        return {"type": kind._type, "md5sum": kind._md5sum, "definition": kind._full_text, "fields": fields}

    async def _echo(self, session: Session, params: Params) -> dict[str, Any]:
        topic = needed(params, "topic", str, "a topic's name")
        longest = params.get("longest", _LONGEST)
        if type(longest) is not int or not 0 <= longest <= _MOST_LONGEST:
            raise CallError(f"longest: {longest!r} is not allowed, an integer from 0 to {_MOST_LONGEST}")

        def push(number: int, message: RawMessage) -> None:
            session.push("topics.message", {"subscription": number, **_echoed(message, longest)})

        return {"subscription": await self._pages.open(session, topic, params.get("rate", ECHO_RATE), push)}

    async def _measure(self, session: Session, params: Params) -> dict[str, Any]:
        topic = needed(params, "topic", str, "a topic's name")
        return {"subscription": await self._pages.open(session, topic, 1.0, lambda _number, _message: None)}

    async def _close(self, session: Session, params: Params) -> None:
        await self._pages.close(session, params.get("subscription"))

    def _rates(self, _session: Session, _params: Params) -> dict[str, Any]:
        counts = self._topics.counts()
        return {
            name: {"rate": rate, "bytes": size, "count": counts.get(name, 0)}
            for name, (rate, size) in self._topics.rates().items()
        }

    async def _publish(self, _session: Session, params: Params) -> dict[str, Any]:
        topic = absolute_name(params.get("topic"), "topic")
        kind = await self._context.blocking(installed_class, needed(params, "type", str, "a type as std_msgs/String"))
        message = from_json(kind, params.get("message", {}))
        registered = (await self.graph()).topics.get(topic)
        if registered is not None and registered.type not in (UNKNOWN_TYPE, kind._type):
            raise CallError(f"type: {kind._type} is not allowed on {topic}, {registered.type}")
        return {"subscribers": await self._context.blocking(self._publishers.publish, topic, message)}


def _echoed(message: RawMessage, longest: int) -> dict[str, Any]:
    """Return a message for the page, or why it cannot be decoded."""
    head = {
        "topic": message.topic,
        "type": message.type,
        "publisher": message.publisher,
        "time": message.time,
        "size": len(message.data),
    }
    try:
        return {**head, "message": to_json(message.message, longest=longest)}
    except MessageTypeError as error:
        return {**head, "error": str(error)}
