"""MAVLink frames from the autopilot on a topic, and frames from a topic to the autopilot."""

from __future__ import annotations

import contextlib

from mavros_msgs.msg import Mavlink

from xtdrone_autopilot.mavlink.wire.codec import FrameError, decoder
from xtdrone_autopilot.mavlink.wire.dialect import MESSAGE_ID
from xtdrone_mavros.feeds import Feed
from xtdrone_mavros.link.raw_frames import RawFrameError, fill, to_frame
from xtdrone_mavros.uas import RAW, Plugin, Uas

_COMMANDS = {MESSAGE_ID[name]: decoder(name) for name in ("COMMAND_LONG", "COMMAND_INT")}


class MavlinkBridge(Plugin):
    """MAVROS's bridge: ``mavlink/from`` and ``mavlink/to``, beside the vehicle's ``mavros`` namespace.

    While ``mavlink/from`` has a subscriber, all streams of the autopilot stay on or are switched on again.
    """

    name = "mavlink"
    listed = False

    def __init__(self, uas: Uas) -> None:
        """Advertise and subscribe."""
        super().__init__(uas)
        space = uas.prefix.rpartition("/")[0] + "/mavlink"
        self._from = uas.topic(f"{space}/from", Mavlink())
        self.messages = {RAW: Feed(self._publish, self._from, all_streams=True)}
        uas.subscribe(f"{space}/to", Mavlink, self._send)

    def _publish(self, frame: bytes) -> None:
        message = self._from.message
        self.uas.stamp_now(message.header)
        fill(message, frame)
        self._from.publish(message)

    def _send(self, message: Mavlink) -> None:
        try:
            frame = to_frame(message)
        except RawFrameError as error:
            self.uas.warn("mavlink/to", "a message on mavlink/to is not forwarded: %s", error)
            return
        if message.msgid in _COMMANDS:
            self._note_command(message.msgid, frame)
        self.uas.link.send_frame(frame)

    def _note_command(self, number: int, frame: bytes) -> None:
        """Leave the stream alone whose interval the frame sets."""
        with contextlib.suppress(FrameError):  # the autopilot drops such a frame, too
            command = _COMMANDS[number](frame)
            self.uas.streams.note_command(command.command, command.param1)
