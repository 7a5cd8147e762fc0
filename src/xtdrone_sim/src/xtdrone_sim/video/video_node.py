"""Videos of the fleet's cameras for ground stations, as a node beside the lockstep: simulated time never waits for it.

It subscribes to the topics of ``streams.Stream.topic`` and sends each image as it arrives, so the video runs as fast as
the flight. Its MAVLink components send heartbeats to the ground station's port from one socket, and respond on it.
"""

from __future__ import annotations

import contextlib
import re
import select
import socket
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import rospy
from pymavlink.dialects.v20 import common as mavlink
from sensor_msgs.msg import Image

from xtdrone_common.fleet import Vehicle, parse_fleet
from xtdrone_common.fleet.vehicle import GCS_REMOTE_PORT, check_instance, instance_port
from xtdrone_common.programs.node_command_line import ArgumentError, check_no_arguments
from xtdrone_common.programs.plain_node import init_plain_node
from xtdrone_common.settings import Settings, setting
from xtdrone_sim.cameras.cameras_of_fleet import cameras_of
from xtdrone_sim.video.camera_component import CameraComponent
from xtdrone_sim.video.encoder import Encoder, EncoderError
from xtdrone_sim.video.streams import Stream, streams_of

USAGE = "video.py"

_PORT = 5600  # QGroundControl's
_NAME = re.compile(r"[A-Za-z0-9.:_-]+")
_BEAT = 1.0  # s of wall time between heartbeats
_LARGEST = 4096  # bytes of a datagram
_AT_ONCE = 64  # datagrams between two heartbeats' checks
_BUFFER = 1 << 24  # bytes, for images on their way


def _check_host(host: str) -> None:
    if not _NAME.fullmatch(host):
        raise ValueError


@dataclass(frozen=True)
class VideoSettings(Settings):
    """Private parameters of the node that sends videos."""

    host: str = setting(
        "127.0.0.1", check=_check_host, allowed="a host's name or address", text="the ground station's machine"
    )
    port: int = setting(
        0, low=0, high=65535, text="UDP port of the first video, the others follow; 0: 5600 + 540 N for instance N"
    )
    bitrate: int = setting(2_000_000, low=50_000, high=100_000_000, unit="bit/s", text="data rate of each video")
    cameras: str = setting("", text="VEHICLE/CAMERA of each video, comma-separated; empty: each vehicle's first")
    sdp: str = setting("", text="folder for VEHICLE_CAMERA.sdp, which ffplay and VLC open; empty: none")


class VideoNode:
    """Sends videos until it is closed."""

    def __init__(self, streams: Sequence[Stream], gcs_port: int) -> None:
        """Start the encoders and subscribe.

        Args:
            streams: the videos.
            gcs_port: the ground station's UDP port for MAVLink, on the first stream's host.

        Raises:
            EncoderError: there is no encoder.
            OSError: the host is not known.
        """
        self._streams = list(streams)
        self._components = [CameraComponent(stream) for stream in streams]
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        self._station = (socket.gethostbyname(streams[0].host), gcs_port)
        self._encoders = [Encoder(stream) for stream in streams]
        self._beat = -1e9
        self._failed: set[int] = set()
        self._subscribers = [
            rospy.Subscriber(stream.topic, Image, self._take, k, queue_size=1, buff_size=_BUFFER)
            for k, stream in enumerate(streams)
        ]

    def _take(self, image: Image, k: int) -> None:
        if not self._components[k].running or k in self._failed:
            return
        pinhole = self._streams[k].camera.mount.pinhole
        if (image.encoding, image.width, image.height) != ("rgb8", pinhole.width, pinhole.height):
            rospy.logwarn_throttle(10.0, f"{self._streams[k].topic}: {image.encoding} of another size is not sent")
            return
        try:
            self._encoders[k].put(bytes(image.data))
        except EncoderError as error:
            self._failed.add(k)
            rospy.logerr(f"{error}; the video has ended")

    def step(self, timeout: float) -> None:
        """Send the heartbeats that are due, and respond to messages that arrive within ``timeout`` s of wall time."""
        now = time.monotonic()
        if now - self._beat >= _BEAT:
            self._beat = now
            for component in self._components:
                self._send(component.heartbeat(), self._station)
        if not select.select([self._socket], [], [], timeout)[0]:
            return
        for _ in range(_AT_ONCE):
            try:
                datagram, sender = self._socket.recvfrom(_LARGEST)
            except BlockingIOError:
                return
            except OSError:  # an earlier datagram had no receiver
                continue
            self._answer(datagram, sender)

    def _answer(self, datagram: bytes, sender: tuple[str, int]) -> None:
        parser = mavlink.MAVLink(None)  # a new one: no frame continues in the next datagram
        parser.robust_parsing = True
        messages: Sequence[Any] = parser.parse_buffer(datagram) or ()
        simulated = rospy.Time.now().to_sec()
        for message in messages:
            for component in self._components:
                for frame in component.answers(message, simulated):
                    self._send(frame, sender)

    def _send(self, frame: bytes, address: tuple[str, int]) -> None:
        with contextlib.suppress(OSError):  # no network or a full buffer: the next heartbeat follows
            self._socket.sendto(frame, address)

    def close(self) -> None:
        """End the encoders."""
        for subscriber in self._subscribers:
            subscriber.unregister()
        for encoder in self._encoders:
            encoder.close()
        self._socket.close()


def chosen_streams(settings: VideoSettings, fleet: Sequence[Vehicle], rate: float = 0.0) -> tuple[Stream, ...]:
    """Return the streams that the settings describe.

    Args:
        settings: see ``VideoSettings``.
        fleet: the vehicles.
        rate: rate of all cameras, Hz; 0: as in their vehicles' files.

    Raises:
        ValueError: see ``streams_of``.
    """
    port = settings.port or instance_port(_PORT, fleet[0].instance)
    names = [name.strip().strip("/") for name in settings.cameras.split(",") if name.strip()]
    streams = streams_of(fleet, cameras_of(fleet), names, settings.host, port, settings.bitrate)
    return tuple(replace(stream, rate=rate or stream.rate) for stream in streams)


def write_sdp(folder: str, streams: Sequence[Stream]) -> None:
    """Write a description of each stream to a folder, which is created if missing.

    Raises:
        ValueError: the folder cannot be written.
    """
    try:
        Path(folder).mkdir(parents=True, exist_ok=True)
        for stream in streams:
            name = stream.camera.topics[1:].replace("/", "_")
            (Path(folder) / f"{name}.sdp").write_text(stream.sdp, encoding="ascii", newline="")
    except OSError as error:
        raise ValueError(f"sdp: {folder!r} is not allowed, a folder to write into: {error.strerror}") from error


def main(arguments: Sequence[str]) -> None:
    """Send videos until shutdown.

    Raises:
        ArgumentError: an argument or parameter is not allowed, or there is no encoder.
    """
    check_no_arguments(arguments)
    init_plain_node("video")
    text = str(rospy.get_param("~fleet", rospy.get_param("/xtdrone/fleet", "typhoon_h480")))
    try:
        settings = VideoSettings.from_parameters(rospy.get_param)
        instance = check_instance(rospy.get_param("/xtdrone/instance", 0))
        rate = float(rospy.get_param("/cameras/rate", 0.0))  # of all cameras, in place of their own
        streams = chosen_streams(settings, parse_fleet(text, instance), rate)
        if settings.sdp:
            write_sdp(settings.sdp, streams)
        node = VideoNode(streams, instance_port(GCS_REMOTE_PORT, instance))
    except (ValueError, EncoderError, OSError) as error:
        raise ArgumentError(str(error)) from error
    for stream in streams:
        rospy.loginfo(f"video of {stream.camera.topics}: H.264 by RTP to {stream.host}:{stream.port}")
    try:
        while not rospy.is_shutdown():
            node.step(0.1)
    finally:
        node.close()
