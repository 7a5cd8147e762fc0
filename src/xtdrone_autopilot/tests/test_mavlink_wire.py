"""Compiled MAVLink against pymavlink and Python: frames, decoding, splitting, telemetry payloads, datagrams."""

from __future__ import annotations

import contextlib
import math
import random
import socket
import struct
from types import SimpleNamespace

import numpy as np
import pytest
from autopilot_fakes import FakeAutopilot
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import common as mavlink
from xtdrone_native import mavlink_wire

from xtdrone_autopilot.mavlink.streams.telemetry import Telemetry
from xtdrone_autopilot.mavlink.wire import codec
from xtdrone_autopilot.mavlink.wire.dialect import MESSAGES
from xtdrone_autopilot.mavlink.wire.frame_packing import Format, PackingError
from xtdrone_common import rotation
from xtdrone_common.geodesy import projection

NAMES = sorted(kind.msgname for kind in mavlink.mavlink_map.values() if MESSAGES[kind.id] is kind)
FLOATS = st.one_of(
    st.floats(width=32), st.sampled_from([0.0, -0.0, math.nan, math.inf, -math.inf, 1e-45, -(2.0**-149), 0.1, 1e300])
)


def _number(letter: str) -> st.SearchStrategy:
    if letter in "fd":
        return FLOATS
    bits = 8 * struct.calcsize("<" + letter)
    low, high = (-(1 << bits - 1), (1 << bits - 1) - 1) if letter.islower() else (0, (1 << bits) - 1)
    return st.one_of(st.sampled_from([0, low, high]), st.integers(low, high))


@st.composite
def messages(draw):
    """Draw a message type of pymavlink with values in wire order, arrays flattened; mostly within their ranges."""
    kind = mavlink.mavlink_map[codec.MESSAGE_ID[draw(st.sampled_from(NAMES))]]
    values, count = [], ""
    for letter in kind.unpacker.format[1:]:
        if letter.isdigit():
            count += letter
        elif letter == "s":
            values.append(draw(st.binary(max_size=int(count or 1))))
            count = ""
        else:
            values += [draw(_number(letter)) for _ in range(int(count or 1))]
            count = ""
    return kind, values


@settings(max_examples=150, deadline=None)
@given(messages(), st.integers(0, 255), st.integers(0, 255), st.integers(0, 255))
def test_frames_and_decoded_values_are_pymavlinks(message, sequence, system, component):
    kind, values = message
    form = Format(kind.msgname)
    try:
        payload = kind.unpacker.pack(*values)
    except OverflowError as error:
        with pytest.raises(PackingError, match=f"{kind.msgname}: {error}"):
            form.payload(values)
        return
    base = mavlink.MAVLink_message(kind.id, kind.msgname)
    packer = mavlink.MAVLink(None, srcSystem=system, srcComponent=component)
    packer.seq = sequence
    expected = bytes(base._pack(packer, kind.crc_extra, payload))
    frame = form.frame(form.payload(values), sequence, system, component)
    assert frame == expected
    assert list(codec.split(frame)) == [(kind.id, system, component, frame)]
    if "char" in kind.fieldtypes:
        return
    flat = []
    for value in codec.decoder(kind.msgname)(frame):
        flat += value if isinstance(value, tuple) else [value]
    assert struct.pack(f"<{kind.unpacker.format[1:]}", *flat) == payload


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("SYSTEM_TIME", (-1, 0)),
        ("SYSTEM_TIME", (1 << 64, 0)),
        ("SYSTEM_TIME", (0, 1 << 32)),
        ("SYSTEM_TIME", (0, 1.5)),
        ("SYSTEM_TIME", (0,)),
        ("TIMESYNC", (1 << 63, 0)),
        ("HEARTBEAT", (0, 256, 0, 0, 0, 0)),
        ("VFR_HUD", (0.0, 0.0, 0.0, 0.0, 1 << 15, 0)),
        ("VFR_HUD", (0.0, 0.0, 0.0, 0.0, 0, 1 << 16)),
        ("VFR_HUD", (1e39, 0.0, 0.0, 0.0, 0, 0)),
        ("VFR_HUD", ("1", 0.0, 0.0, 0.0, 0, 0)),
        ("STATUSTEXT", (0, "text", 0, 0)),
    ],
)
def test_values_that_do_not_fit_raise_the_error_of_struct(name, values):
    with pytest.raises((struct.error, OverflowError)) as expected:
        MESSAGES[codec.MESSAGE_ID[name]].unpacker.pack(*values)
    with pytest.raises(PackingError) as raised:
        Format(name).payload(values)
    assert str(raised.value) == f"{name}: {expected.value}"


def test_numbers_of_numpy_are_packed():
    values = (np.float64(1.5), np.float32(0.25), True, 3, np.int16(-4), np.uint16(5))
    expected = mavlink.MAVLink_vfr_hud_message.unpacker.pack(*values)
    assert Format("VFR_HUD").payload(values) == expected.rstrip(b"\0")


def test_only_formats_of_mavlink_are_accepted():
    for fields in ("<x", "<256B", "<99999999999999999999B", "<", "<8Q48Q", "<300s"):
        with pytest.raises(ValueError, match="MAVLink"):
            mavlink_wire.Format(1, 0, fields)
    with pytest.raises(ValueError, match="255 bytes"):
        mavlink_wire.Format(1, 0, "<B").frame(bytes(256), 0, 1, 1)


def _split(datagram):
    """Return the frames of a datagram, and the position after the last one."""
    start, found = 0, []
    while start < len(datagram):
        rest = datagram[start:]
        if rest[0] == 0xFD and len(rest) >= 10 and rest[2] <= 1:
            size = rest[1] + 12 + 13 * rest[2]
            entry = (int.from_bytes(rest[7:10], "little"), rest[5], rest[6], rest[:size])
        elif rest[0] == 0xFE and len(rest) >= 6:
            size = rest[1] + 8
            entry = (rest[5], rest[3], rest[4], rest[:size])
        else:
            break
        if size > len(rest):
            break
        found.append(entry)
        start += size
    return found, start


def test_damaged_datagrams_are_split_up_to_the_damage():
    source, packer = random.Random(2), mavlink.MAVLink(None, 3, 4)
    frames = [
        bytes(mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3).pack(packer, force_mavlink1=old)) for old in (0, 1)
    ]
    for _ in range(5000):
        data = bytearray(
            b"".join(source.choices(frames, k=source.randrange(4))) + source.randbytes(source.randrange(3))
        )
        for _ in range(source.randrange(3)):
            if data:
                data[source.randrange(len(data))] = source.choice((0xFD, 0xFE, 0, 1, 2, source.randrange(256)))
        datagram = bytes(data[: source.randrange(len(data) + 1)])
        assert mavlink_wire.split(datagram) == _split(datagram)
        for _, _, _, frame in mavlink_wire.split(datagram)[0]:
            with contextlib.suppress(codec.FrameError):
                codec.decoder("HEARTBEAT")(frame)


@pytest.mark.parametrize("frame", [b"", b"\xfd", b"\xfe\x09", b"\xfd\xff" + bytes(40), bytes(8)])
def test_incomplete_frames_are_not_decoded(frame):
    with pytest.raises(codec.FrameError, match="HEARTBEAT"):
        codec.decoder("HEARTBEAT")(frame)


# telemetry


def _clamped(value, limit):
    return round(value) if -limit < value < limit else 0 if math.isnan(value) else int(math.copysign(limit, value))


def _diagonal(values):
    matrix = [0.0] * 21
    for i, value in zip((0, 6, 11, 15, 18, 20), values, strict=True):
        matrix[i] = value
    return matrix


def _attitude(e, _s, _c, _t, now):
    return now // 1000, *rotation.to_euler(e["q"].tolist()), *e["rates"]


def _global_position_int(e, _s, _c, t, now):
    position = e["position"].tolist()
    lat, lon = projection.reproject(position[0], position[1], float(e["origin"]["lat"]), float(e["origin"]["lon"]))
    heights = float(e["origin"]["alt"]) - position[2], _over_home(position, t)
    heading = math.degrees(rotation.yaw_of(e["q"].tolist())) % 360.0
    return (
        now // 1000,
        round(lat * 1e7),
        round(lon * 1e7),
        *[_clamped(height * 1e3, 1 << 30) for height in heights],
        *[_clamped(speed * 100.0, 32767) for speed in e["velocity"].tolist()],
        int(heading * 100.0),
    )


def _over_home(position, t):
    return -position[2] if t.home is None else t.home.position[2] - position[2]


def _altitude(e, _s, _c, t, now):
    position = e["position"].tolist()
    sea = float(e["origin"]["alt"]) - position[2] if e["origin"]["set"] else math.nan
    clearance = float(e["terrain"]) - position[2] if e["terrain_valid"] else math.nan
    ground = sea - clearance if e["terrain_valid"] else math.nan
    return now, sea, sea, -position[2], _over_home(position, t), ground, clearance


def _vfr_hud(e, _s, c, t, _now):
    vx, vy, vz = e["velocity"].tolist()
    throttle = max(_clamped(100.0 * float(c["sp_thrust"]), 100), 0) if t.armed else 0
    heading = math.degrees(rotation.yaw_of(e["q"].tolist())) % 360.0
    return 0.0, math.hypot(vx, vy), float(e["origin"]["alt"]) - e["position"][2], -vz, int(heading), throttle


def _odometry(e, _s, _c, _t, now):
    p = np.diagonal(e["P"]).tolist()
    vectors = [*e["position"], *e["q"], *e["velocity"], *e["rates"]]
    diagonals = [*_diagonal(p[6:9] + p[0:3]), *_diagonal(p[3:6] + p[9:12])]
    return now, *vectors, *diagonals, 1, 1, int(e["resets"]["any"]) & 0xFF, 8, 0


def _highres_imu(_e, s, _c, _t, now):
    baro = float(s["baro_pressure"]) * 0.01, 0.0, float(s["baro_alt"]), float(s["baro_temperature"])
    return now, *s["accel"], *s["gyro"], *s["mag"], *baro, 0x1FFF, 0


def _position_target(_e, _s, c, _t, now):
    values = [*c["sp_position"], *c["sp_velocity"], *c["sp_acceleration"]]
    turn = [float(c["sp_yaw"]), float(c["sp_yaw_rate"])]
    mask = sum(1 << bit for bit, value in enumerate(values) if math.isnan(value))
    return now // 1000, *values, *turn, mask | sum(1 << 10 + i for i in (0, 1) if math.isnan(turn[i])), 1


def _servo_output_raw(_e, _s, c, t, now):
    pulses = [
        1000 + max(_clamped(1000.0 * value, 1000), 0) if t.armed or value > 0.0 else 900
        for value in c["actuators"].tolist()
    ]
    return now & 0xFFFFFFFF, *pulses, *[0] * 9


REFERENCES = {
    "ATTITUDE": _attitude,
    "ATTITUDE_QUATERNION": lambda e, s, c, t, now: (now // 1000, *e["q"], *e["rates"], 0.0, 0.0, 0.0, 0.0),
    "LOCAL_POSITION_NED": lambda e, s, c, t, now: (now // 1000, *e["position"], *e["velocity"]),
    "GLOBAL_POSITION_INT": _global_position_int,
    "ALTITUDE": _altitude,
    "VFR_HUD": _vfr_hud,
    "ODOMETRY": _odometry,
    "HIGHRES_IMU": _highres_imu,
    "ATTITUDE_TARGET": lambda e, s, c, t, now: (now // 1000, *c["sp_q"], *c["sp_rates"], float(c["sp_thrust"]), 0),
    "POSITION_TARGET_LOCAL_NED": _position_target,
    "SERVO_OUTPUT_RAW": _servo_output_raw,
}


class _Vehicle:
    """The telemetry of the second of three vehicles."""

    def __init__(self) -> None:
        self.autopilot = FakeAutopilot(3)
        self.commander = SimpleNamespace(home=None, armed=False, view=SimpleNamespace(global_valid=True))
        self.telemetry = Telemetry(self.commander, self.autopilot, 1)
        self.records = [
            table[1] for table in (self.autopilot.estimator, self.autopilot.sensors, self.autopilot.control)
        ]

    def fill(self, generator: np.random.Generator, senseless: float) -> None:
        """Draw every field of the records; each is non-finite or huge with probability ``senseless``."""
        scale = 10.0 ** generator.uniform(-3.0, 4.0)
        for record in self.records:
            for name in record.dtype.names:
                shape, kind = record[name].shape, record[name].dtype.kind
                record[name] = generator.normal(0.0, scale, shape) if kind == "f" else generator.integers(0, 2, shape)
                if kind == "f" and generator.random() < senseless:
                    record[name] = generator.choice([math.nan, math.inf, -math.inf, 1e39, -1e300, 0.0, -0.0])
        estimator = self.records[0]
        estimator["origin"]["lat"], estimator["origin"]["lon"] = (
            generator.uniform(-90.0, 90.0),
            generator.uniform(-180.0, 180.0),
        )
        if generator.random() > senseless:
            q = generator.normal(size=4)
            estimator["q"] = q / np.linalg.norm(q)
        self.commander.armed = bool(generator.integers(2))
        home = SimpleNamespace(position=(0.0, 0.0, generator.normal(0.0, scale)))
        self.commander.home = home if generator.integers(2) else None


def _outcome(call):
    try:
        return call()
    except (ValueError, ArithmeticError) as error:
        return type(error).__name__ if isinstance(error, PackingError) else str(error)


@pytest.mark.parametrize("senseless", [0.0, 0.1])
def test_payloads_are_those_of_pythons_arithmetic(senseless):
    generator, vehicle = np.random.default_rng(7), _Vehicle()
    vehicle.records[0]["initialised"] = vehicle.records[0]["altitude_valid"] = 1
    vehicle.telemetry.refresh(1)
    formats = {name: Format(name) for name in REFERENCES}
    for _ in range(150):
        vehicle.fill(generator, senseless)
        now = int(generator.integers(1 << 41))
        vehicle.telemetry.refresh(now)
        for name, reference in REFERENCES.items():
            expected = _outcome(lambda: formats[name].payload(reference(*vehicle.records, vehicle.commander, now)))  # noqa: B023
            found = _outcome(vehicle.telemetry.source(name))
            if expected == "PackingError":
                assert isinstance(found, str), name
            else:
                assert found == expected, name


def test_records_of_another_type_are_rejected():
    with pytest.raises(KeyError):
        mavlink_wire.Telemetry({}, 24, 1.0)
    for wrong in (np.zeros(4, np.float32), np.zeros(3), np.zeros(8)[::2]):
        with pytest.raises((ValueError, BufferError)):
            mavlink_wire.Telemetry({"q": wrong}, 24, 1.0)


def test_a_message_waits_for_the_estimator():
    vehicle = _Vehicle()
    vehicle.records[0]["initialised"] = vehicle.records[0]["altitude_valid"] = 0
    vehicle.telemetry.refresh(4000)
    for name in ("attitude", "attitude_quaternion", "local_position_ned", "odometry"):
        assert vehicle.telemetry.source(name)() is None
    vehicle.records[0]["initialised"] = 1
    vehicle.telemetry.refresh(8000)
    assert vehicle.telemetry.flight.attitude() is not None
    assert vehicle.telemetry.flight.odometry() is None


def test_a_schedule_in_use_is_not_changed():
    schedule = mavlink_wire.Schedule()
    beat = Format("HEARTBEAT")
    stream = mavlink_wire.Stream("HEARTBEAT", beat.wire, schedule.clear, beat.payload, 0)
    schedule.add(4000, 4000, [stream])
    outbox = mavlink_wire.Outbox("127.0.0.1", 9, 1, 1)
    with pytest.raises(RuntimeError, match="in use"):
        schedule.send_due(4000, {}, outbox, None, print)
    assert (len(outbox), schedule.next_due_us) == (0, 8000)
    schedule.clear()


# datagrams


@pytest.fixture
def pair():
    with socket.socket(type=socket.SOCK_DGRAM) as one, socket.socket(type=socket.SOCK_DGRAM) as other:
        for end in (one, other):
            end.bind(("127.0.0.1", 0))
        yield one, other


def test_each_frame_has_its_datagram_and_sequence_number(pair):
    sender, receiver = pair
    host, port = receiver.getsockname()
    outbox, beat = mavlink_wire.Outbox(host, port, 7, 1), Format("HEARTBEAT")
    expected = [beat.frame(bytes([i + 1]), i & 0xFF, 7, 1) for i in range(150)]
    for i in range(150):
        outbox.put(beat.wire, bytes([i + 1]))
    assert outbox.send(sender.fileno()) == (150, 0)
    assert (len(outbox), outbox.queued, outbox.queued_bytes) == (0, 150, sum(map(len, expected)))
    found, more = [], True
    while more:
        datagrams, more = mavlink_wire.receive(receiver.fileno(), 8192)
        found += datagrams
    assert found == [(frame, sender.getsockname()) for frame in expected]
    assert mavlink_wire.receive(receiver.fileno(), 8192) == ([], False)


def test_long_datagrams_are_truncated(pair):
    sender, receiver = pair
    sender.sendto(bytes(range(100)), receiver.getsockname())
    assert mavlink_wire.receive(receiver.fileno(), 10)[0][0][0] == bytes(range(10))


def test_errors_of_sockets_are_returned(pair):
    outbox = mavlink_wire.Outbox("no address", 1, 1, 1)
    outbox.put_frame(b"x")
    assert outbox.send(pair[0].fileno())[0] == 0
    assert outbox.send(pair[0].fileno())[1] != 0
    assert len(outbox) == 1
    outbox.drop()
    outbox.drop()
    assert outbox.send(pair[0].fileno()) == (0, 0)
    with pytest.raises(ValueError, match="280 bytes"):
        outbox.put_frame(bytes(281))
    with pytest.raises(OSError, match="Bad file descriptor"):
        mavlink_wire.receive(-1, 10)
