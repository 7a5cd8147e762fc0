"""The port of Foxglove's clients: checks Host and Origin of a handshake, then passes bytes to and from foxglove-sdk.

The SDK (0.30.3) accepts every web page, and has no hook before a connection stands. So it listens on an address of
loopback that is chosen at random (24 bits) with any free port, which no web page can find, and clients connect here.
"""

from __future__ import annotations

import asyncio
import contextlib
import secrets
import threading
from collections.abc import Coroutine
from typing import Any

from tornado.httputil import HTTPHeaders, HTTPInputError
from tornado.netutil import bind_sockets

from xtdrone_interaction.server_guard import ServerGuard

_HEAD_LIMIT = 10.0  # s for a client's request
_BUFFER = 1 << 18  # bytes that wait for a slow end of a connection, besides the kernel's
_HEAD_END = b"\r\n\r\n"
_PLAIN = "Content-Type: text/plain\r\nConnection: close\r\n"


def hidden_address() -> str:
    """Return a random address of loopback, of which Linux has 127.0.0.0/8."""
    first, second, third = secrets.token_bytes(3)
    return f"127.{first}.{second}.{third}"


class GuardedPort:
    """A listening port, served by a thread of its own.

    Attributes:
        port: TCP port.
    """

    def __init__(self, guard: ServerGuard, address: str, port: int) -> None:
        """Open the port.

        Args:
            guard: rules for the clients' requests.
            address: listening address.
            port: TCP port; 0: any free one.

        Raises:
            OSError: it cannot be opened.
        """
        self._guard = guard
        self._sockets = bind_sockets(port, address, reuse_port=False)
        self.port = int(self._sockets[0].getsockname()[1])
        self._inner = ("", 0)
        self._loop = asyncio.new_event_loop()
        self._closed = asyncio.Event()

    def serve(self, address: str, port: int) -> None:
        """Begin to pass connections on to a server at an address and TCP port of this machine."""
        self._inner = (address, port)
        threading.Thread(target=self._loop.run_until_complete, args=(self._run(),), name="port", daemon=True).start()

    def close(self) -> None:
        """Close the port and all connections."""
        self._loop.call_soon_threadsafe(self._closed.set)

    async def _run(self) -> None:
        servers = [await asyncio.start_server(self._connected, sock=s, limit=_BUFFER) for s in self._sockets]
        await self._closed.wait()
        for server in servers:
            server.close()
        connections = asyncio.all_tasks() - {asyncio.current_task()}
        for task in connections:
            task.cancel()
        await asyncio.gather(*connections, return_exceptions=True)

    async def _connected(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with contextlib.closing(writer), contextlib.suppress(OSError, EOFError, asyncio.LimitOverrunError):
            async with asyncio.timeout(_HEAD_LIMIT):
                head = await reader.readuntil(_HEAD_END)
            status = self._refusal(head)
            if status:
                writer.write(f"HTTP/1.1 {status}\r\n{_PLAIN}Content-Length: {len(status)}\r\n\r\n{status}".encode())
                await writer.drain()
                return
            inner_reader, inner_writer = await asyncio.open_connection(*self._inner, limit=_BUFFER)
            with contextlib.closing(inner_writer):
                inner_writer.write(head)
                await _first_of(_pass_on(reader, inner_writer), _pass_on(inner_reader, writer))

    def _refusal(self, head: bytes) -> str:
        """Return the status of a refused request, empty for a handshake that is allowed."""
        request, _, lines = head.decode("latin-1").partition("\r\n")
        try:
            headers = HTTPHeaders.parse(lines)
        except (HTTPInputError, ValueError):
            return "400 Bad Request"
        if self._guard.refusal(headers):
            return "403 Forbidden"
        is_handshake = request.startswith("GET ") and headers.get("Upgrade", "").lower() == "websocket"
        return "" if is_handshake else "426 Upgrade Required"


async def _first_of(*directions: Coroutine[Any, Any, None]) -> None:
    """Wait for the end of a connection in one direction, which ends the other one."""
    tasks = [asyncio.ensure_future(direction) for direction in directions]
    try:
        await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)


async def _pass_on(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    while data := await reader.read(_BUFFER):
        writer.write(data)
        await writer.drain()
