"""What a session needs of the connection to its client."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

Frame = str | bytes


class Connection(Protocol):
    """A connection to a client. All methods but ``call_soon`` and ``send`` are called by the server's thread."""

    def send(self, frame: Frame) -> None:
        """Send a frame; may be called by any thread."""

    def has_room(self) -> bool:
        """Return whether the client has taken most of what was sent to it."""

    def call_soon(self, function: Callable[[], None]) -> None:
        """Have the server's thread call a function; may be called by any thread."""

    def call_later(self, delay: float, function: Callable[[], None]) -> None:
        """Have the server's thread call a function after a delay, s."""
