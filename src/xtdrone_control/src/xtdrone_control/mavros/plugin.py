"""Base class of the MAVROS plugins."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from xtdrone_control.mavros.feeds import Feed, Topic
from xtdrone_control.mavros.uas import Uas

__all__ = ["Feed", "Plugin", "Topic"]


class Plugin:
    """One MAVROS plugin of one vehicle.

    A subclass makes its topics and services in ``__init__`` and fills:

    Attributes:
        messages: MAVLink name to feed, or feeds, decoded and handled in the main thread; ``RAW`` for every frame.
        replies: MAVLink name to handler of the raw frame, called in the receiver thread at once; for answers to
            requests that a service waits for.
    """

    name = ""
    listed = True

    def __init__(self, uas: Uas) -> None:
        """Take the vehicle's hub."""
        self.uas = uas
        self.messages: dict[str | int, Feed | Sequence[Feed]] = {}
        self.replies: dict[str, Callable[[bytes], None]] = {}

    def connected(self, connected: bool) -> None:
        """Take note that the autopilot's heartbeat came for the first time, or stays away; override if it matters."""
