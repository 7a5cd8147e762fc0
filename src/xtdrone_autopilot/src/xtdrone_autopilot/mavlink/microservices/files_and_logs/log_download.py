"""Log transfer protocol, as in PX4's mavlink_log_handler: list, download and erase flight logs.

Transfers are paced by simulated time, a few messages every 10 ms, so that the client's socket buffer does not overflow;
clients request lost messages again. Each client has a separate list and transfer.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, ClassVar

from pymavlink.dialects.v20 import common as mavlink

from xtdrone_autopilot.logger.log_folder import LogEntry, LogFolder
from xtdrone_autopilot.mavlink.client_link import Link
from xtdrone_autopilot.mavlink.service_base import NEVER_US, Service, Vehicle

BURST = 32  # messages in a period: 288 kB of a log in a simulated second
PERIOD_US = 10_000
_CHUNK = 90  # bytes of LOG_DATA
_NOTHING = bytes(_CHUNK)


@dataclass
class _Client:
    """State of the transfers to one client.

    Attributes:
        logs: the list sent last; the index of a log is its id.
        listing: ids of the entries still to be sent.
        log: id of the log being sent.
        offset: offset of the next byte to send.
        remaining: number of bytes still to be sent.
        sending: whether a log is being sent.
    """

    logs: list[LogEntry]
    listing: range = field(default_factory=lambda: range(0))
    log: int = 0
    offset: int = 0
    remaining: int = 0
    sending: bool = False

    @property
    def is_waiting(self) -> bool:
        return self.sending or bool(self.listing)


class LogService(Service):
    """Lists, sends and erases the vehicle's logs."""

    MESSAGES: ClassVar[dict[str, str]] = {
        "LOG_REQUEST_LIST": "_list",
        "LOG_REQUEST_DATA": "_data",
        "LOG_REQUEST_END": "_end",
        "LOG_ERASE": "_erase",
    }

    def __init__(self, vehicle: Vehicle) -> None:
        """Register the service with ``vehicle``."""
        super().__init__(vehicle)
        self._clients: dict[Link, _Client] = {}

    @property
    def _folder(self) -> LogFolder | None:
        logs = self.vehicle.autopilot.logs
        return logs[self.vehicle.index] if logs else None

    def _entries(self) -> list[LogEntry]:
        return [] if self._folder is None else self._folder.entries()

    def _list(self, link: Link, m: Any) -> None:
        client = self._clients[link] = _Client(self._entries())
        last = max(len(client.logs) - 1, 0)
        client.listing = range(min(m.start, last), min(m.end, last) + 1)
        self._schedule()

    def _data(self, link: Link, m: Any) -> None:
        client = self._clients.get(link)
        if client is None:  # PX4 does not reply; some clients use an older list
            client = self._clients[link] = _Client(self._entries())
        if m.id >= len(client.logs):
            return
        size = client.logs[m.id].size
        client.listing = range(0)
        client.log, client.offset, client.sending = m.id, m.ofs, True
        client.remaining = min(max(size - m.ofs, 0), m.count)
        self._schedule()

    def _end(self, link: Link, _m: Any) -> None:
        self._clients.pop(link, None)

    def _erase(self, link: Link, _m: Any) -> None:
        self._clients.pop(link, None)
        if self._folder is None:
            return
        try:
            self._folder.erase()
        except OSError as error:
            link.warn("log", f"logs not erased: {error}", self.vehicle.now_us)

    def _schedule(self) -> None:
        if self.due_us == NEVER_US:
            self.due_us = self.vehicle.now_us

    def update(self, now_us: int) -> None:
        """Send the next messages of every transfer."""
        for link in [link for link in self._clients if not link.open]:
            del self._clients[link]
        for link in self.waiting:
            self.send_part(link, now_us)
        self.due_us = (now_us // PERIOD_US + 1) * PERIOD_US if self.waiting else NEVER_US

    @property
    def waiting(self) -> list[Link]:
        """Links to which a list or a log is being sent."""
        return [link for link, client in self._clients.items() if client.is_waiting]

    def send_part(self, link: Link, now_us: int) -> None:
        """Queue the next messages of a transfer."""
        client = self._clients[link]
        self._send_entries(link, client)
        if client.sending:
            self._send_data(link, client, now_us)

    def _send_entries(self, link: Link, client: _Client) -> None:
        ids, client.listing = client.listing[:BURST], client.listing[BURST:]
        for number in ids:
            found = client.logs[number] if client.logs else None
            time_utc, size = (found.time_utc, found.size) if found is not None else (0, 0)
            last = client.listing[-1] if client.listing else ids[-1]
            link.send_message(
                mavlink.MAVLink_log_entry_message(number, len(client.logs), last, time_utc, min(size, 0xFFFFFFFF))
            )

    def _send_data(self, link: Link, client: _Client, now_us: int) -> None:
        path = client.logs[client.log].path
        wanted = min(client.remaining, BURST * _CHUNK)
        try:
            with path.open("rb") as file:
                file.seek(client.offset)
                data = file.read(wanted)
        except OSError as error:  # erased in the meantime
            link.warn("log", f"log {client.log} cannot be read: {error}", now_us)
            data = b""
        for start in range(0, max(len(data), 1), _CHUNK):
            chunk = data[start : start + _CHUNK]
            padded = chunk + _NOTHING[len(chunk) :]
            link.send_message(mavlink.MAVLink_log_data_message(client.log, client.offset, len(chunk), list(padded)))
            client.offset += len(chunk)
        client.remaining -= len(data)
        client.sending = len(data) == wanted and client.remaining > 0
