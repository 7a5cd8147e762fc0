"""What the MAVLink services of one vehicle have in common.

A service acts on the messages that belong to it and answers the client that they came from. Services know nothing of
each other; ``receiver`` routes messages to them.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, ClassVar

from xtdrone_control.autopilot.commander.commander import Commander

from .link import Link

if TYPE_CHECKING:
    from xtdrone_control.autopilot.autopilot import Autopilot

NEVER_US = 1 << 62

Handler = Callable[[Link, Any], None]


class Vehicle:
    """What a service needs to know of its vehicle.

    Attributes:
        commander: the vehicle's state machine; ``commander.parameters`` and ``commander.navigator`` are reached by it.
        autopilot: holder of the records.
        index: the vehicle's place in them.
        system_id: MAVLink system id.
        now_us: simulated time, microseconds, of the message that is handled.
        participant: whether the message that is handled came from a participant of the lockstep.
        clients: returns the links to everybody who listens, for what is for all.
        on_request: message id to what answers a request for a message that is no stream; services fill it. It may
            return False when there is nothing to tell.
        capabilities: MAV_PROTOCOL_CAPABILITY bits of all services.
        files: path to the content of files that MAVLink FTP lets clients read beside the logs; services fill it.
    """

    def __init__(
        self,
        commander: Commander,
        autopilot: Autopilot,
        index: int,
        clients: Callable[[], list[Link]] = list,
    ) -> None:
        """Look at vehicle ``index`` of ``autopilot``, whose commander is given."""
        self.commander = commander
        self.autopilot = autopilot
        self.index = index
        self.system_id = commander.vehicle.system_id
        self.now_us = 0
        self.participant = False
        self.clients = clients
        self.on_request: dict[int, Callable[[Link], bool | None]] = {}
        self.capabilities = 0
        self.files: dict[str, Callable[[], bytes]] = {}
        self._held: list[Callable[[], None]] | None = None

    def hold(self) -> None:
        """Queue what participants give to ``in_turn`` from now on until ``release``."""
        self._held = [] if self._held is None else self._held

    def release(self) -> None:
        """Act on what was queued, in the order of arrival."""
        held, self._held = self._held, None
        for act in held or ():
            act()

    def in_turn(self, act: Callable[[], None]) -> None:
        """Call ``act`` now, or at ``release`` if a participant asks for it; see ``receiver``."""
        if self._held is None or not self.participant:
            act()
        else:
            self._held.append(act)


class Service:
    """One MAVLink microservice of one vehicle.

    A subclass says in ``MESSAGES`` what it handles: message name to the handler's name. A message with a
    ``target_system`` (or ``target``) reaches the handler only when it is for this vehicle or for all, one with a
    ``target_component`` only when it is for the autopilot or for all.

    ``CAPABILITIES`` has the MAV_PROTOCOL_CAPABILITY bits that hold because of the service.

    Attributes:
        vehicle: the vehicle served.
        due_us: simulated time, microseconds, at which ``update`` wants to be called; ``NEVER_US`` for never.
    """

    MESSAGES: ClassVar[dict[str, str]] = {}
    CAPABILITIES: ClassVar[int] = 0

    def __init__(self, vehicle: Vehicle) -> None:
        """Serve ``vehicle``."""
        self.vehicle = vehicle
        self.due_us = NEVER_US
        vehicle.capabilities |= self.CAPABILITIES

    @property
    def handlers(self) -> dict[str, Handler]:
        """Message name to what handles it: a function of the client's link and the decoded message."""
        return {message: getattr(self, name) for message, name in self.MESSAGES.items()}

    @property
    def waiting(self) -> list[Link]:
        """Links with a transfer that goes on by itself: part by part in ``update``, or by ``send_part``."""
        return []

    def send_part(self, link: Link, now_us: int) -> None:
        """Queue the next part of the transfer to ``link``, one of ``waiting``."""
        raise NotImplementedError

    def update(self, now_us: int) -> None:
        """Go on with what takes time; called once ``due_us`` is reached, and sets it anew."""
        self.due_us = NEVER_US
