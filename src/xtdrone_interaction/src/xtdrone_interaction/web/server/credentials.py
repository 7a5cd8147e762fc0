"""Access control: tokens and the roles that they grant, hosts and origins."""

from __future__ import annotations

import hmac
import ipaddress
import secrets
from dataclasses import dataclass
from urllib.parse import urlparse

from xtdrone_interaction.web.server.roles import Role

_LOOPBACK_NAMES = ("localhost", "127.0.0.1", "[::1]")
_TOKEN_BYTES = 18


def is_loopback(host: str) -> bool:
    """Whether a listening address is this machine's own only."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


@dataclass(frozen=True)
class Credentials:
    """Tokens of a station.

    Attributes:
        operate: grants all methods; empty: none is needed, and every page of this machine may operate.
        view: grants the methods that change nothing; empty: no such token.
    """

    operate: str = ""
    view: str = ""

    @classmethod
    def for_host(cls, host: str, token: str = "", view_only: bool = False) -> Credentials:
        """Return the tokens for a listening address: if none is given, one is generated for access from other machines.

        Args:
            host: listening address.
            token: chosen by the user; empty: generated if one is needed.
            view_only: no page may operate; ``operate`` is then a token that is not shown.
        """
        needs = bool(token) or not is_loopback(host)
        if view_only:
            return cls(secrets.token_urlsafe(_TOKEN_BYTES), (token or secrets.token_urlsafe(_TOKEN_BYTES)) * needs)
        if not needs:
            return cls()
        return cls(token or secrets.token_urlsafe(_TOKEN_BYTES), secrets.token_urlsafe(_TOKEN_BYTES))

    def role(self, token: object) -> Role | None:
        """Return the role that a token gives; None for a wrong one."""
        given = token if isinstance(token, str) else ""
        if self._matches(given, self.operate):
            return "operate"
        if self._matches(given, self.view):
            return "view"
        return None

    @staticmethod
    def _matches(given: str, kept: str) -> bool:
        return hmac.compare_digest(given.encode(), kept.encode())


def is_own_origin(origin: str | None, host_header: str, listening: str) -> bool:
    """Whether a WebSocket comes from a page of this server, or from a program, which sends no origin.

    A page of another server may send requests to this one from a user's browser, also by a name that it lets point to
    this machine. So the origin must be the host of the request, and on loopback one of the names of loopback.

    Args:
        origin: header of the request.
        host_header: the header Host of the request, with the port.
        listening: the server's listening address.
    """
    if not is_own_host(host_header, listening):
        return False
    if origin is None:
        return True
    try:
        return urlparse(origin).netloc.lower() == host_header.lower()
    except ValueError:
        return False


def is_own_host(host_header: str, listening: str) -> bool:
    """Whether a request names this server as browsers do that were given its URL."""
    name = host_header.rpartition(":")[0] if ":" in host_header.rpartition("]")[2] else host_header
    return not is_loopback(listening) or name.lower() in _LOOPBACK_NAMES
