"""Video streams: their cameras and destinations, and session descriptions for clients without MAVLink."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from xtdrone_common.fleet import Vehicle
from xtdrone_sim.cameras.cameras_of_fleet import Camera

FIRST_COMPONENT = 100
"""MAV_COMP_ID_CAMERA; a vehicle's cameras have this id and the next ones."""
MOST_CAMERAS = 6
"""Maximum per vehicle: MAV_COMP_ID_CAMERA to MAV_COMP_ID_CAMERA6."""
PAYLOAD_TYPE = 96
CLOCK = 90_000
"""Hz of RTP's time stamps (RFC 6184)."""

_TOPICS = {"rgb": "image_raw", "rgbd": "color/image_raw", "stereo": "left/image_raw"}


@dataclass(frozen=True)
class Stream:
    """The video of one camera.

    Attributes:
        camera: the camera.
        system, component: its ids in MAVLink.
        host, port: UDP destination.
        rate: images per second of simulated time.
        bitrate: maximum, bit/s of wall time.
    """

    camera: Camera
    system: int
    component: int
    host: str
    port: int
    rate: float
    bitrate: int

    @property
    def topic(self) -> str:
        """The topic of its images."""
        return f"{self.camera.topics}/{_TOPICS[self.camera.mount.kind]}"

    @property
    def size(self) -> tuple[int, int]:
        """Width and height, pixels: even, because H.264 halves the resolution of colours."""
        pinhole = self.camera.mount.pinhole
        return pinhole.width - pinhole.width % 2, pinhole.height - pinhole.height % 2

    @property
    def view(self) -> float:
        """Angle between the left and the right edge, rad."""
        mount = self.camera.mount
        edges = np.array([[0.0, mount.pinhole.cy], [mount.pinhole.width, mount.pinhole.cy]])
        rays = (mount.pinhole if mount.lens is None else mount.lens).rays(edges)
        return float(sum(math.atan2(abs(ray[0]), ray[2]) for ray in rays))

    @property
    def sdp(self) -> str:
        """The session's description (RFC 8866, RFC 6184), for players such as ffplay and VLC."""
        return (
            f"v=0\r\no=- 0 0 IN IP4 {self.host}\r\ns={self.camera.topics[1:]}\r\nc=IN IP4 {self.host}\r\nt=0 0\r\n"
            f"m=video {self.port} RTP/AVP {PAYLOAD_TYPE}\r\na=rtpmap:{PAYLOAD_TYPE} H264/{CLOCK}\r\n"
            f"a=fmtp:{PAYLOAD_TYPE} packetization-mode=1\r\n"
        )


def streams_of(
    fleet: Sequence[Vehicle], cameras: Sequence[Camera], names: Sequence[str], host: str, port: int, bitrate: int
) -> tuple[Stream, ...]:
    """Return the streams of a fleet, at consecutive ports.

    Args:
        fleet: the vehicles.
        cameras: all of their cameras, see ``cameras_of``.
        names: VEHICLE/CAMERA of those to stream; empty for the first colour camera of each vehicle.
        host, port: of the first stream.
        bitrate: bit/s of each.

    Raises:
        ValueError: a name is not that of a colour camera, or there is none.
    """
    coloured = [camera for camera in cameras if camera.mount.kind in _TOPICS]
    known = [camera.topics[1:] for camera in coloured]
    for name in names:
        if name not in known:
            raise ValueError(f"cameras: {name!r} is not known; with colours there are {', '.join(known) or 'none'}")
    systems = {vehicle.name: vehicle.system_id for vehicle in fleet}
    firsts = {camera.vehicle: camera for camera in reversed(coloured)}
    chosen = [c for c in coloured if (c.topics[1:] in names if names else firsts[c.vehicle] is c)]
    if not chosen:
        raise ValueError("cameras: no vehicle has one with colours")
    streams = []
    counts: dict[str, int] = {}
    for k, camera in enumerate(chosen):
        number = counts[camera.vehicle] = counts.get(camera.vehicle, -1) + 1
        if number >= MOST_CAMERAS:
            raise ValueError(f"cameras: {camera.topics[1:]!r} is not allowed, at most {MOST_CAMERAS} of a vehicle")
        ids = (systems[camera.vehicle], FIRST_COMPONENT + number)
        streams.append(Stream(camera, *ids, host, port + k, camera.mount.rate, bitrate))
    if streams[-1].port > 65535:
        raise ValueError(f"port: {port} is not allowed with {len(streams)} streams, at most {65536 - len(streams)}")
    return tuple(streams)
