"""MAVROS's ``fcu_url``: the two ends of the UDP link to an autopilot."""

from __future__ import annotations

import re
from typing import NamedTuple

_HIGHEST_PORT = 65535


class AutopilotLinkError(RuntimeError):
    """A link cannot be opened: its address is malformed or already in use."""


class FcuUrl(NamedTuple):
    """The local and remote UDP addresses of a MAVROS ``fcu_url``."""

    bind_host: str
    bind_port: int
    remote_host: str
    remote_port: int

    def shifted(self, number: int) -> FcuUrl:
        """Return a copy with both ports raised by ``number``.

        Raises:
            AutopilotLinkError: a port would exceed 65535.
        """
        highest = max(self.bind_port, self.remote_port) + number
        if highest > _HIGHEST_PORT:
            raise AutopilotLinkError(f"fleet_url: vehicle {number} would get port {highest}, at most {_HIGHEST_PORT}")
        return self._replace(bind_port=self.bind_port + number, remote_port=self.remote_port + number)


def parse_fcu_url(url: str) -> FcuUrl:
    """Parse ``udp://[bind_host][:bind_port]@[remote_host][:remote_port]``.

    Missing parts default to MAVROS's values: bind 0.0.0.0:14555, remote 127.0.0.1:14550.

    Raises:
        AutopilotLinkError: another scheme or format, or a port outside 1..65535.
    """
    match = re.fullmatch(r"udp://([^:@/]*)(?::(\d+))?@([^:@/]*)(?::(\d+))?/?(?:\?ids=\d+,\d+)?", url)
    if match is None:
        raise AutopilotLinkError(f"fcu_url: {url!r} is not of the form udp://[host][:port]@[host][:port]")
    parts = FcuUrl(match[1] or "0.0.0.0", int(match[2] or 14555), match[3] or "127.0.0.1", int(match[4] or 14550))
    for port in (parts.bind_port, parts.remote_port):
        if not 1 <= port <= _HIGHEST_PORT:
            raise AutopilotLinkError(f"fcu_url: port {port} in {url!r} is not in 1..{_HIGHEST_PORT}")
    return parts
