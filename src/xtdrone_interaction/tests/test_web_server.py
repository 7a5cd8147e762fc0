"""The station's server against strangers, careless pages and slow browsers."""

from __future__ import annotations

import asyncio
import contextlib
import gzip
import json
import re
import socket
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

import pytest
from tornado.httpclient import AsyncHTTPClient, HTTPClientError, HTTPRequest
from tornado.websocket import WebSocketClientConnection, websocket_connect

from xtdrone_interaction import server_port
from xtdrone_interaction.web.server import session as sessions
from xtdrone_interaction.web.server import station_server
from xtdrone_interaction.web.server.credentials import Credentials
from xtdrone_interaction.web.server.methods import Method, MethodTable, Params, invoke
from xtdrone_interaction.web.server.session import Session, encode
from xtdrone_interaction.web.server.station_server import (
    MOST_CALLS,
    MOST_MESSAGE,
    MOST_SESSIONS,
    NO_HELLO,
    Address,
    StationServer,
)

PAGE = Path(__file__).parents[1] / "web_page"
TOKENS = Credentials("operate-token", "view-token")


class Station:
    """A server on a port of its own, with the methods ``echo``, ``fly`` (operate), ``fail`` and ``hang``."""

    def __init__(self, page: Path, credentials: Credentials = TOKENS, host: str = "127.0.0.1") -> None:
        self.flown: list[Any] = []
        self.actions: list[tuple[str, Any]] = []
        self.go = asyncio.Event()
        methods = [
            Method("echo", lambda _, params: params),
            Method("fly", lambda _, params: self.flown.append(params), "operate"),
            Method("fail", lambda *_: 1 / 0),
            Method("hang", lambda *_: self.go.wait()),
        ]
        self.server = StationServer(Address(host, 0, credentials), page, methods, self._operate)
        self.port = self.server.start()

    async def _operate(self, method: Method, session: Session, params: Params) -> Any:
        self.actions.append((method.name, params))
        return await invoke(method, session, params)

    async def connect(self, **headers: str) -> WebSocketClientConnection:
        return await websocket_connect(HTTPRequest(f"ws://127.0.0.1:{self.port}/ws", headers=headers))

    async def greeted(self, token: str = TOKENS.operate) -> WebSocketClientConnection:
        connection = await self.connect()
        assert (await ask(connection, "hello", {"token": token}))["result"]["role"] in ("view", "operate")
        return connection


async def ask(connection: WebSocketClientConnection, method: Any, params: Any = None) -> dict[str, Any]:
    """Call a method and return the answer."""
    await connection.write_message(json.dumps({"id": 7, "method": method, "params": params}))
    return json.loads(await asyncio.wait_for(connection.read_message(), 10.0) or "{}")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A page's folder with neighbours that must not be served."""
    page = tmp_path / "page"
    (page / "panels").mkdir(parents=True)
    (page / "index.html").write_text("the page")
    (page / "panels" / "a.js").write_text("a panel")
    (page / ".hidden").write_text("secret")
    (tmp_path / "secret.txt").write_text("secret")
    (page / "link.txt").symlink_to(tmp_path / "secret.txt")
    return page


def run(test: Callable[[], Awaitable[None]]) -> None:
    async def limited() -> None:
        await asyncio.wait_for(test(), 30.0)

    asyncio.run(limited())


def raw(port: int, request: str) -> bytes:
    """Return the answer to a request that no browser would send."""
    with socket.create_connection(("127.0.0.1", port), timeout=10.0) as connection:
        connection.sendall(request.encode())
        answer = b""
        while piece := connection.recv(65536):
            answer += piece
        return answer


def test_only_the_files_of_the_page_are_served(folder: Path) -> None:
    async def test() -> None:
        station = Station(folder)

        def get(path: str, host: str = "127.0.0.1") -> bytes:
            return raw(station.port, f"GET {path} HTTP/1.1\r\nHost: {host}:{station.port}\r\nConnection: close\r\n\r\n")

        async def fetched(*given: str) -> bytes:
            return await asyncio.to_thread(get, *given)

        assert (await fetched("/")).endswith(b"the page")
        assert b"frame-ancestors 'none'" in await fetched("/panels/a.js")
        outside = ("/../secret.txt", "/%2e%2e/secret.txt", "//etc/passwd", "/panels/..%2f..%2fsecret.txt", "/link.txt",
                   "/.hidden", "/panels/../../secret.txt", "/%00", "/..%5csecret.txt")  # fmt: skip
        for path in outside:
            answer = await fetched(path)
            assert answer.startswith(b"HTTP/1.1 4"), (path, answer)
            assert b"secret" not in answer.partition(b"\r\n\r\n")[2]
            assert b"root:" not in answer
        assert (await fetched("/", "evil.example")).startswith(b"HTTP/1.1 403")
        station.server.stop()

    run(test)


def test_files_are_sent_packed_once_and_then_only_if_they_have_changed() -> None:
    async def test() -> None:
        station = Station(PAGE)

        async def fetched(**headers: str) -> Any:
            url = f"http://127.0.0.1:{station.port}/vendor/three.js"
            request = HTTPRequest(url, headers=headers, decompress_response=False)
            return await AsyncHTTPClient().fetch(request, raise_error=False)

        first = await fetched(**{"Accept-Encoding": "gzip"})
        assert first.headers["Content-Encoding"] == "gzip"
        whole = (PAGE / "vendor" / "three.js").read_bytes()
        assert gzip.decompress(first.body) == whole
        assert len(first.body) < 0.4 * len(whole)
        assert (await fetched(**{"If-None-Match": first.headers["Etag"]})).code == 304
        assert (await fetched()).body == whole
        station.server.stop()

    run(test)


def test_all_modules_of_the_page_are_asked_for_at_once() -> None:
    """Otherwise a browser finds a module only when it has read the one that imports it."""
    modules = {str(path.relative_to(PAGE)) for path in PAGE.rglob("*.js")} - {"app.js", "vendor/three_names.js"}
    text = (PAGE / "index.html").read_text(encoding="utf-8")
    assert set(re.findall(r'<link rel="modulepreload" href="([^"]+)">', text)) == modules


def test_a_stranger_can_do_nothing(folder: Path) -> None:
    async def test() -> None:
        station = Station(folder)
        for first in (
            {"id": 1, "method": "hello", "params": {"token": "wrong-token"}},
            {"id": 1, "method": "hello", "params": {"token": None}},
            {"id": 1, "method": "hello", "params": {}},
            {"id": 1, "method": "hello", "params": []},
            {"id": 1, "method": "fly", "params": {"token": TOKENS.operate}},
            {"id": 1, "method": "echo"},
            "hello",
            None,
        ):
            connection = await station.connect()
            await connection.write_message(json.dumps(first))
            assert await connection.read_message() is None, first
            assert connection.close_code == 4401
        connection = await station.connect()
        await connection.write_message(b"\x01\x02", binary=True)
        assert await connection.read_message() is None
        for headers in ({"Origin": "http://evil.example"}, {"Origin": "null"}, {"Host": "evil.example"}):
            with pytest.raises(HTTPClientError, match="403"):
                await station.connect(**headers)
        assert (station.flown, station.actions, station.server.sessions) == ([], [], {})
        station.server.stop()

    run(test)


def test_sockets_without_hello_lock_no_page_out(folder: Path) -> None:
    async def test() -> None:
        station = Station(folder)
        page = await station.greeted()
        silent = [await station.connect() for _ in range(MOST_SESSIONS - 1)]
        late = await station.greeted()
        assert await silent[0].read_message() is None
        assert silent[0].close_code == NO_HELLO
        assert (await ask(silent[1], "hello", {"token": TOKENS.view}))["result"]["role"] == "view"
        await asyncio.gather(*(ask(other, "hello", {"token": TOKENS.view}) for other in silent[2:]))
        assert len(station.server.sessions) == MOST_SESSIONS
        with pytest.raises(HTTPClientError, match="503"):  # all are pages now
            await station.connect()
        silent[5].close()
        while len(station.server.sessions) == MOST_SESSIONS:
            await asyncio.sleep(0)
        await station.greeted()
        for one in (page, late):
            assert (await ask(one, "echo", {"b": 2}))["result"] == {"b": 2}
        station.server.stop()

    run(test)


def test_a_socket_that_has_yielded_cannot_log_in(folder: Path) -> None:
    async def test() -> None:
        station = Station(folder)
        await station.connect()
        while not station.server.without_hello:
            await asyncio.sleep(0)
        socket = next(iter(station.server.without_hello))
        socket._yield("no hello")
        await socket.on_message(json.dumps({"id": 1, "method": "hello", "params": {"token": TOKENS.operate}}))
        assert (station.server.sessions, station.server.open_sockets) == ({}, 0)
        station.server.stop()

    run(test)


def test_a_late_hello_has_a_closing_code_of_its_own(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The page gives up after the code of a wrong token only."""
    monkeypatch.setattr(station_server, "_HELLO_LIMIT", 0.0)

    async def test() -> None:
        station = Station(folder)
        connection = await station.connect()
        assert await connection.read_message() is None
        assert connection.close_code == NO_HELLO
        while station.server.open_sockets:
            await asyncio.sleep(0)
        station.server.stop()

    run(test)
    text = (PAGE / "station.js").read_text(encoding="utf-8")
    assert re.findall(r"(\d+); // closing code", text) == [str(station_server.WRONG_TOKEN)]
    assert text.count("if (refused) return;") == text.count("refused = code === WRONG_TOKEN") == 1


def test_connections_that_ask_for_nothing_yield(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(server_port, "MOST_CONNECTIONS", 4)

    async def test() -> None:
        station = Station(folder)
        page = await station.greeted()
        mute = [socket.create_connection(("127.0.0.1", station.port), timeout=10.0) for _ in range(6)]
        for one in mute:
            one.sendall(b"GET / HTTP/1.1\r\n")  # and no end of the headers
        assert (await AsyncHTTPClient().fetch(f"http://127.0.0.1:{station.port}/")).body == b"the page"
        for one in mute[:3]:  # a connection of the client is the newest
            with contextlib.suppress(ConnectionResetError):
                assert await asyncio.to_thread(one.recv, 1) == b""
        assert (await ask(page, "echo", {"b": 2}))["result"] == {"b": 2}
        station.server.stop()
        for one in mute:
            one.close()

    run(test)


def test_roles(folder: Path) -> None:
    async def test() -> None:
        station = Station(folder)
        viewer, operator = await station.greeted(TOKENS.view), await station.greeted()
        assert (await ask(viewer, "echo", {"a": 1}))["result"] == {"a": 1}
        assert "may only watch" in (await ask(viewer, "fly", {"vehicle": 3}))["error"]
        assert (station.flown, station.actions) == ([], [])
        assert (await ask(operator, "fly", {"vehicle": 3}))["result"] is None
        assert station.flown == [{"vehicle": 3}]
        assert station.actions == [("fly", {"vehicle": 3})]
        station.server.stop()

    run(test)


def test_wrong_messages_are_answered_and_harm_nobody(folder: Path) -> None:
    async def test() -> None:
        station = Station(folder)
        page, other = await station.greeted(), await station.greeted()
        for text, reason in (
            ("{", "JSON text"),
            ("[1]", "an object"),
            ("[" * 100_000, "JSON text"),
            ('{"id": 1, "method": "nothing"}', "'nothing' is not allowed, one of echo, fail, fly, hang"),
            ('{"id": 1, "method": ["echo"]}', "is not allowed"),
            ('{"id": 1, "method": "echo", "params": 3}', "params: int is not allowed"),
            ('{"id": 1, "method": "fail"}', "ZeroDivisionError"),
        ):
            await page.write_message(text)
            assert reason in json.loads(await page.read_message() or "")["error"], text
        await page.write_message(b"\x00", binary=True)
        assert "binary is not allowed" in str(await page.read_message())
        for _ in range(MOST_CALLS):
            await page.write_message('{"id": 2, "method": "hang"}')
        assert f"fewer than {MOST_CALLS}" in (await ask(page, "echo"))["error"]
        station.go.set()
        await page.write_message("x" * (MOST_MESSAGE + 1))
        while await page.read_message() is not None:
            pass
        assert (await ask(other, "echo", {"b": 2}))["result"] == {"b": 2}
        assert len(station.server.sessions) == 1
        station.server.stop()

    run(test)


def test_a_slow_browser_costs_no_memory_and_no_other_page(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    async def test() -> None:
        station = Station(folder)
        slow = socket.create_connection(("127.0.0.1", station.port))
        slow.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        key = "Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\nSec-WebSocket-Version: 13"
        slow.sendall(f"GET /ws HTTP/1.1\r\nHost: 127.0.0.1:{station.port}\r\nUpgrade: websocket\r\n"
                     f"Connection: Upgrade\r\n{key}\r\n\r\n".encode())  # fmt: skip
        hello = json.dumps({"id": 1, "method": "hello", "params": {"token": TOKENS.view}}).encode()
        slow.sendall(bytes([0x81, 0x80 | len(hello), 0, 0, 0, 0]) + hello)
        while not station.server.sessions:
            await asyncio.sleep(0)
        (session,) = station.server.sessions.values()
        page = await station.greeted()
        for number in range(100):
            session.push_binary(2, bytes(1 << 18))
            session.push_latest(1, bytes(1 << 16))
            assert (await ask(page, "echo", {"n": number}))["result"] == {"n": number}
        assert session._unsent < sessions.MOST_UNSENT + (1 << 19)
        assert session.left_out > 100
        monkeypatch.setattr(sessions, "_SILENT_LIMIT", 0.0)
        session.push("more", 1)
        session.push("more", 2)
        assert session.closed
        slow.close()
        while len(station.server.sessions) > 1:
            await asyncio.sleep(0)
        assert (await ask(page, "echo"))["result"] == {}
        station.server.stop()

    run(test)


def test_other_machines_need_a_token() -> None:
    assert Credentials.for_host("127.0.0.1").role("") == "operate"
    open_to_all = Credentials.for_host("0.0.0.0")
    assert open_to_all.role("") is None
    assert open_to_all.role(open_to_all.operate) == "operate"
    assert open_to_all.role(open_to_all.view) == "view"
    assert Credentials.for_host("0.0.0.0").operate != open_to_all.operate
    assert Credentials.for_host("127.0.0.1", "my-own-token").role("") is None
    watching = Credentials.for_host("127.0.0.1", view_only=True)
    assert watching.role("") == "view"
    for token in (None, 3, ["a"], {}, "\N{DEGREE SIGN}"):
        assert open_to_all.role(token) is None


def test_the_token_is_in_the_fragment() -> None:
    urls = Address("0.0.0.0", 0, TOKENS).urls(8642)
    assert urls["operate"].endswith(":8642/#token=operate-token")
    assert Address("127.0.0.1", 0, Credentials()).urls(80) == {"operate": "http://127.0.0.1:80/"}


def test_methods_have_one_home_and_numbers_are_json() -> None:
    with pytest.raises(ValueError, match="'a' is declared twice"):
        MethodTable([Method("a", lambda *_: 1), Method("a", lambda *_: 2)])
    assert encode({"x": [float("nan"), 1.5, float("inf")]}) == '{"x":[null,1.5,null]}'


def test_a_closed_session_tells_its_rooms_once(folder: Path) -> None:
    async def test() -> None:
        station = Station(folder)
        page = await station.greeted()
        (session,) = station.server.sessions.values()
        closed: list[Session] = []
        session.on_close(lambda: closed.append(session))
        page.close()
        while station.server.sessions:
            await asyncio.sleep(0)
        session.close()
        session.push("late", 1)
        assert closed == [session]
        station.server.stop()

    run(test)
