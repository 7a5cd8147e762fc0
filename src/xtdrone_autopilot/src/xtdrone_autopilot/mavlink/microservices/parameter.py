"""Parameter protocol: list, read, write, and the hash of all parameters.

As in PX4, a list starts with the hash, so that a ground station that has these values can stop the list by sending the
hash back; then follow 20 parameters every 20 ms, and the hash again. A second request during a list restarts it.
Unknown names and wrong types get no reply; values out of range are accepted. A written value is broadcast, then the
values that it changes in other parameters.

A client that writes parameters without an effect here is told so once for each, in one text for all that it writes in a
row.

Clients outside the lockstep share those 20 parameters every 20 ms: there may be many of them, and a list costs far more
than its request.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable
from typing import Any, ClassVar

from pymavlink.dialects.v20 import common as mavlink

from xtdrone_autopilot.events.announcements import WARNING
from xtdrone_autopilot.mavlink.client_link import Link
from xtdrone_autopilot.mavlink.service_base import NEVER_US, Service, Vehicle
from xtdrone_autopilot.mavlink.wire.frame_packing import Format
from xtdrone_autopilot.parameters.parameters import FLOAT, INDEX, INT32, NAMES, ParameterError, describe

_HASH_NAME = "_HASH_CHECK"
_HASH_TYPE = 5  # MAV_PARAM_TYPE_UINT32
_NO_INDEX = 0xFFFF
_PARAM_VALUE = Format("PARAM_VALUE")
_BURST = 20
_BURST_PERIOD_US = 20_000
_QUIET_US = 1_000_000  # after the last written parameter without effect, until the client is told


class ParameterService(Service):
    """Lists, reads and writes the vehicle's parameters."""

    MESSAGES: ClassVar[dict[str, str]] = {
        "PARAM_REQUEST_LIST": "_param_request_list",
        "PARAM_REQUEST_READ": "_param_request_read",
        "PARAM_SET": "_param_set",
    }
    CAPABILITIES = mavlink.MAV_PROTOCOL_CAPABILITY_PARAM_FLOAT | mavlink.MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_BYTEWISE

    def __init__(self, vehicle: Vehicle) -> None:
        """Register the service with ``vehicle``."""
        super().__init__(vehicle)
        self._parameters = vehicle.commander.parameters
        self._lists: dict[Link, int] = {}  # index of the next parameter by link, the next to be served first
        self._participants: set[Link] = set()  # links of lockstep participants among them
        self._told: dict[Link, set[str]] = {}  # parameters without effect that a link has been told of
        self._untold: dict[Link, tuple[list[str], int]] = {}  # those that it has just written, and when it is told

    def update(self, now_us: int) -> None:
        """Send the next parameters of the running lists."""
        others = [link for link in self._lists if link not in self._participants]
        for link in [link for link in self._lists if link in self._participants] + others[:1]:
            self.send_part(link, now_us)
        for link in [link for link, (_, due_us) in self._untold.items() if due_us <= now_us]:
            self._tell_without_effect(link)
        self._schedule(now_us)

    @property
    def waiting(self) -> list[Link]:
        """Links to which a list is being sent."""
        return list(self._lists)

    def send_part(self, link: Link, _now_us: int) -> None:
        """Queue the next parameters of a list."""
        start = self._lists.pop(link)
        if not link.open:
            self._participants.discard(link)
            return
        for name in NAMES[start : start + _BURST]:
            self._send_parameter((link,), name)
        if start + _BURST < len(NAMES):
            self._lists[link] = start + _BURST  # moves to the end
        else:
            self._participants.discard(link)
            self._send_hash(link)

    def _schedule(self, now_us: int) -> None:
        part_us = (now_us // _BURST_PERIOD_US + 1) * _BURST_PERIOD_US if self._lists else NEVER_US
        self.due_us = min([part_us, *(due_us for _, due_us in self._untold.values())])

    def _is_for_us(self, m: Any) -> bool:
        """Return whether ``m`` addresses this system: PX4 ignores broadcast parameter messages."""
        return bool(m.target_system == self.vehicle.system_id)

    def _param_request_list(self, link: Link, m: Any) -> None:
        if not self._is_for_us(m):
            return
        if link not in self._lists:
            self._send_hash(link)
        self._lists[link] = 0
        if self.vehicle.participant:
            self._participants.add(link)
        self._schedule(self.vehicle.now_us)

    def _param_request_read(self, link: Link, m: Any) -> None:
        if not self._is_for_us(m):
            return
        if m.param_index < 0:
            name = m.param_id
        elif m.param_index < len(NAMES):
            name = NAMES[m.param_index]
        else:
            return
        if name == _HASH_NAME:
            self._send_hash(link)
        elif name in INDEX:
            self._send_parameter((link,), name)

    def _param_set(self, link: Link, m: Any) -> None:
        if not self._is_for_us(m):
            return
        if m.param_id == _HASH_NAME:  # the ground station already has these values
            self._lists.pop(link, None)
            self._participants.discard(link)
            return
        value = m.param_value
        if m.param_type == INT32:
            (value,) = struct.unpack("<i", struct.pack("<f", value))
        try:
            stored = self._parameters.set(m.param_id, value, m.param_type)
        except ParameterError as error:
            # no reply, as in PX4
            link.warn("parameter", f"parameter not set: {error}", self.vehicle.now_us)
            return
        self._parameters.save()
        links = dict.fromkeys((link, *self.vehicle.clients()))
        self._send_parameter(links, m.param_id, stored)
        for name in self._parameters.take_adjusted():
            self._send_parameter(links, name)
        if not describe(m.param_id).has_effect:
            self._note_without_effect(link, m.param_id)

    def _note_without_effect(self, link: Link, name: str) -> None:
        """Schedule a text on a written parameter without effect, unless the link has been told of it."""
        told = self._told.setdefault(link, set())
        if name in told:
            return
        told.add(name)
        names, _ = self._untold.get(link, ([], 0))
        self._untold[link] = [*names, name], self.vehicle.now_us + _QUIET_US
        self._schedule(self.vehicle.now_us)

    def _tell_without_effect(self, link: Link) -> None:
        names, _ = self._untold.pop(link)
        self._told = {known: told for known, told in self._told.items() if known.open}
        if not link.open:
            return
        if len(names) == 1:
            link.send_text(WARNING, f"{names[0]} stored, no effect here")
        else:
            text = f"{len(names)} parameters stored, no effect here: ./xtdrone gcs check FILE lists them"
            link.send_text(WARNING, text)

    def _send_parameter(self, links: Iterable[Link], name: str, value: float | None = None) -> None:
        """Send a parameter's current value, or ``value``, which it has just been given."""
        value = self._parameters.get(name) if value is None else value
        kind = FLOAT
        if describe(name).type == INT32:
            kind = INT32
            (value,) = struct.unpack("<f", struct.pack("<i", int(value)))
        payload = _PARAM_VALUE.payload((value, len(NAMES), INDEX[name], name.encode(), kind))
        for link in links:
            link.send_payload(_PARAM_VALUE, payload)

    def _send_hash(self, link: Link) -> None:
        (value,) = struct.unpack("<f", struct.pack("<I", self._parameters.hash()))
        link.send_message(
            mavlink.MAVLink_param_value_message(_HASH_NAME.encode(), value, _HASH_TYPE, len(NAMES), _NO_INDEX)
        )
