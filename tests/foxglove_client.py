"""A client of Foxglove's WebSocket protocol, with the operations that the tests need, on the package websockets.

Source: the specification in foxglove/ws-protocol (docs/spec.md), of which ``foxglove.sdk.v1`` is the present name.
"""

from __future__ import annotations

import contextlib
import json
import struct
import time
from collections.abc import Callable
from typing import Any

from websockets.sync.client import connect
from websockets.typing import Subprotocol

_MESSAGE, _TIME, _RESPONSE = 1, 2, 3  # op codes of the server's binary frames
_PUBLISH, _CALL = 1, 2  # op codes of the client's


class FoxgloveClient:
    """A connection.

    Attributes:
        channels, services: as advertised, by topic and name.
        received: serialised messages by subscription.
        times: simulated times, ns.
        frames: all others.
    """

    def __init__(self, port: int) -> None:
        self._exit = contextlib.ExitStack()
        protocols = [Subprotocol("foxglove.sdk.v1")]
        limits: Any = {"max_size": None, "open_timeout": 60, "close_timeout": 0.1, "ping_interval": None}
        connection = connect(f"ws://127.0.0.1:{port}", subprotocols=protocols, **limits)
        self._socket = self._exit.enter_context(connection)
        self.channels: dict[str, Any] = {}
        self.services: dict[str, Any] = {}
        self.received: dict[int, list[bytes]] = {}
        self.times: list[int] = []
        self.frames: list[Any] = []

    def close(self) -> None:
        self._exit.close()

    def send(self, frame: Any) -> None:
        """Send an operation, or a frame as it is."""
        self._socket.send(json.dumps(frame) if isinstance(frame, dict) else frame)

    def subscribe(self, topic: str) -> int:
        """Subscribe to a topic and return the subscription's number."""
        number = self.channels[topic]["id"] + 1000
        self.received[number] = []
        self.send({"op": "subscribe", "subscriptions": [{"id": number, "channelId": self.channels[topic]["id"]}]})
        return number

    def publish(self, channel: int, data: bytes) -> None:
        self.send(struct.pack("<BI", _PUBLISH, channel) + data)

    def call(self, name: str, request: bytes, number: int) -> None:
        self.send(struct.pack("<BIII", _CALL, self.services[name]["id"], number, 4) + b"ros1" + request)

    def wait(self, condition: Callable[[], Any], limit: float = 60.0) -> Any:
        """Receive frames until a condition holds; return its value."""
        end = time.monotonic() + limit
        while not (value := condition()):
            assert time.monotonic() < end, f"not within {limit:g} s; the last frames are {self.frames[-5:]}"
            self.take()
        return value

    def take(self) -> None:
        """Receive a frame, if one arrives soon."""
        try:
            frame = self._socket.recv(timeout=0.2)
        except TimeoutError:
            return
        if isinstance(frame, str):
            self._take_operation(json.loads(frame))
        elif frame[0] == _MESSAGE:
            self.received[struct.unpack_from("<I", frame, 1)[0]].append(frame[13:])
        elif frame[0] == _TIME:
            self.times.append(struct.unpack_from("<Q", frame, 1)[0])
        elif frame[0] == _RESPONSE:
            _, number, length = struct.unpack_from("<III", frame, 1)
            self.frames.append({"op": "response", "callId": number, "data": frame[13 + length :]})

    def _take_operation(self, operation: Any) -> None:
        if operation["op"] == "advertise":
            self.channels |= {channel["topic"]: channel for channel in operation["channels"]}
        elif operation["op"] == "advertiseServices":
            self.services |= {service["name"]: service for service in operation["services"]}
        else:
            self.frames.append(operation)

    def last(self, op: str, **fields: Any) -> Any:
        """Return the last frame of an operation with these fields, None if there is none."""
        chosen = [f for f in self.frames if f["op"] == op and all(f.get(n) == v for n, v in fields.items())]
        return chosen[-1] if chosen else None
