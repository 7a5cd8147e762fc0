"""Program that reads the station's frames as browsers do: WebSocket clients that only receive.

Usage: ``python -m benchmarks.nodes.web_clients URL NUMBER``. It prints ``reading`` when all clients receive frames of
the fleet, reads until its standard input ends, and prints JSON: ``clients``, ``frames`` and ``bytes`` of the fleet's
frames from then on, and ``elapsed`` (s).
"""

from __future__ import annotations

import asyncio
import json
import sys
import time
from contextlib import suppress
from urllib.parse import urlsplit

from tornado.websocket import WebSocketClientConnection, websocket_connect

from xtdrone_interaction.web.fleet.fleet_frame import CHANNEL


class Reader:
    """One client.

    Attributes:
        frames: of the fleet, received so far.
        size: their bytes.
        first: set by the first one.
    """

    def __init__(self) -> None:
        self.frames = 0
        self.size = 0
        self.first = asyncio.Event()

    async def run(self, url: str) -> None:
        """Connect and read until cancelled, or until the station closes the connection."""
        parts = urlsplit(url)
        socket: WebSocketClientConnection = await websocket_connect(f"ws://{parts.netloc}/ws")
        token = parts.fragment.removeprefix("token=")
        await socket.write_message(json.dumps({"id": 1, "method": "hello", "params": {"token": token}}))
        try:
            while (message := await socket.read_message()) is not None:
                if isinstance(message, bytes) and message[0] == CHANNEL:
                    self.frames += 1
                    self.size += len(message)
                    self.first.set()
        finally:
            socket.close()


async def read(url: str, number: int) -> dict[str, float]:
    """Read with a number of clients until standard input ends, and return what has been received.

    Raises:
        ConnectionError, and others of tornado: the station does not serve a client.
    """
    readers = [Reader() for _ in range(number)]
    tasks = [asyncio.ensure_future(reader.run(url)) for reader in readers]
    for reader, task in zip(readers, tasks, strict=True):
        first = asyncio.ensure_future(reader.first.wait())
        await asyncio.wait({first, task}, return_when=asyncio.FIRST_COMPLETED)
        if task.done():
            task.result()  # raises why it could not connect
            raise ConnectionError(f"station: {url} has closed the connection")
    for reader in readers:
        reader.frames = reader.size = 0
    begin = time.perf_counter()
    print("reading", flush=True)
    await asyncio.get_running_loop().run_in_executor(None, sys.stdin.read)
    elapsed = time.perf_counter() - begin
    for task in tasks:
        task.cancel()
        with suppress(asyncio.CancelledError):
            await task
    return {
        "clients": number,
        "frames": sum(reader.frames for reader in readers),
        "bytes": sum(reader.size for reader in readers),
        "elapsed": elapsed,
    }


if __name__ == "__main__":
    print(json.dumps(asyncio.run(read(sys.argv[1], int(sys.argv[2])))), flush=True)
