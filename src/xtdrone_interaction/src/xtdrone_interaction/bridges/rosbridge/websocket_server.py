"""The WebSocket server of rosbridge's protocol: connections and their limits."""

from __future__ import annotations

import asyncio
import contextlib
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import tornado.netutil
import tornado.web
import tornado.websocket

from xtdrone_interaction.bridges.rosbridge.clients.session import Bridge, Session
from xtdrone_interaction.server_guard import ServerGuard
from xtdrone_interaction.server_port import BoundedHTTPServer

MAX_CLIENTS = 100
"""Connected clients; beyond them the oldest that has sent nothing yields."""
_ROOM = 1_000_000  # bytes sent but not yet received, above which messages are queued
_MOST_UNTAKEN = 32_000_000  # bytes; the connection of a client that lags further is closed
_PING = 10.0  # s between pings; a client that does not answer is disconnected
_WORKERS = 16  # threads that execute operations
_TOO_MANY = 1013  # close code "try again later"
_POLICY = 1008


class WebSocketServer:
    """Serves the sessions of clients on one port, in an asyncio loop."""

    def __init__(self, bridge: Bridge, max_message_size: int, guard: ServerGuard) -> None:
        """Initialise; ``listen`` opens the port.

        Args:
            bridge: resources shared by the sessions.
            max_message_size: maximum bytes of a client's frame.
            guard: rules for the clients' requests.
        """
        self.bridge = bridge
        self.guard = guard
        self.clients: dict[_Handler, None] = {}  # in order
        self.thread = 0  # identifier of the loop's
        self.workers = ThreadPoolExecutor(_WORKERS, "rosbridge")
        application = tornado.web.Application(
            [(r"/.*", _Handler, {"server": self})],
            websocket_ping_interval=_PING,
            websocket_max_message_size=max_message_size,
        )
        self._server = BoundedHTTPServer(application)

    def listen(self, port: int, address: str) -> int:
        """Open the port, from the loop's thread; return its number.

        Raises:
            OSError: it cannot be opened.
        """
        self.thread = threading.get_ident()
        sockets = tornado.netutil.bind_sockets(port, address, reuse_port=False)
        self._server.add_sockets(sockets)
        return int(sockets[0].getsockname()[1])

    async def close(self) -> None:
        """Close the port and all connections."""
        self._server.stop()
        for client in list(self.clients):
            client.close(1001, "the server ends")
        await self._server.close_all_connections()
        self.workers.shutdown(wait=False, cancel_futures=True)


class _Handler(tornado.websocket.WebSocketHandler):
    """The connection to one client; a ``Connection`` of its session."""

    def initialize(self, server: WebSocketServer) -> None:
        self._server = server
        self._untaken = 0
        self._session: Session | None = None
        self.is_silent = True  # it has sent nothing
        self._loop = asyncio.get_running_loop()

    def prepare(self) -> None:
        if self._server.guard.refusal(self.request.headers):
            raise tornado.web.HTTPError(403)

    def check_origin(self, origin: str) -> bool:
        return True  # checked with the host, by ``prepare``: tornado asks here for some origins only

    def select_subprotocol(self, subprotocols: list[str]) -> str | None:
        return subprotocols[0] if subprotocols else None

    def open(self, *_: str, **__: str) -> None:
        if len(self._server.clients) >= MAX_CLIENTS:
            yielding = next((client for client in self._server.clients if client.is_silent), self)
            yielding.close(_TOO_MANY, f"{MAX_CLIENTS} clients are connected, more are not allowed")
            if yielding is self:
                return
            yielding.on_close()
        self.set_nodelay(True)
        self._server.clients[self] = None
        self._session = Session(self._server.bridge, self)

    async def on_message(self, message: str | bytes) -> None:
        self.is_silent = False
        # The next frame is read after this one: a client that sends too fast waits, and the order is kept.
        if self._session is not None:
            await self._loop.run_in_executor(self._server.workers, self._session.handle, message)

    def on_close(self) -> None:
        self._server.clients.pop(self, None)
        session, self._session = self._session, None
        if session is not None:
            with contextlib.suppress(RuntimeError):  # the server has ended, and its threads
                self._server.workers.submit(session.close)

    # ---- the session's side

    def send(self, frame: str | bytes) -> None:
        """Send a frame; called from any thread."""
        if threading.get_ident() == self._server.thread:
            self._write(frame)  # so that has_room() counts it
        else:
            self.call_soon(lambda: self._write(frame))

    def has_room(self) -> bool:
        """Return whether the client has received most of the sent data."""
        return self._untaken < _ROOM

    def call_soon(self, function: Callable[[], None]) -> None:
        """Call a function in the loop; called from any thread."""
        with contextlib.suppress(RuntimeError):  # the loop has ended
            self._loop.call_soon_threadsafe(function)

    def call_later(self, delay: float, function: Callable[[], None]) -> None:
        """Call a function in the loop after a delay."""
        self._loop.call_later(delay, function)

    def _write(self, frame: str | bytes) -> None:
        size = len(frame)
        if self._untaken + size > max(_MOST_UNTAKEN, size):
            self.close(_POLICY, f"{self._untaken} bytes were not received")
            return
        try:
            written: Any = self.write_message(frame, binary=isinstance(frame, bytes))
        except tornado.websocket.WebSocketClosedError:
            return
        self._untaken += size
        asyncio.ensure_future(written).add_done_callback(lambda done: self._on_taken(done, size))

    def _on_taken(self, done: asyncio.Future[None], size: int) -> None:
        if not done.cancelled() and done.exception() is not None:
            return  # the connection is closed
        had_room = self.has_room()
        self._untaken -= size
        if not had_room and self.has_room() and self._session is not None:
            self._session.subscriptions.send_waiting()
