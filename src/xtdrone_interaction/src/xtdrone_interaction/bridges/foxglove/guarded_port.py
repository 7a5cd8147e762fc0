"""The port of Foxglove's clients: checks Host and Origin of a handshake, then passes bytes to and from foxglove-sdk.

The SDK (0.30.3) accepts every web page, and has no hook before a connection stands. So it listens on an address of
loopback that is chosen at random (24 bits) with any free port, which no web page can find, and clients connect here.
The kernel passes the bytes (``splice``), so that images cost no copies and hold no lock of the interpreter.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import secrets
import socket
import threading
import time
from collections.abc import Callable, Iterator

from tornado.httputil import HTTPHeaders, HTTPInputError
from tornado.netutil import bind_sockets

from xtdrone_interaction.server_guard import ServerGuard

MAX_CLIENTS = 100
"""Connected clients; beyond them the oldest whose request is not read yet yields."""
_RETRY = 0.5  # s until the next attempt to accept a client
_HEAD_LIMIT = 10.0  # s for a client's request
_LONGEST_HEAD = 1 << 16  # bytes
_PIPE = 1 << 20  # bytes passed on at a time
_HEAD_END = b"\r\n\r\n"
_PLAIN = "Content-Type: text/plain\r\nConnection: close\r\n"


def hidden_address() -> str:
    """Return a random address of loopback, of which Linux has 127.0.0.0/8."""
    first, second, third = secrets.token_bytes(3)
    return f"127.{first}.{second}.{third}"


class GuardedPort:
    """A listening port, served by threads of its own.

    Attributes:
        port: TCP port.
    """

    def __init__(self, guard: ServerGuard, address: str, port: int, report: Callable[[str], None] = print) -> None:
        """Open the port.

        Args:
            guard: rules for the clients' requests.
            address: listening address.
            port: TCP port; 0: any free one.
            report: logs that clients cannot be accepted; called once for each listening socket.

        Raises:
            OSError: it cannot be opened.
        """
        self._guard = guard
        self._report = report
        self._closed = threading.Event()
        self._lock = threading.Lock()  # for the clients
        self._listening = bind_sockets(port, address, reuse_port=False)
        self.port = int(self._listening[0].getsockname()[1])
        self._inner = ("", 0)
        self._clients: set[socket.socket] = set()
        self._waiting: dict[socket.socket, None] = {}  # clients whose request is not read yet, in order

    def serve(self, address: str, port: int) -> None:
        """Begin to pass connections on to a server at an address and TCP port of this machine."""
        self._inner = (address, port)
        for listening in self._listening:
            listening.setblocking(True)
            threading.Thread(target=self._accept, args=(listening,), name="port", daemon=True).start()

    def close(self) -> None:
        """Close the port and all connections."""
        self._closed.set()
        with self._lock:
            ends = (*self._listening, *self._clients)
        for end in ends:
            _shut_down(end)

    def _accept(self, listening: socket.socket) -> None:
        is_reported = False
        with listening:
            while not self._closed.is_set():
                try:
                    client, _ = listening.accept()
                except OSError as error:  # the port is closed, too many files are open, or the client has gone
                    if not self._closed.wait(_RETRY) and not is_reported:
                        is_reported = True
                        self._report(f"port {self.port}: a client cannot be accepted: {error}")
                    continue
                self._admit(client)

    def _admit(self, client: socket.socket) -> None:
        if not self._make_room():
            client.close()
            return
        with self._lock:
            self._clients.add(client)
            self._waiting[client] = None
        try:
            threading.Thread(target=self._serve, args=(client,), name="client", daemon=True).start()
        except RuntimeError:  # the system has no further thread
            self._forget(client)
            client.close()

    def _make_room(self) -> bool:
        """Return whether a further client is allowed, if need be in place of the oldest that is waiting."""
        with self._lock:
            if len(self._clients) < MAX_CLIENTS:
                return True
            oldest = next(iter(self._waiting), None)
        if oldest is None:
            return False
        self._forget(oldest)
        _shut_down(oldest)
        return True

    def _forget(self, client: socket.socket) -> None:
        with self._lock:
            self._clients.discard(client)
            self._waiting.pop(client, None)

    def _serve(self, client: socket.socket) -> None:
        try:
            with client, contextlib.suppress(OSError, RuntimeError):  # an end has broken off, or no thread is left
                self._answer(client)
        finally:
            self._forget(client)

    def _answer(self, client: socket.socket) -> None:
        head = _read_head(client)
        with self._lock:
            has_yielded = client not in self._waiting
            self._waiting.pop(client, None)
        if has_yielded:
            return
        status = self._refusal(head)
        if status:
            client.sendall(f"HTTP/1.1 {status}\r\n{_PLAIN}Content-Length: {len(status)}\r\n\r\n{status}".encode())
        else:
            self._connect(client, head)

    def _refusal(self, head: bytes) -> str:
        """Return the status of a refused request, empty for a handshake that is allowed."""
        request, _, lines = head.partition(_HEAD_END)[0].decode("latin-1").partition("\r\n")
        try:
            headers = HTTPHeaders.parse(lines)
        except (HTTPInputError, ValueError):
            return "400 Bad Request"
        if self._guard.refusal(headers):
            return "403 Forbidden"
        is_handshake = request.startswith("GET ") and headers.get("Upgrade", "").lower() == "websocket"
        return "" if is_handshake else "426 Upgrade Required"

    def _connect(self, client: socket.socket, head: bytes) -> None:
        """Pass a client's connection on, until one of its ends closes it."""
        with socket.create_connection(self._inner, _HEAD_LIMIT) as inner:
            for end in (client, inner):
                end.settimeout(None)
                end.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            inner.sendall(head)
            back = threading.Thread(target=_pass_on, args=(inner, client), name="client, back", daemon=True)
            back.start()
            _pass_on(client, inner)
            back.join()


def _read_head(client: socket.socket) -> bytes:
    """Return what a client has sent, up to the end of its request's headers at least.

    Raises:
        OSError: the client ends, or the request is too slow or too long.
    """
    head = b""
    end = time.monotonic() + _HEAD_LIMIT
    while _HEAD_END not in head:
        client.settimeout(max(0.001, end - time.monotonic()))
        received = client.recv(_LONGEST_HEAD)
        head += received
        if not received or len(head) > _LONGEST_HEAD:
            raise OSError("no request")
    return head


def _pass_on(source: socket.socket, target: socket.socket) -> None:
    """Pass bytes on until an end closes, then close both."""
    try:
        with contextlib.suppress(OSError), _pipe() as (outlet, inlet):  # an end has broken off, or no pipe is left
            while count := os.splice(source.fileno(), inlet, _PIPE):
                while count:
                    count -= os.splice(outlet, target.fileno(), count)
    finally:
        _shut_down(source)
        _shut_down(target)


@contextlib.contextmanager
def _pipe() -> Iterator[tuple[int, int]]:
    outlet, inlet = os.pipe()
    try:
        with contextlib.suppress(OSError):  # the size is limited by the system
            fcntl.fcntl(inlet, fcntl.F_SETPIPE_SZ, _PIPE)
        yield outlet, inlet
    finally:
        os.close(outlet)
        os.close(inlet)


def _shut_down(end: socket.socket) -> None:
    with contextlib.suppress(OSError):
        end.shutdown(socket.SHUT_RDWR)
