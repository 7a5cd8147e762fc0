"""Interface of a client connection to its session."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

Frame = str | bytes


class Connection(Protocol):
    """A connection to a client. All methods but ``call_soon`` and ``send`` are called by the server's thread."""

    def send(self, frame: Frame) -> None:
        """Send a frame; may be called by any thread."""

    def has_room(self) -> bool:
        """Return whether the client has received most of the sent data."""

    def call_soon(self, function: Callable[[], None]) -> None:
        """Call a function in the server's thread; may be called from any thread."""

    def call_later(self, delay: float, function: Callable[[], None]) -> None:
        """Call a function in the server's thread after a delay, s."""
