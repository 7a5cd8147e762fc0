"""Frames of MAVLink, modes, settings and stream requests."""

from __future__ import annotations

import contextlib
import random
import threading

import pytest
from mavros_fakes import free_udp_port, udp_socket
from pymavlink.dialects.v20 import common as mavlink

from xtdrone_autopilot.mavlink.wire import codec
from xtdrone_common import modes
from xtdrone_common.fleet.fcu_url import AutopilotLinkError, FcuUrl, parse_fcu_url
from xtdrone_common.modes import PX4_MODES
from xtdrone_mavros.lib.plugin_settings import ParamError, Params
from xtdrone_mavros.link import autopilot_links
from xtdrone_mavros.link.autopilot_links import (
    AutopilotLink,
    AutopilotReceiver,
)
from xtdrone_mavros.link.command_acks import AwaitedCommands
from xtdrone_mavros.link.stream_requests import DEFAULT_RATE_US, OFF_US, StreamRequests

HANDLED = [
    "ALTITUDE",
    "ATTITUDE_QUATERNION",
    "ATTITUDE_TARGET",
    "BATTERY_STATUS",
    "COMMAND_ACK",
    "ESTIMATOR_STATUS",
    "EXTENDED_SYS_STATE",
    "GLOBAL_POSITION_INT",
    "GPS_RAW_INT",
    "HEARTBEAT",
    "HIGHRES_IMU",
    "HOME_POSITION",
    "LOCAL_POSITION_NED",
    "LOCAL_POSITION_NED_COV",
    "POSITION_TARGET_LOCAL_NED",
    "SERVO_OUTPUT_RAW",
    "STATUSTEXT",
    "SYSTEM_TIME",
    "SYS_STATUS",
    "TIMESYNC",
    "VFR_HUD",
]
LOCAL_POSITION = mavlink.MAVLink_local_position_ned_message(1000, 1.0, 2.0, -3.0, 0.5, 0.25, 0.0)


@pytest.fixture
def packer():
    return mavlink.MAVLink(None, srcSystem=7, srcComponent=1)


def _example(cls, source):
    """Return a message of a class with random values in every field, arrays and texts included."""
    values = []
    for name, kind, length in zip(cls.fieldnames, cls.fieldtypes, _array_lengths(cls), strict=True):
        assert name
        if kind == "char":
            values.append(b"text")
        elif length:
            values.append([_number(kind, source) for _ in range(length)])
        else:
            values.append(_number(kind, source))
    return cls(*values)


def _array_lengths(cls):
    return [cls.array_lengths[cls.orders[i]] for i in range(len(cls.fieldnames))]


def _number(kind, source):
    return source.uniform(-10.0, 10.0) if kind in ("float", "double") else source.randrange(0, 100)


@pytest.mark.parametrize(
    "name",
    HANDLED,
)
def test_decoder_agrees_with_pymavlink(name, packer):
    cls = mavlink.mavlink_map[codec.MESSAGE_ID[name]]
    source = random.Random(name)
    decode = codec.decoder(name)
    for _ in range(10):
        frame = bytes(_example(cls, source).pack(packer))
        expected = mavlink.MAVLink(None).decode(bytearray(frame))
        decoded = decode(frame)
        for field in cls.fieldnames:
            value = getattr(decoded, field)
            assert (list(value) if isinstance(value, tuple) else value) == getattr(expected, field)


def test_zeros_truncated_by_mavlink_2_are_restored(packer):
    frame = bytes(mavlink.MAVLink_local_position_ned_message(0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0).pack(packer))
    assert len(frame) < 20
    assert codec.decoder("LOCAL_POSITION_NED")(frame) == (0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


def test_mavlink_1_frames_are_decoded(packer):
    frame = bytes(LOCAL_POSITION.pack(packer, force_mavlink1=True))
    [(number, system, component, cut)] = list(codec.split(frame))
    assert (number, system, component) == (32, 7, 1)
    assert codec.decoder("LOCAL_POSITION_NED")(cut).y == 2.0


def test_split_returns_every_frame_with_its_sender(packer):
    heartbeat = mavlink.MAVLink_heartbeat_message(2, 12, 29, 0, 3, 3)
    datagram = b"".join(bytes(m.pack(packer)) for m in (heartbeat, LOCAL_POSITION, heartbeat))
    parts = list(codec.split(datagram))
    assert [part[:3] for part in parts] == [(0, 7, 1), (32, 7, 1), (0, 7, 1)]
    assert b"".join(part[3] for part in parts) == datagram


def test_signed_frames_are_cut_at_their_signature(packer):
    packer.signing.secret_key = b"k" * 32
    packer.signing.sign_outgoing = True
    frames = [bytes(LOCAL_POSITION.pack(packer)) for _ in range(2)]
    assert [part[3] for part in codec.split(b"".join(frames))] == frames
    assert codec.decoder("LOCAL_POSITION_NED")(frames[1]).z == -3.0


def test_a_flipped_bit_is_found(packer):
    frame = bytearray(LOCAL_POSITION.pack(packer))
    frame[12] ^= 1
    with pytest.raises(codec.FrameError, match="LOCAL_POSITION_NED"):
        codec.decoder("LOCAL_POSITION_NED")(bytes(frame))


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        (lambda f: f[:-1], "is truncated"),
        (lambda f: b"\x00" + f, "does not begin a MAVLink frame"),
        (lambda f: f[:2] + b"\x02" + f[3:], "incompatibility flags 0x02"),
        (lambda f: f[:5], "does not begin a MAVLink frame"),
    ],
)
def test_split_reports_errors(damage, said, packer):
    frame = bytes(LOCAL_POSITION.pack(packer))
    with pytest.raises(codec.FrameError, match=said):
        list(codec.split(damage(frame)))


def test_random_bytes_end_in_a_frame_error_or_in_frames():
    source = random.Random(1)
    for _ in range(2000):
        data = bytes([source.choice((0xFD, 0xFE, source.randrange(256)))]) + source.randbytes(source.randrange(60))
        try:
            for _, _, _, frame in codec.split(data):
                assert frame
        except codec.FrameError:
            pass


@pytest.mark.parametrize(
    ("name", "number"),
    [("MANUAL", 0x00010000), ("OFFBOARD", 0x00060000), ("AUTO.TAKEOFF", 0x02040000), ("AUTO.LAND", 0x06040000)],
)
def test_mode_numbers_are_px4s(name, number):
    assert modes.mode_number(name) == number
    assert modes.mode_name(81, number) == name


def test_every_mode_round_trips_by_name():
    for name in PX4_MODES:
        assert modes.mode_name(1, modes.mode_number(name)) == name


def test_plain_numbers_are_modes():
    assert modes.mode_number("393216") == modes.mode_number("OFFBOARD")


@pytest.mark.parametrize("name", ["", "OFFBORD", "auto.land", "-1", "4294967296"])
def test_unknown_mode_lists_what_is_allowed(name):
    with pytest.raises(modes.ModeError, match=r"AUTO\.LAND.*OFFBOARD"):
        modes.mode_number(name)


def test_modes_without_a_name():
    assert modes.mode_name(0x51, 99 << 16) == f"CMODE({99 << 16})"
    assert modes.mode_name(0xC0, 0) == "MODE(0xC0)"


@pytest.mark.parametrize(
    ("url", "parts"),
    [
        ("udp://:24540@localhost:34580", FcuUrl("0.0.0.0", 24540, "localhost", 34580)),
        ("udp://127.0.0.1:14540@10.0.0.2:14557/?ids=1,240", FcuUrl("127.0.0.1", 14540, "10.0.0.2", 14557)),
        ("udp://@", FcuUrl("0.0.0.0", 14555, "127.0.0.1", 14550)),
    ],
)
def test_fcu_url(url, parts):
    assert parse_fcu_url(url) == parts


@pytest.mark.parametrize("url", ["", "serial:///dev/ttyACM0:57600", "udp://:70000@localhost:1", "udp://:0@h:1"])
def test_invalid_fcu_url_is_reported(url):
    with pytest.raises(AutopilotLinkError, match="fcu_url"):
        parse_fcu_url(url)


def test_settings_of_the_vehicle_go_before_those_of_the_node():
    params = Params({"imu": {"frame_id": "iris_0/base_link"}}, {"imu": {"frame_id": "base_link", "x": 2}})
    assert params.get("imu/frame_id", "") == "iris_0/base_link"
    assert params.get("imu/x", 1.0) == 2.0
    assert params.get("imu/none", "default") == "default"


@pytest.mark.parametrize(("value", "default"), [("yes", True), (1, True), ("2", 1.0), (True, 1.0), (3, "text")])
def test_setting_of_the_wrong_type_is_reported(value, default):
    with pytest.raises(ParamError, match=r"imu/frame_id.*" + type(default).__name__):
        Params({"imu": {"frame_id": value}}).get("imu/frame_id", default)


class TestStreams:
    """Requests for message intervals."""

    def setup_method(self):
        self.asked = []
        self.streams = StreamRequests(lambda number, interval: self.asked.append((number, interval)), {"VFR_HUD": 4.0})

    def test_requests_each_wanted_stream_once(self):
        self.streams.update({32, 74}, set())
        self.streams.update({32, 74}, set())
        assert self.asked == [(32, DEFAULT_RATE_US), (74, 250000)]

    def test_disables_unwanted_streams_but_no_events(self):
        self.streams.update(set(), {30, 0, 253, 77})
        assert self.asked == [(30, OFF_US)]

    def test_gives_up_on_an_autopilot_that_keeps_sending(self):
        for _ in range(10):
            self.streams.update(set(), {30})
        assert self.asked == [(30, OFF_US)] * 3

    def test_repeats_the_request_for_a_returning_subscriber(self):
        self.streams.update({32}, set())
        self.streams.update(set(), {32})
        self.streams.update({32}, set())
        assert self.asked == [(32, DEFAULT_RATE_US), (32, OFF_US), (32, DEFAULT_RATE_US)]

    def test_keeps_the_users_settings(self):
        self.streams.leave(30)
        self.streams.update({30}, set())
        self.streams.update(set(), {30})
        assert self.asked == []

    @pytest.mark.parametrize("rates", [{"NO_SUCH": 1.0}, {"VFR_HUD": 0.0}, {"VFR_HUD": float("nan")}])
    def test_invalid_rates_are_reported(self, rates):
        with pytest.raises(ValueError, match="stream_rates"):
            StreamRequests(lambda *_: None, rates)


class TestCommands:
    """Commands and their acks; the acks arrive inside the send call, so no test waits."""

    def setup_method(self):
        self.sent = []
        self.commands = AwaitedCommands(self._send)
        self.results = []
        self._packer = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)

    def _send(self, message):
        self.sent.append(message)
        if self.results:
            for result in self.results.pop(0):
                self.ack(400, result)

    def ack(self, command, result):
        ack = mavlink.MAVLink_command_ack_message(command, result)
        self.commands.on_ack(bytes(ack.pack(self._packer)))

    def test_result_is_the_acks(self):
        self.results = [[2]]
        assert self.commands.call(400, lambda attempt: attempt) == 2
        assert self.sent == [0]

    def test_resends_with_the_attempts_number_then_gives_up(self):
        assert self.commands.call(400, lambda attempt: attempt, limit=0.04, resends=3) is None
        assert self.sent == [0, 1, 2, 3]

    def test_an_answer_to_a_resend_counts(self):
        self.results = [[], [0]]
        assert self.commands.call(400, lambda attempt: attempt, limit=1.0, resends=3) == 0

    def test_in_progress_stops_the_resending(self):
        self.results = [[5]]
        assert self.commands.call(400, lambda attempt: attempt, limit=0.04, resends=3) is None
        assert self.sent == [0]

    def test_the_meanwhile_context_ends_with_the_acknowledgement(self):
        course = []

        @contextlib.contextmanager
        def meanwhile():
            course.append("waits")
            yield
            course.append("waits no more")

        commands = AwaitedCommands(lambda message: course.append("sends"), meanwhile)
        assert commands.call(400, lambda attempt: attempt, limit=0.02, resends=1) is None
        assert course == ["sends", "waits", "waits no more"] * 2

    def test_ack_of_another_command_does_not_count(self):
        self.ack(21, 0)
        self.results = [[]]
        assert self.commands.call(21, lambda attempt: attempt, limit=0.01, resends=0) is None

    def test_ack_goes_to_the_oldest_of_its_kind(self):
        self.commands.send(400, "unawaited")
        self.results = [[3, 0]]
        assert self.commands.call(400, lambda attempt: attempt) == 0


class TestLink:
    """UDP ends and the receiver thread."""

    def test_occupied_port_is_reported_with_its_vehicle(self):
        taken = udp_socket()
        port = taken.getsockname()[1]
        with pytest.raises(AutopilotLinkError, match=f"iris_3: UDP port {port} "):
            AutopilotLink("iris_3", FcuUrl("127.0.0.1", port, "127.0.0.1", 9))
        taken.close()

    def test_receiver_waits_for_counted_datagrams_and_reports_the_lost(self):
        link = AutopilotLink("iris_0", FcuUrl("127.0.0.1", free_udp_port(), "127.0.0.1", 9))
        link.wanted = frozenset({32})
        receiver = AutopilotReceiver([link])
        receiver.start()
        fcu = udp_socket()
        packer = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
        try:
            for _ in range(3):
                fcu.sendto(bytes(LOCAL_POSITION.pack(packer)), ("127.0.0.1", link.port))
            assert receiver.wait({link.port: 3, 1: 99}, limit=5.0) == {}
            assert receiver.wait({link.port: 5}, limit=0.01) == {link.port: 2}
            assert [number for number, _ in link.drain(2)] == [32, 32]
            assert [number for number, _ in link.drain()] == [32]
        finally:
            receiver.stop()
            fcu.close()

    def test_receiver_thread_reads_at_once_while_an_answer_is_awaited(self, monkeypatch):
        monkeypatch.setattr(autopilot_links, "_GLANCE_PERIOD", 1000.0)
        link = AutopilotLink("iris_0", FcuUrl("127.0.0.1", free_udp_port(), "127.0.0.1", 9))
        receiver = AutopilotReceiver([link])
        receiver.start()
        fcu = udp_socket()
        packet = bytes(LOCAL_POSITION.pack(mavlink.MAVLink(None, srcSystem=1, srcComponent=1)))
        answered = threading.Event()
        link.replies = {32: lambda _: answered.set()}
        try:
            fcu.sendto(packet, ("127.0.0.1", link.port))
            assert answered.wait(5.0)  # no link is counted yet
            receiver.wait_counted({link.port: 1}, limit=5.0)
            for _ in range(2):
                answered.clear()
                with receiver.attention():
                    fcu.sendto(packet, ("127.0.0.1", link.port))
                    assert answered.wait(5.0)
        finally:
            receiver.stop()
            fcu.close()

    def test_messages_before_the_first_count_belong_to_the_first_turn(self):
        link = AutopilotLink("iris_0", FcuUrl("127.0.0.1", free_udp_port(), "127.0.0.1", 9))
        link.wanted = frozenset({32})
        receiver = AutopilotReceiver([link])  # its thread is not started, as if it were late
        fcu = udp_socket()
        packer = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)

        def send() -> None:
            fcu.sendto(bytes(LOCAL_POSITION.pack(packer)), ("127.0.0.1", link.port))

        try:
            for _ in range(3):
                send()
            handled = []
            for count in range(1, 5):
                send()
                targets = receiver.wait_counted({link.port: count, 1: 99}, limit=0.01)
                handled.append(len(link.drain(targets[link.port])))
                assert receiver.counted() == {link.port: count}
        finally:
            link.close()
            fcu.close()
        assert handled == [4, 1, 1, 1]
