"""The station's HTTP and WebSocket server, on tornado.

Over HTTP it serves the files of the page's folder and nothing else. All data of the flight go over ``/ws``, whose first
message has to be the method ``hello`` with the token; before it nothing is sent and nothing is called.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import socket as sockets
from collections.abc import Awaitable, Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tornado.ioloop import IOLoop
from tornado.iostream import StreamClosedError
from tornado.netutil import bind_sockets
from tornado.web import Application, HTTPError, RequestHandler, StaticFileHandler
from tornado.websocket import WebSocketClosedError, WebSocketHandler

from xtdrone_interaction.server_guard import ServerGuard, is_loopback
from xtdrone_interaction.server_port import BoundedHTTPServer
from xtdrone_interaction.web.server.credentials import Credentials
from xtdrone_interaction.web.server.methods import CallError, Method, MethodTable, Params, checked_params, invoke
from xtdrone_interaction.web.server.session import Session

MOST_MESSAGE = 1 << 20
"""Bytes of a message from a page."""
MOST_SESSIONS = 64
"""WebSockets; beyond them the oldest without ``hello`` yields."""
WRONG_TOKEN, NO_HELLO = 4401, 4408
"""Codes of the server's closing a WebSocket: the page gives up after the first and connects again after the second."""
MOST_CALLS = 32
"""Calls of one page whose answers are outstanding."""
_HELLO_LIMIT = 5.0  # s of wall time for a page's first message
_PING_PERIOD = 10.0  # s
_HEADERS = {
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-cache",
    "Content-Security-Policy": "default-src 'self'; style-src 'self' 'unsafe-inline'; img-src 'self' blob: data:; "
    "connect-src 'self' ws: wss:; worker-src 'self' blob:; frame-ancestors 'none'",
}
log = logging.getLogger("xtdrone.web")


@dataclass(frozen=True)
class Address:
    """Listening address and access of the station: tokens, further web pages, and further names of this machine."""

    host: str
    port: int
    credentials: Credentials
    origins: tuple[str, ...] = ()
    names: tuple[str, ...] = ()

    def urls(self, port: int) -> dict[str, str]:
        """Return the URLs to open, by role; the token is in the fragment, which browsers do not send."""
        host = "127.0.0.1" if is_loopback(self.host) else _own_address(self.host)
        tokens = {"operate": self.credentials.operate, "view": self.credentials.view}
        if not tokens["operate"]:
            return {"operate": f"http://{host}:{port}/"}
        return {role: f"http://{host}:{port}/#token={token}" for role, token in tokens.items() if token}


def _own_address(host: str) -> str:
    """Return an address by which other machines reach this one."""
    if host not in ("0.0.0.0", "::"):
        return f"[{host}]" if ":" in host else host
    with sockets.socket(sockets.AF_INET, sockets.SOCK_DGRAM) as probe, contextlib.suppress(OSError):
        probe.connect(("192.0.2.1", 9))  # sends nothing: the system only chooses the outgoing address
        return str(probe.getsockname()[0])
    return sockets.gethostname()


@dataclass
class StationServer:
    """The server.

    Attributes:
        address: where it listens.
        page: folder of the page's files.
        methods: of all rooms.
        operate: carries out a call of the role ``operate`` and returns its result.
        report: logs a refused request.
        welcome: what ``hello`` answers beside the role.
        sessions: the connected pages, after their ``hello``, in order.
    """

    address: Address
    page: Path
    methods: Iterable[Method]
    operate: Callable[[Method, Session, Params], Awaitable[Any]] = invoke
    on_connect: Callable[[Session], None] = lambda *_: None
    report: Callable[[str], None] = log.warning
    welcome: Callable[[], dict[str, Any]] = dict
    sessions: dict[int, Session] = field(default_factory=dict)

    def start(self) -> int:
        """Listen, in the event loop of this thread, and return the port.

        Raises:
            OSError: the address is in use, or not one of this machine.
        """
        self.table = MethodTable(self.methods)
        self.loop = IOLoop.current()
        self.connections = 0
        self.open_sockets = 0
        place = self.address
        self.guard = ServerGuard(
            "web_station", place.host, place.origins, place.names, own_page_only=True, report=self.report
        )
        self.without_hello: dict[_PageSocket, None] = {}  # in order
        application = Application(
            routes(self),
            websocket_max_message_size=MOST_MESSAGE,
            websocket_ping_interval=_PING_PERIOD,
            websocket_ping_timeout=_PING_PERIOD,
            log_function=lambda handler: None,
            compress_response=True,
        )
        bound = bind_sockets(self.address.port, self.address.host)
        self._http = BoundedHTTPServer(application)
        self._http.add_sockets(bound)
        return int(bound[0].getsockname()[1])

    def stop(self) -> None:
        """Disconnect all pages and stop listening."""
        self._http.stop()
        for session in list(self.sessions.values()):
            session.close()

    def push_all(self, event: str, data: Any) -> None:
        """Send an event to all pages; in the event loop."""
        for session in list(self.sessions.values()):
            session.push(event, data)


def routes(server: StationServer) -> list[tuple[str, type[RequestHandler], dict[str, Any]]]:
    """Return the server's routes: pattern of the path, handler and the handler's arguments."""
    return [
        ("/ws", _PageSocket, {"server": server}),
        ("/(.*)", _PageFile, {"path": str(server.page), "default_filename": "index.html", "server": server}),
    ]


class _PageFile(StaticFileHandler):
    """A file of the page's folder; tornado refuses paths and links that lead out of it."""

    def initialize(self, path: str, default_filename: str | None = None, server: Any = None) -> None:
        super().initialize(path, default_filename)
        self._server: StationServer = server

    def set_default_headers(self) -> None:
        self.clear_header("Server")
        for name, value in _HEADERS.items():
            self.set_header(name, value)

    def prepare(self) -> None:
        if self._server.guard.refusal(self.request.headers):
            raise HTTPError(403)

    def validate_absolute_path(self, root: str, absolute_path: str) -> str | None:
        """Refuse hidden files and impossible names, too."""
        try:
            path = super().validate_absolute_path(root, absolute_path)
        except ValueError as error:
            raise HTTPError(400) from error
        if path is not None and any(part.startswith(".") for part in Path(path).relative_to(root).parts):
            raise HTTPError(404)
        return path

    def write_error(self, status_code: int, **_: Any) -> None:
        """Send the status alone."""
        self.finish(f"{status_code}\n")


class _PageSocket(WebSocketHandler):
    """A page's WebSocket: ``hello`` first, then calls."""

    def initialize(self, server: StationServer) -> None:
        self._server = server
        self._session: Session | None = None
        self._calls = 0
        self._counted = False

    def check_origin(self, origin: str) -> bool:
        return True  # checked with the host, by ``prepare``: tornado asks here for some origins only

    def prepare(self) -> None:
        """Refuse other servers' pages, and requests under a name that is not this server's."""
        if self._server.guard.refusal(self.request.headers):
            raise HTTPError(403)
        if self._server.open_sockets >= MOST_SESSIONS and not self._server.without_hello:
            raise HTTPError(503)

    def open(self, *_: str, **__: str) -> None:
        self._hello_limit = self._server.loop.call_later(_HELLO_LIMIT, self._yield, "no hello")
        if self._server.open_sockets >= MOST_SESSIONS:
            oldest = next(iter(self._server.without_hello), self)
            oldest._yield("no hello, and others wait")
            if oldest is self:
                return
        self._server.open_sockets += 1
        self._counted = True
        self._server.without_hello[self] = None
        self.set_nodelay(True)

    async def on_message(self, message: str | bytes) -> None:
        """Answer a call; before ``hello`` no other method is allowed."""
        if self._session is None:
            self._greet(message)
            return
        session = self._session
        number: Any = None
        try:
            request = _request(message)
            number = request.get("id")
            if self._calls >= MOST_CALLS:
                raise CallError(f"calls: {self._calls} unanswered ones are not allowed, fewer than {MOST_CALLS}")
            method = self._server.table.find(request.get("method"), session.role)
            params = checked_params(request.get("params"))
        except CallError as error:
            session.answer({"id": number, "error": str(error)})
            return
        # as a task: the next message is read meanwhile
        self._calls += 1
        asyncio.ensure_future(self._call(session, number, method, params))  # noqa: RUF006

    async def _call(self, session: Session, number: Any, method: Method, params: dict[str, Any]) -> None:
        try:
            carry_out = self._server.operate if method.role == "operate" else invoke
            session.answer({"id": number, "result": await carry_out(method, session, params)})
        except (ValueError, TimeoutError) as error:
            session.answer({"id": number, "error": str(error) or type(error).__name__})
        except Exception as error:  # a fault of ours harms this call alone
            log.exception("method %s", method.name)
            session.answer({"id": number, "error": f"{method.name}: {type(error).__name__}: {error}"})
        finally:
            self._calls -= 1

    def _greet(self, message: str | bytes) -> None:
        if not self._counted:  # it has yielded, and its hello is late
            return
        try:
            request = _request(message)
            params = checked_params(request.get("params"))
        except CallError:
            request, params = {}, {}
        role = self._server.address.credentials.role(params.get("token", ""))
        if request.get("method") != "hello" or role is None:
            self._refuse(WRONG_TOKEN, "token")
            return
        self._server.loop.remove_timeout(self._hello_limit)
        self._server.without_hello.pop(self, None)
        self._server.connections += 1
        self._session = Session(self._server.connections, role, self, self._server.loop.add_callback)  # type: ignore[arg-type]
        self._server.sessions[self._session.number] = self._session
        self._session.answer({"id": request.get("id"), "result": {"role": role, **self._server.welcome()}})
        self._server.on_connect(self._session)

    def _refuse(self, code: int, reason: str) -> None:
        if self._session is None:
            super().close(code, reason)

    def _yield(self, reason: str) -> None:
        self._refuse(NO_HELLO, reason)
        self._forget()

    def _forget(self) -> None:
        """Count this socket no longer; its connection may take longer to close."""
        self._server.open_sockets -= self._counted
        self._counted = False
        self._server.without_hello.pop(self, None)
        self._server.loop.remove_timeout(self._hello_limit)

    def on_close(self) -> None:
        self._forget()
        if self._session is not None:
            self._server.sessions.pop(self._session.number, None)
            self._session.close()

    def send(self, data: str | bytes, done: Callable[[], None]) -> None:
        """Send a message for the session."""
        try:
            future = self.write_message(data, binary=isinstance(data, bytes))
        except (WebSocketClosedError, StreamClosedError):
            done()
            return

        def finished(future: asyncio.Future[None]) -> None:
            future.exception()  # a page that has gone
            done()

        future.add_done_callback(finished)  # type: ignore[arg-type]


def _request(message: str | bytes) -> dict[str, Any]:
    """Return the object of a text message.

    Raises:
        CallError: it is none.
    """
    if isinstance(message, bytes):
        raise CallError("message: binary is not allowed, JSON text")
    try:
        request = json.loads(message)
    except (ValueError, RecursionError) as error:
        raise CallError(f"message: {message[:80]!r} is not allowed, JSON text: {error}") from error
    if not isinstance(request, dict):
        raise CallError(f"message: {message[:80]!r} is not allowed, an object with id, method and params")
    return request
