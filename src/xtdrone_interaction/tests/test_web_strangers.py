"""Access of strangers, and of pages that may only watch, to each route and method of the real station."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("rospy")

from tornado.httpclient import AsyncHTTPClient, HTTPClientError, HTTPRequest
from tornado.websocket import WebSocketClientConnection, websocket_connect

from xtdrone_interaction.web.context import StationContext
from xtdrone_interaction.web.rooms import methods_of_rooms
from xtdrone_interaction.web.server.credentials import Credentials
from xtdrone_interaction.web.server.methods import Method
from xtdrone_interaction.web.server.station_server import Address, StationServer, routes
from xtdrone_interaction.web.station_settings import StationSettings

TOKENS = Credentials("operate-token", "view-token")
PAGE = Path(__file__).resolve().parents[1] / "web_page"
ROUTES = ("/ws", "/(.*)")
WATCHING = {
    "console.close", "console.open", "fleet.formation", "fleet.roster", "graph.read", "images.close", "images.list",
    "images.open", "layers.close", "layers.list", "layers.open",
    "map.missions", "map.plan", "map.search", "parameters.definitions", "parameters.ros",
    "parameters.vehicle", "plots.close", "plots.open", "recordings.frames", "recordings.list", "recordings.open",
    "recordings.picture", "recordings.state", "steering.alive", "swarm.patterns", "time.status", "topics.close",
    "topics.echo", "topics.fields", "topics.list", "topics.measure", "topics.rates", "world.describe", "world.mesh",
    "world.texture", "world.vehicle",
}  # fmt: skip
"""Methods that change nothing. Enter a new one here after a check of what it tells."""
OPERATING = {
    "map.upload", "parameters.pull", "parameters.set_ros", "parameters.set_vehicle", "recordings.start",
    "recordings.stop", "steering.close", "steering.key", "steering.open", "steering.send", "steering.sticks",
    "steering.stop", "swarm.command", "swarm.draw", "time.control", "time.reset", "topics.publish", "vehicles.command",
}  # fmt: skip
"""Methods that change something: refused to pages that may only watch."""


class Guarded:
    """A server with the real rooms, whose methods record their calls and do nothing."""

    def __init__(self, context: StationContext) -> None:
        self.called: list[str] = []
        self.methods = [self._noting(method) for method in methods_of_rooms(context, StationSettings())]
        self.server = StationServer(Address("127.0.0.1", 0, TOKENS), PAGE, self.methods, sessions=context.sessions)
        self.port = self.server.start()

    def _noting(self, method: Method) -> Method:
        return replace(method, call=lambda *_: self.called.append(method.name))

    def names(self, role: str) -> set[str]:
        return {method.name for method in self.methods if method.role == role}

    async def connect(self) -> WebSocketClientConnection:
        return await websocket_connect(f"ws://127.0.0.1:{self.port}/ws")


@asynccontextmanager
async def guarded() -> AsyncIterator[Guarded]:
    context = StationContext("http://127.0.0.1:9", "/web_station")
    station = Guarded(context)
    try:
        yield station
    finally:
        station.server.stop()
        context.close()


async def ask(connection: WebSocketClientConnection, method: str, **params: Any) -> dict[str, Any]:
    await connection.write_message(json.dumps({"id": 1, "method": method, "params": params}))
    answer = await asyncio.wait_for(connection.read_message(), 10.0)
    assert isinstance(answer, str)
    return dict(json.loads(answer))


def test_each_method_is_refused_to_a_stranger_and_each_command_to_a_watcher() -> None:
    async def test() -> None:
        async with guarded() as station:
            assert station.names("view") == WATCHING
            assert station.names("operate") == OPERATING
            for name in sorted(WATCHING | OPERATING):
                for token in ({}, {"token": TOKENS.operate}):  # only hello accepts a token
                    stranger = await station.connect()
                    await stranger.write_message(json.dumps({"id": 1, "method": name, "params": token}))
                    assert await asyncio.wait_for(stranger.read_message(), 10.0) is None, name
                    assert stranger.close_code == 4401
            assert (station.called, station.server.sessions) == ([], {})
            watcher = await station.connect()
            assert (await ask(watcher, "hello", token=TOKENS.view))["result"]["role"] == "view"
            for name in sorted(OPERATING):
                assert "may only watch" in (await ask(watcher, name))["error"]
            assert station.called == []
            for name in sorted(WATCHING):
                assert "error" not in await ask(watcher, name)
            assert station.called == sorted(WATCHING)

    asyncio.run(test())


def test_each_route_gives_a_stranger_the_page_s_files_alone() -> None:
    async def test() -> None:
        async with guarded() as station:
            assert tuple(route[0] for route in routes(station.server)) == ROUTES
            client = AsyncHTTPClient()
            root = f"http://127.0.0.1:{station.port}"
            assert b"<title>XTDrone station</title>" in (await client.fetch(f"{root}/")).body
            for path in ("/ws", "/api", "/runs/", "/panels/", "/../package.xml"):
                for method in ("GET", "POST", "PUT", "DELETE", "PATCH", "OPTIONS"):
                    body = b"" if method in ("POST", "PUT", "PATCH") else None
                    request = HTTPRequest(f"{root}{path}", method, body=body)
                    with pytest.raises(HTTPClientError) as refused:
                        await client.fetch(request)
                    assert refused.value.code in (400, 403, 404, 405), (path, method)
            assert (station.called, station.server.sessions) == ([], {})

    asyncio.run(test())
