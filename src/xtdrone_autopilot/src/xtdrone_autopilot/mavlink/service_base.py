"""Base class of the MAVLink services of one vehicle.

A service handles its messages and replies to their sender. Services are independent of each other; ``receiver`` routes
messages to them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, ClassVar

from xtdrone_autopilot.commander.commander import Commander, Result

from .client_link import Link

if TYPE_CHECKING:
    from xtdrone_autopilot.autopilot import Autopilot

NEVER_US = 1 << 62

Handler = Callable[[Link, Any], None]


class Vehicle:
    """State of the vehicle, shared by its services.

    Attributes:
        commander: the vehicle's state machine, with its ``parameters`` and ``navigator``.
        autopilot: autopilot that holds the records.
        index: the vehicle's index in them.
        system_id: MAVLink system id.
            now_us: simulated time, microseconds, of the message being handled.
        participant: whether the message being handled came from a lockstep participant.
        clients: returns the links with active streams, for broadcasts.
        on_request: message id to the function that answers MAV_CMD_REQUEST_MESSAGE for a message without a stream;
            services fill it. The function returns False if it cannot send the message.
        on_command: MAV_CMD to the function that executes it, with parameters 1 to 7 and the client's link; services
        it. The function returns the result, None for no acknowledgement.
        capabilities: MAV_PROTOCOL_CAPABILITY bits of all services.
        due_changed: called when the ``due_us`` of a service has changed.
        files: files that MAVLink FTP serves besides the logs: path to a function that returns the content; services
            fill it.
    """

    def __init__(
        self, commander: Commander, autopilot: Autopilot, index: int, clients: Callable[[], list[Link]] = list
    ) -> None:
        """Represent vehicle ``index`` of ``autopilot``."""
        self.commander = commander
        self.autopilot = autopilot
        self.index = index
        self.system_id = commander.vehicle.system_id
        self.now_us = 0
        self.participant = False
        self.clients = clients
        self.on_request: dict[int, Callable[[Link], bool | None]] = {}
        self.on_command: dict[int, Callable[[Sequence[float], Link], Result | None]] = {}
        self.capabilities = 0
        self.files: dict[str, Callable[[], bytes]] = {}
        self.due_changed: Callable[[], None] = lambda: None
        self._held: list[Callable[[], None]] | None = None

    def hold_setpoints(self) -> None:
        """Queue the actions that participants request through ``call_or_queue`` until ``release_setpoints``."""
        self._held = [] if self._held is None else self._held

    def release_setpoints(self) -> None:
        """Call the queued actions in order of arrival."""
        held, self._held = self._held, None
        for action in held or ():
            action()

    def call_or_queue(self, action: Callable[[], None]) -> None:
        """Call ``action`` now, or queue it if a participant requests it while setpoints are held; see ``receiver``."""
        if self._held is None or not self.participant:
            action()
        else:
            self._held.append(action)


class Service:
    """One MAVLink microservice of one vehicle.

    ``MESSAGES`` of a subclass maps the name of each handled message to the name of the handler method. A message with
    a ``target_system`` (or ``target``) reaches the handler only if that is this vehicle or a broadcast, one with a
    ``target_component`` only if that is the autopilot or a broadcast.

    ``CAPABILITIES`` holds the MAV_PROTOCOL_CAPABILITY bits that the service provides.

    Attributes:
        vehicle: the vehicle served.
    """

    MESSAGES: ClassVar[dict[str, str]] = {}
    CAPABILITIES: ClassVar[int] = 0

    def __init__(self, vehicle: Vehicle) -> None:
        """Register the service with ``vehicle``."""
        self.vehicle = vehicle
        self._due_us = NEVER_US
        vehicle.capabilities |= self.CAPABILITIES

    @property
    def due_us(self) -> int:
        """Simulated time, microseconds, of the next ``update``; ``NEVER_US`` for none."""
        return self._due_us

    @due_us.setter
    def due_us(self, value: int) -> None:
        self._due_us = value
        self.vehicle.due_changed()

    @property
    def handlers(self) -> dict[str, Handler]:
        """Message name to its handler, a function of the client's link and the decoded message."""
        return {message: getattr(self, name) for message, name in self.MESSAGES.items()}

    @property
    def waiting(self) -> list[Link]:
        """Links with a transfer in progress, which ``update`` or ``send_part`` continue part by part."""
        return []

    def send_part(self, link: Link, now_us: int) -> None:
        """Queue the next part of the transfer to ``link``, one of ``waiting``."""
        raise NotImplementedError

    def update(self, now_us: int) -> None:
        """Continue work in progress and set the next ``due_us``; called once ``due_us`` is reached."""
        self.due_us = NEVER_US
