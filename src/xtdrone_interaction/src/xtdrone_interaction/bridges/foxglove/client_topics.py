"""Topics that Foxglove's clients publish, in ROS 1's serialisation or JSON: validated, then published in the graph."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any, NamedTuple

from xtdrone_interaction.bridges.foxglove.topic_channels import ENCODING
from xtdrone_interaction.bridges.ros_publications import PublicationError, Publications
from xtdrone_interaction.topics.discovery import MasterError
from xtdrone_interaction.topics.message_classes import MessageTypeError, decode
from xtdrone_interaction.topics.message_json import MessageJsonError, from_json
from xtdrone_interaction.topics.ros_names import RosNameError, absolute_name

ENCODINGS = (ENCODING, "json")
MAX_MESSAGE = 10_000_000
"""Bytes of a client's message."""
_ERRORS = (RosNameError, PublicationError, MessageTypeError, MessageJsonError, MasterError)


class _Channel(NamedTuple):
    topic: str
    encoding: str
    kind: Any


class ClientTopics:
    """The topics of all clients. Its methods may wait for the ROS master."""

    def __init__(
        self, publications: Publications, is_open: Callable[[str], bool], report: Callable[[str, str], None]
    ) -> None:
        """Initialise without topics.

        Args:
            publications: the process's publishers.
            is_open: returns whether clients may publish a topic.
            report: sends clients an error; called with an identifier and a text.
        """
        self._publications = publications
        self._is_open = is_open
        self._report = report
        self._channels: dict[tuple[int, int], _Channel] = {}

    def advertise(self, client: int, channel: int, topic: str, encoding: str, type_: str) -> None:
        """Advertise a topic for a client's channel; violations are reported."""
        try:
            topic = absolute_name(topic, "topic")
            if encoding not in ENCODINGS:
                raise PublicationError(
                    f"topic: {topic}: encoding {encoding!r} is not allowed, {' or '.join(ENCODINGS)}"
                )
            if not self._is_open(topic):
                raise PublicationError(f"topic: {topic} is not offered by this bridge, see its parameter topics_glob")
            kind = self._publications.advertise((client, channel), topic, type_.replace("/msg/", "/"))
        except _ERRORS as error:
            self._report(f"publish {topic}", str(error))
            return
        self._channels[client, channel] = _Channel(topic, encoding, kind)

    def unadvertise(self, client: int, channel: int) -> None:
        """End a client's channel."""
        self._channels.pop((client, channel), None)
        self._publications.leave((client, channel))

    def publish(self, client: int, channel: int, data: bytes) -> None:
        """Publish a message of a client's channel; violations are reported."""
        found = self._channels.get((client, channel))
        if found is None:
            return  # rejected when it was advertised
        try:
            self._publications.publish(found.topic, _message(found, data))
        except _ERRORS as error:
            self._report(f"publish {found.topic}", f"topic: {found.topic}: {error}")


def _message(channel: _Channel, data: bytes) -> Any:
    if len(data) > MAX_MESSAGE:
        raise PublicationError(f"a message of {len(data)} bytes is not allowed, at most {MAX_MESSAGE}")
    if channel.encoding == ENCODING:
        return decode(channel.kind, data)
    try:
        return from_json(channel.kind, json.loads(data))
    except (ValueError, RecursionError) as error:
        raise PublicationError(f"the message is not JSON of its type: {error}") from error
