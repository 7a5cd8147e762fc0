"""A camera as a MAVLink component with the camera protocol (https://mavlink.io/en/services/camera.html).

Ground stations find it by its heartbeat and request CAMERA_INFORMATION, and VIDEO_STREAM_INFORMATION with the port on
which to listen. It takes no photographs and stores nothing.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from pymavlink.dialects.v20 import common as mavlink

from xtdrone_sim.video.streams import Stream

_HAS_STREAM = mavlink.CAMERA_CAP_FLAGS_HAS_VIDEO_STREAM
_RUNNING = mavlink.VIDEO_STREAM_STATUS_FLAGS_RUNNING
_ALL = (0, 1)  # stream ids: all, and the only one
_RTP, _H264 = mavlink.VIDEO_STREAM_TYPE_RTPUDP, mavlink.VIDEO_STREAM_ENCODING_H264


class CameraComponent:
    """The component of one camera.

    Attributes:
        running: whether the video is to be sent.
    """

    def __init__(self, stream: Stream) -> None:
        """Describe a stream, initially running."""
        self.running = True
        self._stream = stream
        self._mav = mavlink.MAVLink(None, srcSystem=stream.system, srcComponent=stream.component)
        self._requests: dict[int, Callable[[float], Any]] = {
            mavlink.MAVLINK_MSG_ID_CAMERA_INFORMATION: self._information,
            mavlink.MAVLINK_MSG_ID_VIDEO_STREAM_INFORMATION: lambda _: self._stream_information(),
            mavlink.MAVLINK_MSG_ID_VIDEO_STREAM_STATUS: lambda _: self._stream_status(),
        }
        self._older = {  # commands before MAV_CMD_REQUEST_MESSAGE, which older ground stations send
            mavlink.MAV_CMD_REQUEST_CAMERA_INFORMATION: mavlink.MAVLINK_MSG_ID_CAMERA_INFORMATION,
            mavlink.MAV_CMD_REQUEST_VIDEO_STREAM_INFORMATION: mavlink.MAVLINK_MSG_ID_VIDEO_STREAM_INFORMATION,
            mavlink.MAV_CMD_REQUEST_VIDEO_STREAM_STATUS: mavlink.MAVLINK_MSG_ID_VIDEO_STREAM_STATUS,
        }

    def heartbeat(self) -> bytes:
        """Return the next HEARTBEAT as a frame."""
        return self._pack(
            mavlink.MAVLink_heartbeat_message(
                mavlink.MAV_TYPE_CAMERA, mavlink.MAV_AUTOPILOT_INVALID, 0, 0, mavlink.MAV_STATE_ACTIVE, 3
            )
        )

    def answers(self, message: Any, time: float) -> list[bytes]:
        """Return the frames of the response to a message.

        Args:
            message: any message, as decoded by pymavlink.
            time: simulated time, s.
        """
        if message.get_type() != "COMMAND_LONG" or not self._is_addressed(message):
            return []
        result, replies = self._execute(message, time)
        acknowledgement = mavlink.MAVLink_command_ack_message(
            message.command, result, 0, 0, message.get_srcSystem(), message.get_srcComponent()
        )
        return [self._pack(reply) for reply in (acknowledgement, *replies)]

    def _is_addressed(self, message: Any) -> bool:
        own = message.target_system == self._stream.system and message.target_component == self._stream.component
        to_all = message.target_system in (0, self._stream.system) and message.target_component == 0
        return own or (to_all and message.command in self._older)

    def _execute(self, message: Any, time: float) -> tuple[int, list[Any]]:
        command, first = message.command, message.param1
        if command in (mavlink.MAV_CMD_VIDEO_START_STREAMING, mavlink.MAV_CMD_VIDEO_STOP_STREAMING):
            if first not in _ALL:
                return mavlink.MAV_RESULT_DENIED, []
            self.running = command == mavlink.MAV_CMD_VIDEO_START_STREAMING
            return mavlink.MAV_RESULT_ACCEPTED, []
        if command == mavlink.MAV_CMD_REQUEST_MESSAGE:
            number = int(first) if math.isfinite(first) else -1
        elif command in self._older:
            number = self._older[command]
        else:
            return mavlink.MAV_RESULT_UNSUPPORTED, []
        if number not in self._requests:
            return mavlink.MAV_RESULT_DENIED, []
        return mavlink.MAV_RESULT_ACCEPTED, [self._requests[number](time)]

    def _information(self, time: float) -> Any:
        width, height = self._stream.size
        return mavlink.MAVLink_camera_information_message(
            round(1000.0 * time) & 0xFFFFFFFF,
            _text("XTDrone", 32),
            _text(self._stream.camera.mount.name, 32),
            0,  # no version of its firmware
            *(0.0, 0.0, 0.0),  # focal length and size of the sensor in mm: it has none
            *(width, height),
            0,  # the only lens
            _HAS_STREAM,
            0,
            b"",  # no definition file
        )

    def _values(self) -> tuple[int, float, int, int, int, int, int]:
        width, height = self._stream.size
        flags, degrees = _RUNNING if self.running else 0, round(math.degrees(self._stream.view))
        return flags, self._stream.rate, width, height, self._stream.bitrate, 0, degrees

    def _stream_information(self) -> Any:
        name, port = self._stream.camera.topics[1:].encode()[:31], str(self._stream.port).encode()
        return mavlink.MAVLink_video_stream_information_message(1, 1, _RTP, *self._values(), name, port, _H264)

    def _stream_status(self) -> Any:
        return mavlink.MAVLink_video_stream_status_message(1, *self._values())

    def _pack(self, message: Any) -> bytes:
        frame = bytes(message.pack(self._mav))
        self._mav.seq = (self._mav.seq + 1) % 256
        return frame


def _text(text: str, size: int) -> list[int]:
    return list(text.encode("ascii", "replace")[:size].ljust(size, b"\0"))
