"""The console, like rqt_console: the log messages of all nodes, kept from the station's start."""

from __future__ import annotations

import itertools
import threading
from collections import deque
from typing import Any

from rosgraph_msgs.msg import Log

from xtdrone_interaction.topics.message_classes import MessageTypeError
from xtdrone_interaction.topics.raw_subscriptions import RawMessage, RawSubscriptions
from xtdrone_interaction.web.context import StationContext
from xtdrone_interaction.web.server.methods import Method, Params
from xtdrone_interaction.web.server.session import Session

TOPIC = "/rosout_agg"  # of the node rosout: one connection instead of one to each node
KEPT = 2000
_BATCH = 0.2  # s of wall time
_LEVELS = {Log.DEBUG: "debug", Log.INFO: "info", Log.WARN: "warn", Log.ERROR: "error", Log.FATAL: "fatal"}
_LONGEST = 4000  # characters of a text


class ConsoleRoom:
    """Keeps the last log messages and sends new ones to the pages that show them."""

    def __init__(self, context: StationContext, topics: RawSubscriptions) -> None:
        """Begin to listen."""
        self._lock = threading.Lock()
        self._numbers = itertools.count(1)
        self._kept: deque[dict[str, Any]] = deque(maxlen=KEPT)
        self._new: list[dict[str, Any]] = []
        self._pages: list[Session] = []
        context.every(_BATCH, self._send)
        context.in_loop(context.blocking, topics.listen, TOPIC, self.take)

    def methods(self) -> list[Method]:
        """Return the methods of a page."""
        return [Method("console.open", self._open), Method("console.close", self._close)]

    def take(self, message: RawMessage) -> None:
        """Keep a log message; called in another thread."""
        try:
            entry = described(message.message)
        except MessageTypeError:
            return
        with self._lock:
            entry["number"] = next(self._numbers)
            self._kept.append(entry)
            self._new.append(entry)
            del self._new[:-KEPT]

    def _open(self, session: Session, _params: Params) -> dict[str, Any]:
        if session not in self._pages:
            self._pages.append(session)
            session.on_close(lambda: self._close(session, {}))
        with self._lock:
            return {"messages": list(self._kept)}

    def _close(self, session: Session, _params: Params) -> None:
        if session in self._pages:
            self._pages.remove(session)

    def _send(self) -> None:
        with self._lock:
            new, self._new = self._new, []
        if new:
            for session in self._pages:
                session.push("console.messages", {"messages": new})


def described(log: Log) -> dict[str, Any]:
    """Return a log message for the page, its time in s of ROS time."""
    return {
        "time": log.header.stamp.to_sec(),
        "level": _LEVELS.get(log.level, "error"),
        "node": log.name,
        "text": log.msg[:_LONGEST],
        "place": f"{log.file}:{log.line} {log.function}",
    }
