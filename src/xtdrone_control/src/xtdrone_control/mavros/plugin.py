"""Base class of the MAVROS plugins."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from xtdrone_control.mavros.feeds import Feed, Topic
from xtdrone_control.mavros.uas import Uas

__all__ = ["Feed", "Plugin", "Topic"]


class Plugin:
    """One MAVROS plugin of one vehicle.

    A subclass creates its topics and services in ``__init__`` and fills in:

    Attributes:
        messages: MAVLink message name to its feed or feeds, handled in the main thread; ``RAW`` for every frame.
        replies: MAVLink message name to a handler of the raw frame that the receiver thread calls immediately; for
            answers that a service is waiting for.
    """

    name = ""
    listed = True

    def __init__(self, uas: Uas) -> None:
        """Store the vehicle's hub."""
        self.uas = uas
        self.messages: dict[str | int, Feed | Sequence[Feed]] = {}
        self.replies: dict[str, Callable[[bytes], None]] = {}

    def connected(self, connected: bool) -> None:
        """Handle the first heartbeat of the autopilot or the loss of its heartbeat; the default does nothing."""
