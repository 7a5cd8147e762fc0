"""Access control: tokens and the roles that they grant."""

from __future__ import annotations

import ctypes
import hmac
import os
import secrets
import stat
from dataclasses import dataclass
from typing import Literal

from xtdrone_interaction.server_guard import is_loopback

Role = Literal["view", "operate"]
"""Roles of a page: watch only, or operate, which includes watching."""
TOKEN_VARIABLE = "XTDRONE_WEB_TOKEN"
TOKEN_ADVICE = (
    f"token: a token on a command line or the parameter server is not allowed, as others can read it there; put it "
    f"into the environment variable {TOKEN_VARIABLE}, or into a file of mode 600 named by token_file"
)
_TOKEN_BYTES = 18
_LEAST = 8  # characters of a chosen token
_MOST = 1000  # bytes of a file with a token
_libc = ctypes.CDLL(None)
_libc.getenv.restype = ctypes.c_void_p


class TokenError(ValueError):
    """A token that cannot be used; the message does not contain it."""


def chosen_token(file: str) -> str:
    """Return the token that the user has chosen, empty if there is none; the variable is erased.

    Args:
        file: with the token; empty: that of the environment variable ``TOKEN_VARIABLE``.

    Raises:
        TokenError: the file is not allowed, both are given, or the token is not allowed.
    """
    token = take_variable(TOKEN_VARIABLE)
    if file:
        if token:
            raise TokenError(f"token_file: {file!r} is not allowed together with {TOKEN_VARIABLE}")
        token = _token_in(file)
    if (token or file) and not (
        len(token) >= _LEAST and all(c.isascii() and (c.isalnum() or c in "-_") for c in token)
    ):
        raise TokenError(
            f"{'token_file' if file else TOKEN_VARIABLE}: its token is not allowed, {_LEAST} or more "
            "letters, digits, - and _"
        )
    return token


def take_variable(name: str) -> str:
    """Return an environment variable, and erase it for this process, its children and readers of its environment."""
    value = os.environ.get(name, "")
    place = _libc.getenv(name.encode())
    if place:  # where /proc/PID/environ is read: unsetenv leaves it
        ctypes.memset(place, 0, len(ctypes.string_at(place)))
    os.environ.pop(name, None)
    return value


def _token_in(file: str) -> str:
    try:
        with open(file, "rb", opener=lambda path, flags: os.open(path, flags | os.O_NONBLOCK)) as opened:
            status = os.fstat(opened.fileno())
            if not stat.S_ISREG(status.st_mode) or status.st_mode & 0o077 or status.st_uid not in (0, os.geteuid()):
                mode = stat.filemode(status.st_mode)
                raise TokenError(
                    f"token_file: {file!r} ({mode}) is not allowed, a regular file of mode 600 that belongs to you"
                )
            return opened.read(_MOST).decode("ascii", "replace").strip()
    except OSError as error:
        raise TokenError(f"token_file: {file!r} is not allowed, a readable file: {error.strerror}") from error


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
