"""Images of any camera topic, as JPEG on a binary channel.

A frame of channel 2 is little-endian: u8 channel (2), u8 version (1), u16 reserved, u32 number of the subscription,
f64 time of the image (s of ROS time), u16 width and u16 height of the original image (pixels), u32 reserved, then the
JPEG, whose own size may be smaller.
"""

from __future__ import annotations

import struct
import threading
from typing import Any

from xtdrone_interaction.topics.message_classes import MessageTypeError
from xtdrone_interaction.topics.raw_subscriptions import RawMessage
from xtdrone_interaction.web.context import StationContext
from xtdrone_interaction.web.images.image_jpeg import ImageError, Picture, jpeg_of
from xtdrone_interaction.web.inspection.page_subscriptions import PageSubscriptions
from xtdrone_interaction.web.inspection.plot_room import sample_time
from xtdrone_interaction.web.inspection.topic_room import TopicRoom
from xtdrone_interaction.web.server.methods import CallError, Method, Params, needed
from xtdrone_interaction.web.server.session import Session

CHANNEL = 2
TYPES = ("sensor_msgs/Image", "sensor_msgs/CompressedImage")
RATE = 5.0  # Hz, by default
_HEADER = struct.Struct("<BHIdHHI")  # after the channel's byte
_WIDTHS = (64, 1920)
_WIDTH = 640  # px, by default
_MOST_CACHED = 8


class ImageRoom:
    """Sends images to the pages that show them."""

    def __init__(self, context: StationContext, topics: TopicRoom, pages: PageSubscriptions) -> None:
        """Store the context that the rooms share."""
        self._topics = topics
        self._pages = pages
        self._lock = threading.Lock()
        self._cache: dict[tuple[str, int], tuple[RawMessage, Picture]] = {}  # newest of each topic and width

    def methods(self) -> list[Method]:
        """Return the methods of a page."""
        return [
            Method("images.list", self._list),
            Method("images.open", self._open),
            Method("images.close", self._close),
        ]

    async def _list(self, _session: Session, _params: Params) -> dict[str, Any]:
        topics = (await self._topics.graph()).topics.values()
        boxes = [t.name for t in topics if t.type == "darknet_ros_msgs/BoundingBoxes" and t.publishers]
        images = [{"name": t.name, "type": t.type} for t in topics if t.type in TYPES and t.publishers]
        return {"images": images, "detections": boxes}

    async def _open(self, session: Session, params: Params) -> dict[str, Any]:
        topic = needed(params, "topic", str, "a topic's name")
        width = params.get("width", _WIDTH)
        if type(width) is not int or not _WIDTHS[0] <= width <= _WIDTHS[1]:
            raise CallError(f"width: {width!r} is not allowed, an integer from {_WIDTHS[0]} to {_WIDTHS[1]} px")
        found = (await self._topics.graph()).topics.get(topic)
        if found is None or found.type not in TYPES:
            kind = "it is not there" if found is None else found.type
            raise CallError(f"topic: {topic[:100]!r} is not allowed ({kind}), one of {' or '.join(TYPES)}")

        def send(number: int, message: RawMessage) -> None:
            try:
                session.push_binary(CHANNEL, pack_picture(number, sample_time(message), self._picture(message, width)))
            except (ImageError, MessageTypeError) as error:
                session.push("images.fault", {"subscription": number, "text": str(error)})

        return {"subscription": await self._pages.open(session, topic, params.get("rate", RATE), send)}

    async def _close(self, session: Session, params: Params) -> None:
        await self._pages.close(session, params.get("subscription"))

    def _picture(self, message: RawMessage, width: int) -> Picture:
        """Return a message's JPEG, made once for all pages that show it at the same width."""
        key = (message.topic, width)
        with self._lock:
            cached = self._cache.get(key)
        if cached is not None and cached[0] is message:
            return cached[1]
        picture = jpeg_of(message.message, width)
        with self._lock:
            if len(self._cache) >= _MOST_CACHED:
                self._cache.pop(next(iter(self._cache)))
            self._cache[key] = (message, picture)
        return picture


def pack_picture(number: int, time: float, picture: Picture) -> bytes:
    """Return a frame without its channel's byte."""
    return _HEADER.pack(1, 0, number, time, picture.width, picture.height, 0) + picture.jpeg
