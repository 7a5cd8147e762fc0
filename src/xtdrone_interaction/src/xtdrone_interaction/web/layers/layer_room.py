"""Layers of the pages: paths, clouds, scans and grids of any topic, sent while a page shows them and when they change.

A page selects the rate of each layer. All its layers share a maximum number of points, so that thirty lidars cost a
browser no more than one.
"""

from __future__ import annotations

import threading
from typing import Any, NamedTuple

import rospy
from numpy.typing import NDArray
from tf2_msgs.msg import TFMessage

from xtdrone_interaction.topics.discovery import UNKNOWN_TYPE
from xtdrone_interaction.topics.message_classes import MessageTypeError
from xtdrone_interaction.topics.raw_subscriptions import RawMessage
from xtdrone_interaction.web.context import StationContext
from xtdrone_interaction.web.fleet.fleet_watch import FleetWatch
from xtdrone_interaction.web.inspection.page_subscriptions import PageSubscriptions
from xtdrone_interaction.web.inspection.plot_room import sample_time
from xtdrone_interaction.web.inspection.topic_room import TopicRoom
from xtdrone_interaction.web.layers.frames_in_map import FramesInMap
from xtdrone_interaction.web.layers.layer_content import TYPES, Content, LayerError, content_of
from xtdrone_interaction.web.layers.layer_frame import CHANNEL, pack_layer, packed_layer
from xtdrone_interaction.web.server.methods import CallError, Method, Params, needed
from xtdrone_interaction.web.server.session import Session

RATE = 2.0  # Hz, by default
MOST_RATE = 10.0  # Hz
MOST_BYTES = {"sensor_msgs/PointCloud2": 64 << 20}
"""Bytes of a message that is read; ``MOST_BYTES_OF_OTHERS`` of other types, whose elements become objects of Python."""
MOST_BYTES_OF_OTHERS = 4 << 20
MOST_POINTS = 20_000
"""Points of a cloud that are sent to a page."""
MOST_POINTS_OF_A_PAGE = 60_000
"""Points that all open layers of a page share."""
_LEAST_POINTS = 500
_MOST_CACHED = 64


class Shown(NamedTuple):
    """A message as sent: encoded once for all pages."""

    message: RawMessage
    content: Content
    packed: bytes


class LayerRoom:
    """Sends layers to the pages that show them."""

    def __init__(self, context: StationContext, topics: TopicRoom, pages: PageSubscriptions, fleet: FleetWatch) -> None:
        """Store the context that the rooms share."""
        self._context = context
        self._topics = topics
        self._pages = pages
        self._fleet = fleet
        self._frames = FramesInMap()
        self._lock = threading.Lock()
        self._cache: dict[tuple[str, int], Shown] = {}  # newest of each topic and number of points
        self._open: dict[Session, set[int]] = {}
        self._listening = threading.Lock()  # also held while the master is asked, unlike the other
        self._subscribers: list[Any] = []
        self._takes_fleet = False
        fleet.watchers.append(self._on_vehicles)

    def methods(self) -> list[Method]:
        """Return the methods of a page."""
        return [
            Method("layers.list", self._list),
            Method("layers.open", self._open_layer),
            Method("layers.close", self._close_layer),
        ]

    async def _list(self, _session: Session, _params: Params) -> dict[str, Any]:
        topics = (await self._topics.graph()).topics.values()
        return {"layers": [{"name": t.name, "type": t.type} for t in topics if t.type in TYPES and t.publishers]}

    async def _open_layer(self, session: Session, params: Params) -> dict[str, Any]:
        topic = needed(params, "topic", str, "a topic's name")
        rate = params.get("rate", RATE)
        if type(rate) not in (int, float) or not 0.0 < rate <= MOST_RATE:
            raise CallError(f"rate: {rate!r} is not allowed, more than 0, up to {MOST_RATE:g} Hz")
        found = (await self._topics.graph()).topics.get(topic)
        kind = params.get("type") if found is None or found.type == UNKNOWN_TYPE else found.type
        if kind not in TYPES:  # a topic that is not there yet is subscribed to if the page knows its type
            kind = "it is not there" if found is None else found.type
            raise CallError(f"topic: {topic[:100]!r} is not allowed ({kind}), one of {', '.join(TYPES)}")
        mine = self._open.get(session)
        if mine is None:  # before subscribing: the end of another page's last layer must not stop it
            mine = self._open[session] = set()
            session.on_close(lambda: self._end(session))
        await self._context.blocking(self._listen_to_frames)
        last: list[Shown | None] = [None]
        faults = [""]

        def send(number: int, message: RawMessage) -> None:
            fault = ""
            try:
                shown = self._shown(message, _share(len(mine)))
                if last[0] is None or (shown.packed, shown.message.data) != (last[0].packed, last[0].message.data):
                    session.push_binary(CHANNEL, pack_layer(number, shown.content, shown.packed))
                last[0] = shown
            except (LayerError, MessageTypeError) as error:
                fault = str(error)
            if fault != faults[0]:
                faults[0] = fault
                session.push("layers.fault", {"subscription": number, "text": fault})

        number = await self._pages.open(session, topic, float(rate), send)
        mine.add(number)
        return {"subscription": number}

    async def _close_layer(self, session: Session, params: Params) -> None:
        number = params.get("subscription")
        if isinstance(number, int):
            self._open.get(session, set()).discard(number)
        await self._pages.close(session, number)

    def _end(self, session: Session) -> None:
        """Forget a disconnected page; without pages no frames are subscribed to."""
        self._open.pop(session, None)
        if not self._open:
            self._context.in_loop(self._context.blocking, self._stop_listening)

    def _listen_to_frames(self) -> None:
        self._frames.set_fleet(self._fleet.roster.vehicles)
        with self._listening:
            if self._open and not self._subscribers:
                self._subscribers = [
                    rospy.Subscriber("/tf", TFMessage, self._frames.hear, queue_size=100, tcp_nodelay=True),
                    rospy.Subscriber("/tf_static", TFMessage, self._frames.hear_static, queue_size=100),
                ]

    def _stop_listening(self) -> None:
        with self._listening:
            if self._open:
                return
            stopped, self._subscribers = self._subscribers, []
        with self._lock:
            self._cache.clear()
        for subscriber in stopped:
            subscriber.unregister()

    def _on_vehicles(self, rows: NDArray[Any], time: float) -> None:
        if not self._open:
            return
        if self._frames.is_of(self._fleet.roster.vehicles):
            self._frames.set_vehicles(rows, time)
        else:  # a vehicle has joined or left
            self._context.in_loop(self._take_fleet)

    async def _take_fleet(self) -> None:
        """Load the frames of the current fleet, once for all calls meanwhile."""
        if self._takes_fleet:
            return
        self._takes_fleet = True
        try:
            await self._context.blocking(self._frames.set_fleet, self._fleet.roster.vehicles)
        finally:
            self._takes_fleet = False

    def _shown(self, message: RawMessage, most: int) -> Shown:
        """Return a message as it is sent, made once for all pages that show as many points.

        Raises:
            LayerError, MessageTypeError: it cannot be shown.
        """
        key = (message.topic, most)
        with self._lock:
            cached = self._cache.get(key)
        if cached is not None and cached.message is message:
            return cached
        if message.type not in TYPES:  # the topic has been advertised since it was subscribed to
            raise LayerError(f"type: {message.type} is not allowed, one of {', '.join(TYPES)}")
        largest = MOST_BYTES.get(message.type, MOST_BYTES_OF_OTHERS)
        if len(message.data) > largest:
            raise LayerError(f"message: {len(message.data)} bytes are not allowed, at most {largest}")
        header = message.message.header
        content = content_of(message.type, message.message, most)
        pose = self._frames.pose(header.frame_id, message.topic, header.stamp)
        shown = Shown(message, content, packed_layer(content, pose, sample_time(message)))
        with self._lock:
            if len(self._cache) >= _MOST_CACHED:
                self._cache.pop(next(iter(self._cache)))
            self._cache[key] = shown
        return shown


def _share(layers: int) -> int:
    """Return the maximum number of points of a cloud in a page with so many open layers."""
    return max(_LEAST_POINTS, min(MOST_POINTS, MOST_POINTS_OF_A_PAGE // max(layers, 1)))
