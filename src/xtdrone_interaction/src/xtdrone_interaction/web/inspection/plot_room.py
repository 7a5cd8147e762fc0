"""Plots, like rqt_plot: samples of numeric fields of any topic, sent in batches."""

from __future__ import annotations

import threading
from typing import Any

import genpy

from xtdrone_interaction.topics.field_paths import FieldPathError, check_number, number_at
from xtdrone_interaction.topics.message_classes import MessageTypeError
from xtdrone_interaction.topics.raw_subscriptions import RawMessage
from xtdrone_interaction.web.context import StationContext
from xtdrone_interaction.web.inspection.page_subscriptions import PageSubscriptions
from xtdrone_interaction.web.inspection.topic_room import TopicRoom
from xtdrone_interaction.web.server.methods import Method, Params, needed
from xtdrone_interaction.web.server.session import Session

BATCH = 0.1  # s of wall time between two batches
PLOT_RATE = 50.0  # Hz, by default
_MOST_SAMPLES = 2000  # of a curve that wait for a page

Samples = dict[int, tuple[list[float], list[float]]]


class PlotRoom:
    """Collects the samples that pages plot."""

    def __init__(self, context: StationContext, topics: TopicRoom, pages: PageSubscriptions) -> None:
        """Store the context that the rooms share."""
        self._topics = topics
        self._pages = pages
        self._lock = threading.Lock()
        self._waiting: dict[Session, Samples] = {}
        self._faults: dict[int, str] = {}
        context.every(BATCH, self._send)

    def methods(self) -> list[Method]:
        """Return the methods of a page."""
        return [Method("plots.open", self._open), Method("plots.close", self._close)]

    async def _open(self, session: Session, params: Params) -> dict[str, Any]:
        topic = needed(params, "topic", str, "a topic's name")
        field = needed(params, "field", str, "a path such as pose.position.x")
        check_number(await self._topics.message_class(topic), field)

        def take(number: int, message: RawMessage) -> None:
            self._take(session, number, field, message)

        return {"subscription": await self._pages.open(session, topic, params.get("rate", PLOT_RATE), take)}

    async def _close(self, session: Session, params: Params) -> None:
        number = params.get("subscription")
        await self._pages.close(session, number)
        with self._lock:
            self._faults.pop(number, None)  # type: ignore[arg-type]

    def _take(self, session: Session, number: int, field: str, message: RawMessage) -> None:
        try:
            value, fault = number_at(message.message, field), ""
        except (FieldPathError, MessageTypeError) as error:
            value, fault = 0.0, str(error)
        with self._lock:
            if fault != self._faults.get(number, ""):
                self._faults[number] = fault
                session.push("plots.fault", {"subscription": number, "text": fault})
            if fault:
                return
            times, values = self._waiting.setdefault(session, {}).setdefault(number, ([], []))
            if len(times) < _MOST_SAMPLES:
                times.append(sample_time(message))
                values.append(value)

    def _send(self) -> None:
        with self._lock:
            batches, self._waiting = self._waiting, {}
        for session, samples in batches.items():
            session.push("plots.samples", {str(number): {"t": t, "v": v} for number, (t, v) in samples.items()})


def sample_time(message: RawMessage) -> float:
    """Return the time of a message's values, s of ROS time: its header's stamp, of arrival without one."""
    stamp = getattr(getattr(message.message, "header", None), "stamp", None)
    return float(stamp.to_sec()) if isinstance(stamp, genpy.Time) and stamp else message.time
