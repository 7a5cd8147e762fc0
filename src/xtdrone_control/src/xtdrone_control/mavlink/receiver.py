"""Routes the MAVLink messages that one vehicle receives to its services."""

from __future__ import annotations

import struct
from collections.abc import Callable, Collection
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from xtdrone_control.autopilot.commander.commander import Commander
from xtdrone_control.mavlink.wire.codec import FrameError, decoder, split, version
from xtdrone_control.mavlink.wire.dialect import MESSAGE_ID, MESSAGES
from xtdrone_control.mavlink.wire.packing import COMPONENT_ID

from .link import Address, Link
from .port import Port
from .service import Handler, Service, Vehicle
from .services import all_services

if TYPE_CHECKING:
    from xtdrone_control.autopilot.autopilot import Autopilot

_BROADCAST = 0


@dataclass(frozen=True)
class _Entry:
    """How one kind of message is handled.

    Attributes:
        decode: frame to message.
        handle: the service's function.
        system_field: field of the target system, empty when the message is for everybody.
        component_field: field of the target component, likewise.
    """

    decode: Callable[[bytes], Any]
    handle: Handler
    system_field: str
    component_field: str


def _field(name: str, *candidates: str) -> str:
    fields = MESSAGES[MESSAGE_ID[name]].fieldnames
    return next((candidate for candidate in candidates if candidate in fields), "")


def _entry(name: str, handle: Handler) -> _Entry:
    if name == "PING":  # its target says whether it is a question
        return _Entry(decoder(name), handle, "", "")
    return _Entry(decoder(name), handle, _field(name, "target_system", "target"), _field(name, "target_component"))


class Receiver:
    """Acts on the messages of one vehicle. Nothing that comes in raises.

    In a tick of the lockstep, commands and requests come when some participant's service call makes them, and
    setpoints and home positions when the MAVROS layer has its turn: which is first, the scheduler decides. Therefore
    the latter can be held until all are done; commands and requests, whose answers are waited for, then always come
    first. Clients outside the lockstep are not held: what one of them sends acts in the order of sending, so that a
    setpoint counts for the command to go to OFFBOARD that follows it. An origin (SET_GPS_GLOBAL_ORIGIN) is not held,
    for it is answered at once with the origin that holds.
    """

    def __init__(
        self, commander: Commander, autopilot: Autopilot, index: int, clients: Callable[[], list[Link]] = list
    ) -> None:
        """Take the vehicle's commander and its place in ``autopilot``; ``clients`` returns the links of all."""
        self._vehicle = Vehicle(commander, autopilot, index, clients)
        self._services = all_services(self._vehicle)
        self._transfers = [service for service in self._services if type(service).waiting is not Service.waiting]
        self._entries = {
            MESSAGE_ID[name]: _entry(name, handle)
            for service in self._services
            for name, handle in service.handlers.items()
        }
        self.messages = tuple(name for service in self._services for name in service.handlers)

    def take(self, port: Port, datagram: bytes, sender: Address, now_us: int, *, participant: bool = False) -> None:
        """Act on every message in ``datagram``, which came to ``port`` from ``sender``; answers are queued there.

        Args:
            port: where it came to.
            datagram: its content.
            sender: address of the client.
            now_us: simulated time, microseconds.
            participant: whether the client takes part in the lockstep.
        """
        self._vehicle.now_us = now_us
        self._vehicle.participant = participant
        try:
            for number, system, component, frame in split(datagram):
                entry = self._entries.get(number)
                if entry is not None:
                    self._dispatch(port, frame, sender, (system, component), entry)
        except FrameError as error:
            self._malformed(port, sender, error)

    def _dispatch(self, port: Port, frame: bytes, sender: Address, origin: tuple[int, int], entry: _Entry) -> None:
        now_us = self._vehicle.now_us
        try:
            message = entry.decode(frame)
        except (ValueError, struct.error, TypeError) as error:  # FrameError is a ValueError, as is bad text
            self._malformed(port, sender, error)
            return
        system = self._vehicle.system_id
        if entry.system_field and getattr(message, entry.system_field) not in (_BROADCAST, system):
            port.foreign += 1
            wanted = getattr(message, entry.system_field)
            port.warn("foreign", f"message for system {wanted} ignored, this is {system}", now_us)
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
        """Simulated time, microseconds, at which ``update`` has something to do next."""
        return min(service.due_us for service in self._services)

    def update(self, now_us: int) -> None:
        """Let the services go on with what takes time."""
        self._vehicle.now_us = now_us
        for service in self._services:
            if service.due_us <= now_us:
                service.update(now_us)

    @property
    def waits(self) -> bool:
        """Whether somebody waits for the next part of a transfer."""
        return any(service.waiting for service in self._transfers)

    def send_parts(self, now_us: int, counted: Collection[int]) -> None:
        """Queue the next part of every transfer, save those to ``counted`` ports: while time stands still."""
        self._vehicle.now_us = now_us
        for service in self._transfers:
            for link in service.waiting:
                if link.peer[1] not in counted:
                    service.send_part(link, now_us)

    def hold(self) -> None:
        """Queue setpoints and home positions of participants from now on until ``release``."""
        self._vehicle.hold()

    def release(self) -> None:
        """Act on what was queued, in the order of arrival."""
        self._vehicle.release()
