"""The check of Host and Origin that every HTTP and WebSocket server here makes before it answers a request.

A browser lets any web page connect to a server on the user's machine, and lets a page whose own name is pointed there
(DNS rebinding) even read its answers. It sends the page's origin and the name by which the page reached the server;
programs send no origin. Sources: RFC 6455, section 10.2; RFC 6454, section 7.
"""

from __future__ import annotations

import ipaddress
import re
import shlex
import socket
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

from xtdrone_common.files import shortened
from xtdrone_common.settings import setting

if TYPE_CHECKING:
    from tornado.httputil import HTTPHeaders

ANY = "*"
_HOST = re.compile(r"(\[[0-9a-z:.%_-]+\]|[0-9a-z._-]+)(?::(\d{1,5}))?", re.ASCII)
_ORIGIN = re.compile(rf"([a-z][a-z0-9+.-]*)://({_HOST.pattern})", re.ASCII)
_OPAQUE = ("null", "file://")  # origins of pages opened as files, and of programs made of such pages
_MOST_REPORTED = 100  # refused headers that are reported, once each


def listed(value: Any) -> tuple[str, ...]:
    """Return texts given as a list or as one text with commas, also in rosbridge's form ``[/a/*, /b]``.

    Raises:
        ValueError: neither.
    """
    if isinstance(value, str):
        value = value.strip().removeprefix("[").removesuffix("]").split(",")
    if not isinstance(value, (list, tuple)) or not all(isinstance(part, str) for part in value):
        raise ValueError("a list, or one text with commas")
    return tuple(part.strip().strip("'\"") for part in value if part.strip())


def origins_setting() -> Any:
    """Return the declaration of a server's setting ``origins``."""
    return setting(
        (),
        parse=listed,
        allowed="origins such as https://app.foxglove.dev, null or file:// for pages opened as files, or *",
        text="web pages that may connect, in addition to those served by this machine",
        metavar="ORIGINS",
    )


def names_setting() -> Any:
    """Return the declaration of a server's setting ``names``."""
    return setting(
        (),
        parse=listed,
        allowed="host names such as robot.lan",
        text="names by which clients reach this machine, besides localhost",
        metavar="NAMES",
    )


class _Place(NamedTuple):
    """Host and port as in a URL; no port where that of the scheme is meant."""

    host: str
    port: str


def is_loopback(host: str) -> bool:
    """Return whether a host, by its name or address, is this machine as it reaches itself only."""
    if host == "localhost":
        return True
    address = _address(host)
    return address is not None and address.is_loopback


def origin_text(text: str) -> str:
    """Return an origin in the form in which origins are compared."""
    return text.strip().lower().removesuffix("/") if "://" in text and text != "file://" else text.strip().lower()


class ServerGuard:
    """The rules of one server."""

    def __init__(
        self,
        server: str,
        listening: str,
        origins: Sequence[str] = (),
        names: Sequence[str] = (),
        *,
        own_page_only: bool = False,
        report: Callable[[str], None] = print,
    ) -> None:
        """Initialise.

        Args:
            server: name of the node, for messages.
            listening: listening address, or a name for it.
            origins: of further web pages that may connect; ``*`` for all.
            names: further names of this machine by which clients reach the server.
            own_page_only: whether of the pages served by this machine only the server's own may connect.
            report: logs a refusal; called once for each refused header.
        """
        self._server = server
        self._open = not is_loopback(listening)
        self._origins = {origin_text(origin) for origin in origins}
        self._names = {_plain(name) for name in (listening, *names) if _plain(name)}
        if self._open:
            name = _plain(socket.gethostname())
            self._names |= {name, f"{name}.local", _plain(socket.getfqdn())}
        self._own_page_only = own_page_only
        self._report = report
        self._reported: set[str] = set()

    def refusal(self, headers: HTTPHeaders) -> str:
        """Return why a request is refused, empty if it is not. ``headers``: of the request, each as often as sent."""
        hosts, origins = headers.get_list("Host"), headers.get_list("Origin")
        host = _place(hosts[0]) if len(hosts) == 1 else None
        if host is None or not self._is_own(host.host):
            allowed = "localhost, an IP address or a name given by the parameter names"
            fix = f"names:={host.host} allows it" if host is not None else f"allowed is {allowed}"
            return self._refused("host name", hosts, fix)
        if not origins:
            return ""
        if len(origins) == 1 and self._is_allowed(origin_text(origins[0]), host):
            return ""
        text = origin_text(origins[0]) if len(origins) == 1 else ""
        known = text in _OPAQUE or _ORIGIN.fullmatch(text) is not None
        fix = (
            f"origins:={shlex.quote(text)} allows it" if known else "allowed is one origin such as http://10.0.0.2:8000"
        )
        return self._refused("web page of origin", origins, fix)

    def _is_own(self, host: str) -> bool:
        return is_loopback(host) or host in self._names or _address(host) is not None

    def _is_allowed(self, origin: str, host: _Place) -> bool:
        if ANY in self._origins or origin in self._origins:
            return True
        match = _ORIGIN.fullmatch(origin)
        page = _place(match[2]) if match is not None else None
        if page is None:
            return False
        if self._own_page_only:
            return page == host
        if self._open and page.host in (host.host, *self._names):
            return True
        address = _address(page.host)
        return is_loopback(page.host) or (address is not None and address.is_unspecified)  # http://0.0.0.0:8000

    def _refused(self, what: str, values: Sequence[str], fix: str) -> str:
        text = shortened(ascii(values[0] if len(values) == 1 else list(values)))
        reason = f"{self._server}: the {what} {text} is refused; {fix}"
        if reason not in self._reported and len(self._reported) < _MOST_REPORTED:
            self._reported.add(reason)
            self._report(reason)
        return reason


def _plain(name: str) -> str:
    """Return a host in the form in which hosts are compared: lower case, without brackets and the root's dot."""
    return name.strip().lower().removeprefix("[").removesuffix("]").removesuffix(".")


def _place(text: str) -> _Place | None:
    match = _HOST.fullmatch(text.strip().lower())
    return None if match is None else _Place(_plain(match[1]), match[2] or "")


def _address(host: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
    try:
        return ipaddress.ip_address(host)
    except ValueError:
        return None
