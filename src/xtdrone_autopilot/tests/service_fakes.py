"""One vehicle's MAVLink services without sockets, for tests: messages in, replies out."""

from __future__ import annotations

from typing import Any

from autopilot_fakes import FIRST_ID, FakeAutopilot
from pymavlink.dialects.v20 import common as mavlink

from xtdrone_autopilot.commander.commander import Commander
from xtdrone_autopilot.logger.mavlink_log_pieces import LogStream
from xtdrone_autopilot.mavlink.receiver import Receiver
from xtdrone_autopilot.mavlink.streams.stream_schedule import GCS_RATES, Streams
from xtdrone_autopilot.mavlink.streams.telemetry import Telemetry
from xtdrone_autopilot.mavlink.wire.codec import decoder, split
from xtdrone_autopilot.mavlink.wire.dialect import MESSAGES
from xtdrone_autopilot.parameters.parameters import Parameters
from xtdrone_common.fleet import Vehicle

SYSTEM = FIRST_ID + 1


class FakeLink:
    """A client's link and port that keep all sent messages, decoded."""

    def __init__(self, telemetry: Telemetry, system_id: int) -> None:
        self.telemetry = telemetry
        self.streams = Streams(telemetry, GCS_RATES)
        self.system_id = system_id
        self.data_rate = 4_000_000
        self.sender = (0, 0)
        self.sent: list[Any] = []
        self.frames: list[bytes] = []
        self.texts: list[tuple[int, str]] = []
        self.warnings: list[str] = []
        self.foreign = self.malformed = 0
        self.open = True
        self.client = mavlink.MAVLink(None, srcSystem=255, srcComponent=190)
        self._mav = mavlink.MAVLink(None, srcSystem=system_id, srcComponent=1)

    def link_of(self, *_: object) -> FakeLink:
        return self

    def note_malformed(self, _sender: object) -> None:
        self.malformed += 1

    def heard(self, *_: object) -> None:
        self.streams.start(0)

    def send_message(self, message: Any) -> None:
        self._take(message.pack(self._mav))

    def send_values(self, message: Any, values: Any, _now_us: int) -> None:
        self._take(message.frame(message.payload(values), 0, self.system_id, 1))

    def send_payload(self, message: Any, payload: bytes) -> None:
        self._take(message.frame(payload, 0, self.system_id, 1))

    def _take(self, frame: bytes) -> None:
        self.frames.append(bytes(frame))
        ((number, _, _, frame),) = split(bytes(frame))
        self.sent.append((MESSAGES[number].msgname, decoder(MESSAGES[number].msgname)(frame)))

    def silent(self, _now_us: int) -> bool:
        return False

    def send_text(self, severity: int, text: str) -> None:
        self.texts.append((severity, text))

    def warn(self, _kind: str, text: str, _now_us: int) -> None:
        self.warnings.append(text)


class Served:
    """A vehicle with its services, and two clients' links."""

    def __init__(self, parameters: Parameters | None = None, system: int = SYSTEM) -> None:
        self.autopilot = FakeAutopilot(1)
        self.vehicle = Vehicle("iris", 0, system - 1)
        self.parameters = parameters or Parameters({"MAV_SYS_ID": system})
        self.commander = Commander(self.vehicle, self.autopilot, self.parameters, 0)
        telemetry = Telemetry(self.commander, self.autopilot, 0)
        self.link, self.other = (FakeLink(telemetry, system) for _ in range(2))
        self.commander.open_log_stream = LogStream
        self.receiver = Receiver(self.commander, self.autopilot, 0, lambda: [self.link, self.other])
        self.commander.update()
        self.commander.texts.clear()

    def ask(self, message: Any, link: FakeLink | None = None, *, participant: bool = False) -> list[Any]:
        """Pass ``message`` (pymavlink's or a packed frame) to the services; return their immediate replies."""
        link = link or self.link
        link.sent.clear()
        frame = message if isinstance(message, bytes) else bytes(message.pack(link.client))
        sender, now_us = ("127.0.0.1", 14550), self.autopilot.time_us
        self.receiver.handle_datagram(link, frame, sender, now_us, participant=participant)
        return [answer for _, answer in link.sent]

    def command(self, number: int, *params: float, link: FakeLink | None = None) -> tuple[int | None, list[str]]:
        """Return a COMMAND_LONG's result, None without an acknowledgement, and its texts, without tabs."""
        self.commander.texts.clear()
        values = [*params, *[0.0] * (7 - len(params))]
        answers = self.ask(mavlink.MAVLink_command_long_message(SYSTEM, 1, number, 0, *values), link)
        acks = [m for m in answers if type(m).__name__ == "COMMAND_ACK"]
        assert all(m.command == number for m in acks)
        assert len(acks) <= 1
        return (acks[0].result if acks else None), [text.rstrip("\t") for _, text in self.commander.texts]

    def run(self, seconds: float, step_us: int = 4000) -> list[tuple[int, str, Any]]:
        """Advance time; return (time, name, message) of each message that the services send on the first link."""
        found = []
        for _ in range(round(seconds * 1e6 / step_us)):
            self.autopilot.time_us += step_us
            self.link.sent.clear()
            if self.receiver.next_due_us <= self.autopilot.time_us:
                self.receiver.update(self.autopilot.time_us)
            found += [(self.autopilot.time_us, *entry) for entry in self.link.sent]
        return found
