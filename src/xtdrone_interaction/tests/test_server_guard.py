"""The check of Host and Origin: its rules, and the three servers that make it."""

from __future__ import annotations

import asyncio
import base64
import contextlib
import errno
import random
import socket
import types
from collections.abc import AsyncIterator, Awaitable, Callable, Sequence
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("rospy")

import foxglove
from tornado.httputil import HTTPHeaders
from tornado.websocket import websocket_connect

from xtdrone_interaction.bridges.foxglove import guarded_port
from xtdrone_interaction.bridges.foxglove.guarded_port import GuardedPort, hidden_address
from xtdrone_interaction.bridges.rosbridge.websocket_server import WebSocketServer
from xtdrone_interaction.server_guard import ServerGuard, listed
from xtdrone_interaction.web.server.credentials import Credentials
from xtdrone_interaction.web.server.station_server import Address, StationServer

PAGE = Path(__file__).parents[1] / "web_page"
EVIL = "http://evil.example:9090"
SERVERS = ("station", "foxglove", "rosbridge")


def refusal(guard: ServerGuard, hosts: Sequence[str], origins: Sequence[str] = ()) -> str:
    headers = HTTPHeaders()
    for name, values in (("Host", hosts), ("Origin", origins)):
        for value in values:
            headers.add(name, value.strip())
    return guard.refusal(headers)


def allows(host: str, origin: str | None, listening: str = "127.0.0.1", **more: Any) -> bool:
    guard = ServerGuard("here", listening, report=lambda _: None, **more)
    return not refusal(guard, [host], [] if origin is None else [origin])


@pytest.mark.parametrize(
    ("host", "own"),
    [
        ("127.0.0.1:9090", True),
        ("localhost", True),
        ("LOCALHOST.:9090", True),
        ("[::1]:9090", True),
        ("[fe80::1%25eth0]:9090", True),
        ("10.0.0.2:9090", True),  # a name cannot be pointed at this machine if none is used
        ("evil.example:9090", False),
        ("localhost.evil.example", False),
        ("127.0.0.1.evil.example", False),
        ("evil.example,localhost", False),
        ("localhost@evil.example", False),
        ("::1", False),
        ("", False),
        ("[", False),
        ("[::1", False),
        ("localhost:9090:1", False),
    ],
)
def test_hosts_are_loopback_addresses_or_named(host: str, own: bool) -> None:
    assert allows(host, None) is own
    assert allows(host, "http://localhost:8000") is own


def test_names_of_the_machine_are_named_by_the_user() -> None:
    for more in ({"names": ["Robot.lan."]}, {"listening": "robot.lan"}):
        assert allows("robot.lan:9090", None, **more)
        assert not allows("evil.example:9090", None, **more)
        assert not allows("robot.lan:9090", EVIL, **more)
    assert not allows("robot.lan:9090", None)


@pytest.mark.parametrize(
    ("origin", "allowed"),
    [
        ("http://localhost:8000", True),
        ("HTTP://LocalHost.:8000", True),
        ("https://127.0.0.1", True),
        ("http://[::1]:8000", True),
        ("http://0.0.0.0:8000", True),  # as python3 -m http.server prints it
        ("http://127.0.0.1:9090", True),  # as the package websocket-client sends it
        (EVIL, False),
        ("http://10.0.0.2:9090", False),
        ("http://localhost.evil.example", False),
        ("http://localhost@evil.example", False),
        ("http://evil.example@localhost", False),
        ("http://evil.example/?localhost", False),
        ("http://evil.example,http://localhost", False),
        ("https://app.foxglove.dev", False),
        ("null", False),
        ("file://", False),
        ("http://[", False),
        ("http://", False),
        ("localhost", False),
        ("", False),
    ],
)
def test_pages_of_this_machine_may_connect(origin: str, allowed: bool) -> None:
    assert allows("127.0.0.1:9090", origin) is allowed
    assert allows("127.0.0.1:9090", origin, origins=["*"])
    assert allows("127.0.0.1:9090", origin, origins=[EVIL]) is (allowed or origin == EVIL)
    assert not allows("evil.example:9090", origin, origins=["*"])


@pytest.mark.parametrize(
    ("origin", "host", "listening", "own"),
    [
        ("http://127.0.0.1:8642", "127.0.0.1:8642", "127.0.0.1", True),
        ("http://localhost:8642", "localhost:8642", "127.0.0.1", True),
        (None, "[::1]:8642", "127.0.0.1", True),
        ("http://127.0.0.1:9000", "127.0.0.1:8642", "127.0.0.1", False),  # another server on this machine
        ("http://rebound.example:8642", "rebound.example:8642", "127.0.0.1", False),
        ("http://10.0.0.2:8642", "10.0.0.2:8642", "0.0.0.0", True),
        ("http://evil.example", "10.0.0.2:8642", "0.0.0.0", False),
        ("null", "127.0.0.1:8642", "127.0.0.1", False),
        ("http://[", "127.0.0.1:8642", "127.0.0.1", False),
    ],
)
def test_of_a_station_s_machine_only_its_own_page_may_connect(
    origin: str | None, host: str, listening: str, own: bool
) -> None:
    assert allows(host, origin, listening, own_page_only=True) is own


def test_in_a_network_pages_of_the_same_machine_may_connect() -> None:
    for host, listening in (("10.0.0.2:9090", "0.0.0.0"), ("10.0.0.2:9090", "10.0.0.2")):
        assert allows(host, "http://10.0.0.2:8000", listening)
        assert not allows(host, "http://10.0.0.3:8000", listening)
        assert not allows(host, EVIL, listening)
        assert not allows("evil.example:9090", EVIL, listening)


def test_no_header_is_an_error_and_none_of_another_page_passes() -> None:
    draw = random.Random(34)
    parts = ["http", "://", "localhost", "127.0.0.1", "[", "]", ":", "@", "/", ",", "::1", "%", "x", "é", " ", "9090"]
    guard = ServerGuard("here", "127.0.0.1", report=lambda _: None)
    for _ in range(5_000):
        text = "".join(draw.choices(parts, k=draw.randrange(8)))
        allowed = not refusal(guard, ["localhost"], [f"{text}evil.example"])
        assert not allowed, text
        assert refusal(guard, [f"{text}evil.example"])
        refusal(guard, [text], [text])


def test_a_header_that_is_sent_twice_is_refused() -> None:
    guard = ServerGuard("here", "127.0.0.1", report=lambda _: None)
    assert refusal(guard, ["localhost"], ["http://localhost", EVIL])
    assert refusal(guard, ["localhost"], ["http://localhost", "http://localhost"])
    assert refusal(guard, ["localhost", "localhost"])
    assert refusal(guard, [])


def test_the_log_has_the_setting_to_copy_once() -> None:
    told: list[str] = []
    guard = ServerGuard("bridge", "127.0.0.1", report=told.append)
    for origin in ("https://app.foxglove.dev", "null", "file://", "package://lichtblick"):
        assert refusal(guard, ["localhost"], [origin])
        setting = told[-1].partition("origins:=")[2].partition(" ")[0]
        assert allows("localhost", origin, origins=listed(setting))
    site = "https://app.foxglove.dev"
    assert told[0] == f"bridge: the web page of origin '{site}' is refused; origins:={site} allows it"
    assert refusal(guard, ["localhost"], [site]) == told[0]
    assert len(told) == 4
    refusal(guard, ["robot.lan:1"])
    assert "names:=robot.lan allows it" in told[-1]
    refusal(guard, ["localhost"], ["http://a;rm -rf ~;" + "x" * 10_000])
    assert "rm -rf" not in told[-1].partition(";")[2].rpartition("; ")[2]
    assert len(told[-1]) < 400
    for i in range(1000):
        refusal(guard, ["localhost"], [f"http://{i}.example"])
    assert len(told) < 200


# ---- the servers


@asynccontextmanager
async def serving(name: str, origins: Sequence[str]) -> AsyncIterator[int]:
    """A server of a kind; yields its port."""
    guard = ServerGuard(name, "127.0.0.1", origins, report=lambda _: None)
    if name == "station":
        place = Address("127.0.0.1", 0, Credentials(), tuple(origins))
        station = StationServer(place, PAGE, [], report=lambda _: None)
        yield station.start()
        station.stop()
    elif name == "rosbridge":
        bridge: Any = types.SimpleNamespace(
            raw=None, encoder=None, serve=None, call_limit=1.0, publications=types.SimpleNamespace(leave=lambda _: None)
        )
        rosbridge = WebSocketServer(bridge, 1000, guard)
        yield rosbridge.listen(0, "127.0.0.1")
        await rosbridge.close()
    else:
        port = GuardedPort(guard, "127.0.0.1", 0)
        address = hidden_address()
        sdk = foxglove.start_server(host=address, port=0, context=foxglove.Context())
        port.serve(address, sdk.port)
        yield port.port
        port.close()
        await asyncio.to_thread(sdk.stop)


async def status(port: int, lines: Sequence[str], path: str = "/ws", handshake: bool = True) -> int:
    """Send a request with header lines and return the answer's status."""
    key = base64.b64encode(bytes(16)).decode()
    upgrade = ("Upgrade: websocket", "Connection: Upgrade", f"Sec-WebSocket-Key: {key}", "Sec-WebSocket-Version: 13",
               "Sec-WebSocket-Protocol: foxglove.sdk.v1")  # fmt: skip
    reader, writer = await asyncio.open_connection("127.0.0.1", port)
    writer.write("\r\n".join([f"GET {path} HTTP/1.1", *lines, *(upgrade if handshake else ()), "", ""]).encode())
    answer = await asyncio.wait_for(reader.readline(), 20.0)
    writer.close()
    return int(answer.split()[1])


def run(test: Callable[[], Awaitable[None]]) -> None:
    asyncio.run(asyncio.wait_for(test(), 60.0))  # type: ignore[arg-type]


@pytest.mark.parametrize("name", SERVERS)
def test_no_page_of_another_server_reaches_a_server(name: str) -> None:
    async def test() -> None:
        async with serving(name, ()) as port:
            own = f"Host: 127.0.0.1:{port}"
            rebound = [f"Host: evil.example:{port}", f"Origin: http://evil.example:{port}"]
            refused = [
                rebound,
                [*rebound, "Sec-Fetch-Site: same-origin"],
                [rebound[0], "Sec-Fetch-Site: none"],
                [rebound[0]],
                [own, rebound[1]],
                [own, rebound[1], "Sec-Fetch-Site: same-origin"],
                [own, rebound[1], "Sec-Fetch-Site: none"],
                [own, "Origin: null"],
                [own, "Origin: http://["],
                [own, f"Origin: http://127.0.0.1:{port}", rebound[1]],
                [own, rebound[0]],
                [own, "Origin: https://app.foxglove.dev"],
            ]
            for lines in refused:
                assert await status(port, lines) in (400, 403), lines
                assert await status(port, lines, path="/", handshake=False) in (400, 403), lines
            for host in (f"127.0.0.1:{port}", f"LOCALHOST:{port}", f"localhost.:{port}", f"[::1]:{port}"):
                for origin in ([], [f"Origin: http://{host}"]):
                    assert await status(port, [f"Host: {host}", *origin]) == 101, (host, origin)

    run(test)


@pytest.mark.parametrize("name", SERVERS)
@pytest.mark.parametrize("origin", ["https://app.foxglove.dev", "null", "file://"])
def test_a_page_that_the_user_names_reaches_a_server(name: str, origin: str) -> None:
    async def test() -> None:
        async with serving(name, (origin,)) as port:
            assert await status(port, [f"Host: localhost:{port}", f"Origin: {origin}"]) == 101
            assert await status(port, [f"Host: localhost:{port}", "Origin: https://evil.example"]) == 403
            assert await status(port, [f"Host: evil.example:{port}", f"Origin: {origin}"]) == 403

    run(test)


def test_foxglove_s_port_passes_frames_of_any_size_and_ends_with_either_side() -> None:
    async def test() -> None:
        echoed: list[int] = []
        ended = asyncio.Event()

        async def echo(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            await reader.readuntil(b"\r\n\r\n")
            while data := await reader.read(1 << 16):
                writer.write(data)
                echoed.append(len(data))
            writer.close()
            ended.set()

        address = hidden_address()
        inner = await asyncio.start_server(echo, address, 0)
        port = GuardedPort(ServerGuard("here", "127.0.0.1"), "127.0.0.1", 0)
        port.serve(address, inner.sockets[0].getsockname()[1])
        reader, writer = await asyncio.open_connection("127.0.0.1", port.port)
        writer.write(b"GET / HTTP/1.1\r\nHost: localhost\r\nUpgrade: websocket\r\n\r\n")
        data = random.Random(1).randbytes(5_000_000)

        async def send() -> None:
            writer.write(data)
            await writer.drain()

        sending = asyncio.ensure_future(send())
        assert await reader.readexactly(len(data)) == data
        await sending
        writer.close()
        await asyncio.wait_for(ended.wait(), 20.0)
        assert sum(echoed) == len(data)
        stale, silent = await asyncio.open_connection("127.0.0.1", port.port)
        silent.write(b"GET / HTTP/1.1\r\n" + b"X: y\r\n" * 100_000)
        with contextlib.suppress(ConnectionResetError):
            assert await stale.read(1000) == b"", "a request without end is given up"
        port.close()
        inner.close()

    run(test)


def request_is_answered(port: GuardedPort) -> bool:
    with socket.create_connection(("127.0.0.1", port.port), 20.0) as client:
        client.sendall(b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n")
        return client.recv(100).startswith(b"HTTP/1.1 426")


def test_foxglove_s_port_accepts_clients_after_an_error_of_the_system(monkeypatch: pytest.MonkeyPatch) -> None:
    accept = socket.socket.accept
    errors = [OSError(errno.EMFILE, "Too many open files"), OSError(errno.ECONNABORTED, "Connection aborted")]

    def accept_later(listening: socket.socket) -> tuple[socket.socket, Any]:
        if errors:
            raise errors.pop()
        return accept(listening)

    monkeypatch.setattr(socket.socket, "accept", accept_later)
    monkeypatch.setattr(guarded_port, "_RETRY", 0.0)
    said: list[str] = []
    port = GuardedPort(ServerGuard("here", "127.0.0.1"), "127.0.0.1", 0, said.append)
    port.serve("127.0.0.1", 9)
    assert request_is_answered(port)
    port.close()
    assert said == [f"port {port.port}: a client cannot be accepted: [Errno {errno.ECONNABORTED}] Connection aborted"]


def test_the_oldest_silent_client_of_foxglove_s_port_yields(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(guarded_port, "MAX_CLIENTS", 2)
    port = GuardedPort(ServerGuard("here", "127.0.0.1"), "127.0.0.1", 0)
    port.serve("127.0.0.1", 9)
    first, second = (socket.create_connection(("127.0.0.1", port.port), 5.0) for _ in range(2))
    with first, second:
        assert request_is_answered(port)
        assert first.recv(100) == b""
        second.sendall(b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n")
        assert second.recv(100).startswith(b"HTTP/1.1 426")
    port.close()


def test_a_websocket_of_a_program_reaches_foxglove_s_server() -> None:
    async def test() -> None:
        async with serving("foxglove", ()) as port:
            socket = await websocket_connect(f"ws://127.0.0.1:{port}", subprotocols=["foxglove.sdk.v1"])
            assert '"serverInfo"' in str(await socket.read_message())
            socket.close()

    run(test)
