"""Routes the MAVLink messages that one vehicle receives to its services."""

from __future__ import annotations

import struct
from collections.abc import Callable, Collection
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from xtdrone_native.mavlink_wire import split

from xtdrone_autopilot.commander.commander import Commander
from xtdrone_autopilot.mavlink.client_link import Address, Link
from xtdrone_autopilot.mavlink.commands.command_service import CommandService, HomeService
from xtdrone_autopilot.mavlink.commands.external_sensors_service import VisionService
from xtdrone_autopilot.mavlink.commands.gimbal_service import GimbalService
from xtdrone_autopilot.mavlink.commands.setpoint_service import FollowService, ManualService, SetpointService
from xtdrone_autopilot.mavlink.microservices.connection_and_version import ConnectionService, VersionService
from xtdrone_autopilot.mavlink.microservices.event import EventService
from xtdrone_autopilot.mavlink.microservices.files_and_logs.ftp import FtpService, MetadataService
from xtdrone_autopilot.mavlink.microservices.files_and_logs.log_download import LogService
from xtdrone_autopilot.mavlink.microservices.files_and_logs.log_stream import LogStreamService
from xtdrone_autopilot.mavlink.microservices.mission import MissionService
from xtdrone_autopilot.mavlink.microservices.parameter import ParameterService
from xtdrone_autopilot.mavlink.service_base import Handler, Service, Vehicle
from xtdrone_autopilot.mavlink.streams.telemetry import silent
from xtdrone_autopilot.mavlink.udp_port_and_clients import Port
from xtdrone_autopilot.mavlink.wire.codec import decoder, frame_error, version
from xtdrone_autopilot.mavlink.wire.dialect import MESSAGE_ID, MESSAGES
from xtdrone_autopilot.mavlink.wire.frame_packing import COMPONENT_ID

if TYPE_CHECKING:
    from xtdrone_autopilot.autopilot import Autopilot

_BROADCAST = 0


@dataclass(frozen=True)
class _Entry:
    """Handling of one kind of message.

    Attributes:
        decode: decoder of a frame.
        handle: handler of the service.
        system_field: field of the target system, empty when the message has none.
        component_field: field of the target component, empty when the message has none.
    """

    decode: Callable[[bytes], Any]
    handle: Handler
    system_field: str
    component_field: str


def _field(name: str, *candidates: str) -> str:
    fields = MESSAGES[MESSAGE_ID[name]].fieldnames
    return next((candidate for candidate in candidates if candidate in fields), "")


def _entry(name: str, handle: Handler) -> _Entry:
    if name == "PING":  # its target is 0 in a request, the recipient in a reply
        return _Entry(decoder(name), handle, "", "")
    return _Entry(decoder(name), handle, _field(name, "target_system", "target"), _field(name, "target_component"))


class Receiver:
    """Handles the messages to one vehicle. No received datagram raises an error.

    Within a lockstep tick, commands and requests arrive when a participant calls a service, and setpoints and home
    positions when the MAVROS layer runs; the operating system's scheduler decides which come first. Setpoints and home
    positions of participants can therefore be held until all participants are done, so that commands and requests,
    which block their sender, always come first. Messages of clients outside the lockstep are handled in the order of
    sending: a setpoint sent before the command to enter OFFBOARD counts for it. An origin (SET_GPS_GLOBAL_ORIGIN) is
    never held, because its reply carries the resulting origin.
    """

    def __init__(
        self,
        commander: Commander,
        autopilot: Autopilot,
        index: int,
        clients: Callable[[], list[Link]] = list,
        due_changed: Callable[[], None] = silent,
    ) -> None:
        """Create the services of vehicle ``index`` of ``autopilot``.

        Args:
            commander: the vehicle's state machine.
            autopilot: autopilot that holds the records.
            index: the vehicle's index in them.
            clients: returns the links with active streams.
            due_changed: called when ``next_due_us`` may have changed.
        """
        self._vehicle = Vehicle(commander, autopilot, index, clients)
        self._due_changed = due_changed
        self._next_due_us: int | None = None
        self._vehicle.due_changed = self._forget_due
        self._services = all_services(self._vehicle)
        self._transfers = [service for service in self._services if type(service).waiting is not Service.waiting]
        self._entries = {
            MESSAGE_ID[name]: _entry(name, handle)
            for service in self._services
            for name, handle in service.handlers.items()
        }
        self.messages = tuple(name for service in self._services for name in service.handlers)

    def handle_datagram(
        self, port: Port, datagram: bytes, sender: Address, now_us: int, *, participant: bool = False
    ) -> None:
        """Handle every message in ``datagram``; replies are queued on the sender's link.

        Args:
            port: port that received it.
            datagram: its content.
            sender: address of the client.
            now_us: simulated time, microseconds.
            participant: whether the client is a lockstep participant.
        """
        self._vehicle.now_us = now_us
        self._vehicle.participant = participant
        frames, end = split(datagram)
        for number, system, component, frame in frames:
            entry = self._entries.get(number)
            if entry is not None:
                self._dispatch(port, frame, sender, (system, component), entry)
        if end < len(datagram):
            self._malformed(port, sender, frame_error(datagram, end))

    def _dispatch(self, port: Port, frame: bytes, sender: Address, origin: tuple[int, int], entry: _Entry) -> None:
        now_us = self._vehicle.now_us
        try:
            message = entry.decode(frame)
        except (ValueError, struct.error, TypeError) as error:  # FrameError is a ValueError, as is bad text
            self._malformed(port, sender, error)
            return
        system = self._vehicle.system_id
        wanted = getattr(message, entry.system_field) if entry.system_field else system
        if wanted not in (_BROADCAST, system):
            port.foreign += 1
            port.warn("foreign", f"message for system {wanted} ignored, this is system {system}", now_us)
            return
        link = port.link_of(sender, now_us)
        if link is None:
            return
        link.sender = origin
        link.heard(now_us, version(frame))
        if entry.component_field and getattr(message, entry.component_field) not in (_BROADCAST, COMPONENT_ID):
            return
        entry.handle(link, message)

    def _malformed(self, port: Port, sender: Address, error: Exception) -> None:
        port.note_malformed(sender)
        port.warn("malformed", f"bad MAVLink ignored: {error}", self._vehicle.now_us)

    @property
    def next_due_us(self) -> int:
        """Simulated time, microseconds, at which ``update`` is due next."""
        if self._next_due_us is None:
            self._next_due_us = min(service.due_us for service in self._services)
        return self._next_due_us

    def _forget_due(self) -> None:
        self._next_due_us = None
        self._due_changed()

    def update(self, now_us: int) -> None:
        """Update the services that are due."""
        self._vehicle.now_us = now_us
        for service in self._services:
            if service.due_us <= now_us:
                service.update(now_us)

    @property
    def has_transfers(self) -> bool:
        """Whether a transfer to a client is in progress."""
        return any(service.waiting for service in self._transfers)

    def send_parts(self, now_us: int, counted: Collection[int]) -> None:
        """Queue the next part of every transfer, except to ``counted`` ports, while simulated time stands still."""
        self._vehicle.now_us = now_us
        for service in self._transfers:
            for link in service.waiting:
                if link.peer[1] not in counted:
                    service.send_part(link, now_us)

    def hold_setpoints(self) -> None:
        """Queue setpoints and home positions of participants until ``release_setpoints``."""
        self._vehicle.hold_setpoints()

    def release_setpoints(self) -> None:
        """Apply the queued setpoints and home positions in order of arrival."""
        self._vehicle.release_setpoints()


_BEFORE_HOME = (SetpointService, FollowService, ManualService, ParameterService, MissionService)
_AFTER_HOME = (
    *(LogService, LogStreamService, FtpService, MetadataService),
    *(VersionService, EventService, VisionService, GimbalService),
)


def all_services(vehicle: Vehicle) -> list[Service]:
    """Return every service of ``vehicle``."""
    commands = CommandService(vehicle)
    first = [ConnectionService(vehicle), commands, *(kind(vehicle) for kind in _BEFORE_HOME)]
    return [*first, HomeService(vehicle, commands), *(kind(vehicle) for kind in _AFTER_HOME)]
