"""A client of the bridge's own server, without which foxglove-sdk can stop the process for good.

The SDK (0.30.3) calls the listener under a lock when the first client subscribes to the connection graph or to a
parameter, and when the last one leaves. ``publish_connection_graph`` and ``publish_parameter_values`` wait for these
locks while they hold Python's, which the listener needs: both wait for ever. With this client there is always a
subscriber of the graph, so the listener is not called for it; and changed parameters go through the SDK's answer to a
client that sets parameters, where it tells the subscribers without Python.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import secrets
import threading
from collections.abc import Sequence
from typing import Any

from foxglove import Parameter
from tornado.httpclient import HTTPClientError
from tornado.websocket import WebSocketClientConnection, WebSocketClosedError, WebSocketError, websocket_connect

PROTOCOL = "foxglove.sdk.v1"
_LONGEST = 1 << 30  # bytes of a frame
_CONNECT_LIMIT = 10.0  # s
_PATIENCE = 0.02  # s that a call waits for an answer, which comes within a millisecond on an idle machine
_RETRY = 1.0  # s between two connections


class StandingClient:
    """A connection in a thread of its own, made again whenever it breaks.

    Attributes:
        stands: whether the server counts this client as a subscriber of the connection graph.
    """

    def __init__(self, address: str, port: int) -> None:
        """Begin to connect.

        Args:
            address: on which the server listens.
            port: TCP port.
        """
        self.stands = False
        self._url = f"ws://{address}:{port}"
        self._secret = secrets.token_hex(16)  # no other client can pass its parameters off as the bridge's
        self._told: dict[str, list[Parameter]] = {}
        self._awaited = ""  # request whose answer has not been used
        self._answered = threading.Event()
        self._number = 0
        self._connection: WebSocketClientConnection | None = None
        self._loop = asyncio.new_event_loop()
        self._closed = asyncio.Event()
        threading.Thread(target=self._run, name="foxglove standing client", daemon=True).start()

    def answers(self) -> bool:
        """Return whether the graph may be published now: the server has sent this client all that waited for it.

        A client for which too much waits is disconnected, and the graph must not be published meanwhile. The server is
        asked by the first call, and a later one returns True once it has answered: no call waits for a slow server.
        """
        if not self.stands:
            return False
        if not self._awaited:
            self._awaited = self._new_request()
            self.tell_parameters([], self._awaited)
        if not self._answered.wait(_PATIENCE):
            return False
        self._awaited = ""
        self._answered.clear()
        return self.stands

    def tell_parameters(self, parameters: Sequence[Parameter], request: str = "") -> None:
        """Have the server tell parameters to the clients that watch them.

        Args:
            parameters: with their values.
            request: identifier; empty for a new one.
        """
        request = request or self._new_request()
        self._told[request] = list(parameters)
        self._loop.call_soon_threadsafe(self._send, {"op": "setParameters", "parameters": [], "id": request})

    def told(self, request: str | None) -> list[Parameter] | None:
        """Return the parameters of a request to set them; None for one of another client."""
        return self._told.pop(request, []) if request and request.startswith(self._secret) else None

    def close(self) -> None:
        """End the connection."""
        self._loop.call_soon_threadsafe(self._closed.set)

    def _new_request(self) -> str:
        self._number += 1
        return f"{self._secret} {self._number}"

    def _run(self) -> None:
        asyncio.set_event_loop(self._loop)
        self._loop.run_until_complete(self._connect_again_and_again())
        self._loop.close()

    async def _connect_again_and_again(self) -> None:
        closing = asyncio.ensure_future(self._closed.wait())
        while not self._closed.is_set():
            staying = asyncio.ensure_future(self._stay())
            await asyncio.wait({staying, closing}, return_when=asyncio.FIRST_COMPLETED)
            self._end_connection()
            staying.cancel()
            await asyncio.wait({staying})
            await asyncio.wait({closing}, timeout=_RETRY)

    async def _stay(self) -> None:
        """Connect, subscribe and read all that comes, until the connection breaks."""
        try:
            self._connection = await websocket_connect(
                self._url, connect_timeout=_CONNECT_LIMIT, max_message_size=_LONGEST, subprotocols=[PROTOCOL]
            )
        except (OSError, HTTPClientError, WebSocketError):  # the server has ended, or has too much to do
            return
        self._send({"op": "subscribeConnectionGraph"})
        while (frame := await self._connection.read_message()) is not None:
            if isinstance(frame, str):
                self._note(frame)

    def _note(self, frame: str) -> None:
        if not self.stands:
            self._awaited = ""  # of the connection before
            self._answered.clear()
            self.stands = json.loads(frame).get("op") == "connectionGraphUpdate"
        elif self._awaited and self._awaited in frame:
            self._answered.set()

    def _send(self, operation: dict[str, Any]) -> None:
        if self._connection is not None:
            with contextlib.suppress(WebSocketClosedError):
                sent = self._connection.write_message(json.dumps(operation))
                sent.add_done_callback(lambda future: future.exception())

    def _end_connection(self) -> None:
        self.stands = False
        self._told.clear()
        if self._connection is not None:
            self._connection.close()
            self._connection = None
