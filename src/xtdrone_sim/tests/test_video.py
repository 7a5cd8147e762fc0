"""Videos for ground stations: an independent decoder shows the pictures, and a client finds them by MAVLink."""

from __future__ import annotations

import contextlib
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from graph_of_nodes import Graph, needs_ros, running_graph, wait_until
from numpy.typing import NDArray
from pymavlink.dialects.v20 import common as mavlink

from xtdrone_common.fleet import parse_fleet

try:
    import rospy
    from sensor_msgs.msg import Image

    from xtdrone_sim.cameras.cameras_of_fleet import cameras_of
    from xtdrone_sim.video.camera_component import CameraComponent
    from xtdrone_sim.video.encoder import Encoder, EncoderError
    from xtdrone_sim.video.streams import streams_of
    from xtdrone_sim.video.video_node import VideoSettings, chosen_streams, write_sdp
except ImportError:
    rospy = None

pytestmark = needs_ros

NODE = Path(__file__).parents[1] / "nodes" / "video.py"
FLEET = "typhoon_h480:2"
CAMERA = "/typhoon_h480_0/cgo3_camera"
SIZE = (360, 640)
GCS_PORT = 14550


def picture(number: int = 0) -> NDArray[np.uint8]:
    """Return a picture with colours, a gradient, and a square that moves with the number."""
    rows, columns = np.indices(SIZE)
    image = np.stack([columns * 255 / 639, rows * 255 / 359, np.full(SIZE, 90.0)], axis=2).astype(np.uint8)
    left = 40 + 8 * (number % 60)
    image[150:210, left : left + 60] = (250, 240, 20)
    return image


def teller() -> None:
    """Publish the first camera's pictures, free-running."""
    rospy.init_node("teller")
    publisher = rospy.Publisher(f"{CAMERA}/image_raw", Image, queue_size=1)
    number = 0
    while not rospy.is_shutdown():
        data = picture(number).tobytes()
        publisher.publish(Image(height=SIZE[0], width=SIZE[1], encoding="rgb8", step=3 * SIZE[1], data=data))
        number += 1
        time.sleep(0.05)


def decoded(sdp: Path) -> NDArray[np.uint8]:
    """Return a picture received and decoded by ffmpeg, RGB."""
    options = ("-loglevel", "error", "-protocol_whitelist", "file,udp,rtp", "-i", str(sdp), "-frames:v", "3")
    command = ["ffmpeg", "-nostdin", *options, "-f", "rawvideo", "-pix_fmt", "rgb24", "pipe:1"]
    done = subprocess.run(command, capture_output=True, timeout=30.0, check=True)
    return np.frombuffer(done.stdout, np.uint8).reshape(-1, *SIZE, 3)[-1]


@contextlib.contextmanager
def sending(stream: Any) -> Iterator[None]:
    """Send a moving picture in the background."""
    encoder = Encoder(stream)
    stop = threading.Event()

    def send() -> None:
        number = 0
        while not stop.wait(0.05):
            encoder.put(picture(number).tobytes())
            number += 1

    sender = threading.Thread(target=send)
    sender.start()
    try:
        yield
    finally:
        stop.set()
        sender.join()
        encoder.close()
    assert encoder.sent > 5


def assert_resembles(image: NDArray[np.uint8]) -> None:
    assert image.shape == (*SIZE, 3)
    yellow = (image[150:210].astype(int) - (250, 240, 20)).__abs__().max(axis=2) < 60
    columns = np.flatnonzero(yellow.mean(axis=0) > 0.8)
    assert 50 <= len(columns) <= 64  # the whole square
    difference = np.abs(image.astype(int) - picture((columns[0] - 40) // 8))
    assert difference.mean() < 6.0


def free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one:
        one.bind(("127.0.0.1", 0))
        return int(one.getsockname()[1]) & ~1  # RTP's ports are even


def test_a_decoder_of_others_shows_the_pictures(tmp_path: Path) -> None:
    fleet = parse_fleet("typhoon_h480")
    (stream,) = streams_of(fleet, cameras_of(fleet), [], "127.0.0.1", free_port(), 2_000_000)
    write_sdp(str(tmp_path), [stream])
    with sending(stream):
        assert_resembles(decoded(tmp_path / "typhoon_h480_0_cgo3_camera.sdp"))


def test_packets_are_those_of_rfc_6184_and_a_receiver_may_join_at_any_time() -> None:
    fleet = parse_fleet("typhoon_h480")
    port = free_port()
    (stream,) = streams_of(fleet, cameras_of(fleet), [], "127.0.0.1", port, 2_000_000)
    packets = []
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.bind(("127.0.0.1", port))
        receiver.settimeout(20.0)
        with sending(stream):
            while sum(packet[1] >> 7 for packet in packets) < 25:  # the marker ends a picture
                packets.append(receiver.recv(65536))
    assert max(map(len, packets)) <= 1400
    assert {packet[0] for packet in packets} == {0x80}  # version 2 (RFC 3550)
    assert {packet[1] & 0x7F for packet in packets} == {96}
    numbers = [int.from_bytes(packet[2:4], "big") for packet in packets]
    assert {(b - a) % 65536 for a, b in pairwise(numbers)} == {1}
    times = sorted({int.from_bytes(packet[4:8], "big") for packet in packets})
    assert np.diff(times).mean() / 90_000 == pytest.approx(0.05, rel=0.5)  # with the intervals of sending
    units = [unit for packet in packets for unit in units_begun(packet[12:])]
    keys = [k for k, unit in enumerate(units) if unit == 5]
    assert len(keys) >= 2
    assert {7, 8} <= set(units[: keys[0]])
    assert {7, 8} <= set(units[keys[0] : keys[1]])  # the parameters are repeated


def units_begun(payload: bytes) -> list[int]:
    """Return the types of the NAL units that begin in an RTP payload (RFC 6184, 5.2 to 5.8)."""
    kind = payload[0] & 0x1F
    if kind == 28:  # FU-A
        return [payload[1] & 0x1F] if payload[1] & 0x80 else []
    if kind != 24:
        return [kind]
    found, place = [], 1  # STAP-A
    while place < len(payload):
        found.append(payload[place + 2] & 0x1F)
        place += 2 + int.from_bytes(payload[place : place + 2], "big")
    return found


def test_an_encoder_that_ends_is_reported(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    fleet = parse_fleet("typhoon_h480")
    (stream,) = streams_of(fleet, cameras_of(fleet), [], "127.0.0.1", free_port(), 2_000_000)
    (tmp_path / "ffmpeg").write_text("#!/bin/sh\necho no codec >&2\nexit 1\n")
    (tmp_path / "ffmpeg").chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:/bin")
    encoder = Encoder(stream)

    reasons = []

    def ended() -> bool:
        try:
            encoder.put(picture().tobytes())
        except EncoderError as error:
            reasons.append(str(error))
        return bool(reasons)

    wait_until(ended, "the end is noticed")
    assert reasons == [f"video of {CAMERA}: ffmpeg has ended: no codec"]
    encoder.close()
    monkeypatch.setenv("PATH", "")
    with pytest.raises(EncoderError, match="the program ffmpeg is missing"):
        Encoder(stream)


# MAVLink


def asked(component: CameraComponent, command: int, *params: float, target: int = 100) -> list[Any]:
    """Return a component's reply to a ground station."""
    station = mavlink.MAVLink(None, srcSystem=255, srcComponent=190)
    values = [*params, *[0.0] * (7 - len(params))]
    packed = mavlink.MAVLink_command_long_message(1, target, command, 0, *values).pack(station)
    (message,) = mavlink.MAVLink(None).parse_buffer(packed)
    reader = mavlink.MAVLink(None)
    return [answer for frame in component.answers(message, 12.5) for answer in reader.parse_buffer(frame)]


@pytest.fixture
def component() -> CameraComponent:
    fleet = parse_fleet(FLEET)
    return CameraComponent(streams_of(fleet, cameras_of(fleet), [], "127.0.0.1", 5600, 1_500_000)[0])


def test_the_camera_describes_itself_and_its_video(component: CameraComponent) -> None:
    request = mavlink.MAV_CMD_REQUEST_MESSAGE
    acknowledgement, camera = asked(component, request, mavlink.MAVLINK_MSG_ID_CAMERA_INFORMATION)
    assert (acknowledgement.result, acknowledgement.target_system) == (mavlink.MAV_RESULT_ACCEPTED, 255)
    assert camera.flags == mavlink.CAMERA_CAP_FLAGS_HAS_VIDEO_STREAM
    assert (camera.resolution_h, camera.resolution_v, camera.time_boot_ms) == (640, 360, 12_500)
    assert bytes(camera.model_name).rstrip(b"\0") == b"cgo3_camera"
    assert (camera.get_srcSystem(), camera.get_srcComponent()) == (1, 100)
    _, video = asked(component, request, mavlink.MAVLINK_MSG_ID_VIDEO_STREAM_INFORMATION)
    assert (video.uri, video.type, video.encoding) == ("5600", mavlink.VIDEO_STREAM_TYPE_RTPUDP, 1)
    assert (video.stream_id, video.count, video.hfov, video.bitrate) == (1, 1, 115, 1_500_000)
    assert video.flags == mavlink.VIDEO_STREAM_STATUS_FLAGS_RUNNING
    assert video.name == "typhoon_h480_0/cgo3_camera"
    for command in (mavlink.MAV_CMD_REQUEST_CAMERA_INFORMATION, mavlink.MAV_CMD_REQUEST_VIDEO_STREAM_INFORMATION):
        assert len(asked(component, command, 1.0)) == 2
        assert len(asked(component, command, 1.0, target=0)) == 2


def test_the_video_stops_and_starts_on_command(component: CameraComponent) -> None:
    assert asked(component, mavlink.MAV_CMD_VIDEO_STOP_STREAMING, 1.0)[0].result == mavlink.MAV_RESULT_ACCEPTED
    assert not component.running
    _, status = asked(component, mavlink.MAV_CMD_REQUEST_VIDEO_STREAM_STATUS, 1.0)
    assert (status.flags, status.resolution_h) == (0, 640)
    assert asked(component, mavlink.MAV_CMD_VIDEO_START_STREAMING, 0.0)[0].result == mavlink.MAV_RESULT_ACCEPTED
    assert component.running
    assert asked(component, mavlink.MAV_CMD_VIDEO_STOP_STREAMING, 2.0)[0].result == mavlink.MAV_RESULT_DENIED


def test_what_it_cannot_do_is_refused(component: CameraComponent) -> None:
    assert asked(component, mavlink.MAV_CMD_IMAGE_START_CAPTURE)[0].result == mavlink.MAV_RESULT_UNSUPPORTED
    for number in (mavlink.MAVLINK_MSG_ID_STORAGE_INFORMATION, float("nan"), 1e9):
        assert asked(component, mavlink.MAV_CMD_REQUEST_MESSAGE, number)[0].result == mavlink.MAV_RESULT_DENIED
    assert asked(component, mavlink.MAV_CMD_REQUEST_MESSAGE, 259.0, target=1) == []  # the id is the autopilot's
    assert asked(component, mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1.0, target=0) == []


def test_streams_have_ports_and_components_of_their_own() -> None:
    fleet = parse_fleet("iris_realsense_camera:2,typhoon_h480:1,iris:1")
    streams = chosen_streams(VideoSettings(), fleet, 5.0)
    assert [(s.system, s.component, s.port, s.rate) for s in streams] == [
        (1, 100, 5600, 5.0), (2, 100, 5601, 5.0), (3, 100, 5602, 5.0),
    ]  # fmt: skip
    names = "iris_realsense_camera_1/stereo_camera,iris_realsense_camera_1/realsense/depth_camera"
    both = chosen_streams(VideoSettings(cameras=names, port=7000), fleet)
    assert [(s.system, s.component, s.port) for s in both] == [(2, 100, 7000), (2, 101, 7001)]
    assert {s.topic.rsplit("/", 2)[1] for s in both} == {"color", "left"}


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"cameras": "iris_0/nose"}, "cameras: 'iris_0/nose' is not known; with colours there are typhoon_h480_0/cgo3"),
        ({"port": 65535}, "port: 65535 is not allowed with 2 streams, at most 65534"),
    ],
)
def test_what_is_refused(changes: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        chosen_streams(VideoSettings(**changes), parse_fleet(FLEET))


@pytest.mark.parametrize("changes", [{"host": "a b"}, {"port": -1}, {"bitrate": 10}])
def test_invalid_parameters_are_reported(changes: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=f"~{next(iter(changes))}: .* is not allowed"):
        VideoSettings.from_parameters(lambda name, default: changes.get(name[1:], default))


# the node


@pytest.fixture
def graph(tmp_path: Path) -> Iterator[Graph]:
    yield from running_graph(tmp_path)


def test_a_ground_station_finds_the_video_and_sees_the_picture(graph: Graph, tmp_path: Path) -> None:
    graph.set_param("/xtdrone/fleet", FLEET)
    port = free_port()
    graph.set_param("/video", {"port": port, "sdp": str(tmp_path / "sdp"), "cameras": CAMERA[1:]})
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as station:
        station.bind(("127.0.0.1", GCS_PORT))
        station.settimeout(20.0)
        graph.start("video", sys.executable, str(NODE))
        graph.role(__file__, "teller")
        reader, writer = mavlink.MAVLink(None), mavlink.MAVLink(None, srcSystem=255, srcComponent=190)

        def next_of(kind: str) -> tuple[Any, Any]:
            while True:
                datagram, address = station.recvfrom(4096)
                for message in reader.parse_buffer(datagram) or ():
                    if message.get_type() == kind:
                        return message, address

        beat, camera = next_of("HEARTBEAT")
        assert (beat.type, beat.get_srcSystem(), beat.get_srcComponent()) == (mavlink.MAV_TYPE_CAMERA, 1, 100)
        number = mavlink.MAVLINK_MSG_ID_VIDEO_STREAM_INFORMATION
        request = mavlink.MAVLink_command_long_message(1, 100, mavlink.MAV_CMD_REQUEST_MESSAGE, 0, number, *[0.0] * 6)
        station.sendto(b"\xfdnoise", camera)
        station.sendto(request.pack(writer), camera)
        video, _ = next_of("VIDEO_STREAM_INFORMATION")
        assert int(video.uri) == port
    assert_resembles(decoded(tmp_path / "sdp" / "typhoon_h480_0_cgo3_camera.sdp"))


def test_a_wrong_camera_ends_the_node(graph: Graph) -> None:
    graph.set_param("/xtdrone/fleet", "iris:2")
    node = graph.start("video", sys.executable, str(NODE))
    assert node.wait(30.0) == 2
    assert "no vehicle has one with colours" in (graph.folder / "video.out").read_text()


def main() -> None:
    """Run a node."""
    {"teller": teller}[sys.argv[1]](*sys.argv[2:])


if __name__ == "__main__":
    main()
