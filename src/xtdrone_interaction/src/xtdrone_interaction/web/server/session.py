"""One page's connection: its role, its calls, and what is sent to it.

A page that reads slowly gets fewer frames: pushed data wait in a queue of bounded size, and are dropped while the queue
is full. A page that reads nothing is disconnected.
"""

from __future__ import annotations

import json
import math
import threading
import time
from collections.abc import Callable
from typing import Any, Protocol

from xtdrone_interaction.web.server.credentials import Role

MOST_UNSENT = 4 << 20
"""Maximum bytes that wait for a page; beyond them, pushed data are dropped."""
_SILENT_LIMIT = 20.0  # s of wall time with a full queue until a page is disconnected


class Socket(Protocol):
    """The part of a WebSocket's interface that a session uses."""

    def send(self, data: str | bytes, done: Callable[[], None]) -> None:
        """Send a message; ``done`` is called when the operating system has it."""

    def close(self) -> None:
        """Close the connection."""


class Session:
    """A page's connection.

    Attributes:
        number: of the connection since the station's start.
        role: what it may do.
        left_out: pushed messages that were dropped because the page reads too slowly.
    """

    def __init__(self, number: int, role: Role, socket: Socket, in_loop: Callable[[Callable[[], None]], None]) -> None:
        """Serve a connection.

        Args:
            number: of the connection.
            role: that its token gave.
            socket: sends messages, in the event loop's thread.
            in_loop: calls a function in the event loop's thread; may be called in any.
        """
        self.number = number
        self.role = role
        self.left_out = 0
        self._socket = socket
        self._in_loop = in_loop
        self._unsent = 0
        self._full_since: float | None = None
        self._pending_channels: set[int] = set()
        self._closing: list[Callable[[], None]] = []
        self._loop_thread = threading.get_ident()
        self.closed = False

    def push(self, event: str, data: Any) -> None:
        """Send an event, unless too much waits; may be called in any thread."""
        self.push_text(encode({"event": event, "data": data}))

    def push_text(self, text: str) -> None:
        """Send an event that is encoded already, as ``push`` does."""
        self._run(lambda: self._send(text, droppable=True))

    def push_binary(self, channel: int, payload: bytes) -> None:
        """Send a binary frame, unless too much waits; may be called in any thread.

        Args:
            channel: first byte of the frame, 0 to 255.
            payload: the rest.
        """
        frame = bytes([channel]) + payload
        self._run(lambda: self._send(frame, droppable=True))

    def push_latest(self, channel: int, payload: bytes) -> None:
        """Send a binary frame, unless the last one of this channel still waits: only the newest frame matters."""
        if channel in self._pending_channels or self.closed:
            self.left_out += 1
            return
        self._pending_channels.add(channel)
        frame = bytes([channel]) + payload
        self._run(lambda: self._send(frame, done=lambda: self._pending_channels.discard(channel)))

    def answer(self, content: dict[str, Any]) -> None:
        """Send the answer to a call."""
        self._send(encode(content))

    def on_close(self, callback: Callable[[], None]) -> None:
        """Call a function, in the event loop, when the page has disconnected."""
        self._closing.append(callback)

    def close(self) -> None:
        """End the session and call the registered functions."""
        if self.closed:
            return
        self.closed = True
        self._socket.close()
        for callback in self._closing:
            callback()

    def _run(self, action: Callable[[], None]) -> None:
        if threading.get_ident() == self._loop_thread:
            action()
        else:
            self._in_loop(action)

    def _send(self, data: str | bytes, *, droppable: bool = False, done: Callable[[], None] | None = None) -> None:
        if self.closed:
            return
        if self._unsent > MOST_UNSENT:
            self._note_full()
            if droppable:
                self.left_out += 1
                return
        else:
            self._full_since = None
        size = len(data)
        self._unsent += size

        def sent() -> None:
            self._unsent -= size
            if done is not None:
                done()

        self._socket.send(data, sent)

    def _note_full(self) -> None:
        now = time.monotonic()
        if self._full_since is None:
            self._full_since = now
        elif now - self._full_since > _SILENT_LIMIT:
            self.close()


def encode(content: Any) -> str:
    """Return JSON text that browsers accept: NaN and infinity, which JSON lacks, become null."""
    try:
        return json.dumps(content, allow_nan=False, separators=(",", ":"))
    except ValueError:
        return json.dumps(_finite(content), allow_nan=False, separators=(",", ":"))


def _finite(value: Any) -> Any:
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, dict):
        return {key: _finite(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(entry) for entry in value]
    return value
