"""Log streaming: MAV_CMD_LOGGING_START and MAV_CMD_LOGGING_STOP, and a ULog in LOGGING_DATA.

As in PX4 v1.14's ``mavlink_ulog``, header and definitions are sent as LOGGING_DATA_ACKED, one piece at a time, each
repeated every 50 ms until the client acknowledges it (50 times at most); the data follow as unacknowledged
LOGGING_DATA, at most ``BURST`` messages every 10 ms of simulated time. A vehicle has one stream at a time.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar

from pymavlink.dialects.v20 import common as mavlink

from xtdrone_autopilot.commander.commander import CRITICAL, Result
from xtdrone_autopilot.logger.mavlink_log_pieces import PIECE_SIZE, LogStream, Piece
from xtdrone_autopilot.mavlink.client_link import Link
from xtdrone_autopilot.mavlink.service_base import NEVER_US, Service, Vehicle
from xtdrone_autopilot.mavlink.wire.frame_packing import Format

BURST = 8  # messages a period: 199 kB of a log in a simulated second, four times as much as it grows
PERIOD_US = 10_000
ACK_TIMEOUT_US = 50_000
MAX_TRIES = 50
LEAST_DATA_RATE = 5000  # bytes/s
_ACKED, _DATA = Format("LOGGING_DATA_ACKED"), Format("LOGGING_DATA")


class LogStreamService(Service):
    """Streams the vehicle's log to one client.

    The stream ends with MAV_CMD_LOGGING_STOP from any client, when a piece is not acknowledged in 2.5 s, when the
    client is silent for 5 s, and when the autopilot is rebooted.
    """

    MESSAGES: ClassVar[dict[str, str]] = {"LOGGING_ACK": "_acknowledge"}

    def __init__(self, vehicle: Vehicle) -> None:
        """Serve ``vehicle``."""
        super().__init__(vehicle)
        self._stream: LogStream | None = None
        self._link: Link | None = None
        self._target = (0, 0)  # system and component of the client
        self._tries = 0  # number of times that the first piece of the definitions has been sent
        self._sent_us = 0
        vehicle.on_command[mavlink.MAV_CMD_LOGGING_START] = self._start
        vehicle.on_command[mavlink.MAV_CMD_LOGGING_STOP] = self._stop

    def _start(self, params: Sequence[float], link: Link) -> Result | None:
        """Open a stream and return the result as PX4 does; None, for no acknowledgement, if no logger is running."""
        if link.data_rate < LEAST_DATA_RATE:
            link.send_text(CRITICAL, "Not enough bandwidth to enable log streaming")
            return Result.DENIED
        if not abs(params[0]) < 0.5:  # the log's format: 0 is ULog
            return Result.UNSUPPORTED
        open_stream = self.vehicle.commander.open_log_stream
        if open_stream is None:
            return None
        stream = open_stream()
        if stream is None:
            return Result.TEMPORARILY_REJECTED
        self._stream, self._link, self._target = stream, link, link.sender
        self._tries = 0
        self.due_us = self.vehicle.now_us
        return Result.ACCEPTED

    def _stop(self, _params: Sequence[float], _link: Link) -> Result:
        self._end()
        return Result.ACCEPTED

    def _end(self) -> None:
        if self._stream is not None:
            self._stream.close()
        self._stream = self._link = None
        self.due_us = NEVER_US

    def _acknowledge(self, link: Link, m: Any) -> None:
        """Send the next piece of the definitions at once; the client sets the pace."""
        stream = self._stream
        if stream is None or link is not self._link or not stream.definitions:
            return
        if self._tries and m.sequence == stream.definitions[0].sequence:
            stream.definitions.popleft()
            self._tries = 0
            if stream.definitions:
                self._send_definition(link, stream, self.vehicle.now_us)

    def update(self, now_us: int) -> None:
        """Send the messages that are due, or end the stream."""
        stream, link = self._stream, self._link
        if stream is None or link is None or stream.closed or not link.open or link.silent(now_us):
            self._end()
            return
        self.due_us = (now_us // PERIOD_US + 1) * PERIOD_US
        if not stream.definitions:
            for _ in range(min(BURST, len(stream.data))):
                self._send(_DATA, link, stream.data.popleft(), now_us)
        elif not self._tries or now_us - self._sent_us >= ACK_TIMEOUT_US:
            if self._tries == MAX_TRIES:
                link.warn("log stream", "the log stream ends: the client does not acknowledge it", now_us)
                self._end()
                return
            self._send_definition(link, stream, now_us)

    def _send_definition(self, link: Link, stream: LogStream, now_us: int) -> None:
        self._tries += 1
        self._sent_us = now_us
        self._send(_ACKED, link, stream.definitions[0], now_us)

    def _send(self, message: Format, link: Link, piece: Piece, now_us: int) -> None:
        data = piece.data.ljust(PIECE_SIZE, b"\0")
        values = (piece.sequence, *self._target, len(piece.data), piece.first_message, *data)
        link.send_values(message, values, now_us)
