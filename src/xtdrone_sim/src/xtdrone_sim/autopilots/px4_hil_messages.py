"""MAVLink 2 messages of PX4's simulator link, encoded by kernels for all vehicles together.

Fields as PX4 v1.14's simulator_mavlink reads them, see https://mavlink.io/en/messages/common.html for HIL_SENSOR,
HIL_GPS, HIL_STATE_QUATERNION and HIL_ACTUATOR_CONTROLS. Body frame FRD, local frame NED.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pymavlink.dialects.v20 import common as mavlink

from xtdrone_autopilot.mavlink.streams.vehicle_state import EPOCH_US
from xtdrone_autopilot.mavlink.wire.codec import MESSAGE_ID, Decoder, FrameError, decoder, message_name
from xtdrone_autopilot.mavlink.wire.frame_packing import Format
from xtdrone_common.fleet import Vehicle
from xtdrone_common.geodesy import projection
from xtdrone_sim.kernel import kernel
from xtdrone_sim.physics.world import World

COMPONENT = 200  # component id of Gazebo's plugin

# HIL_SENSOR.fields_updated, as PX4 groups the bits (simulator_mavlink's SensorSource)
ACCEL = 0b111
GYRO = 0b111000
MAG = 0b111000000
BARO = 0b1101000000000  # absolute pressure, pressure altitude, temperature

_MAGIC = 0xFD
_MAGIC_V1 = 0xFE
_HEADER = 10
_ROOM = 512  # bytes per vehicle and step; the three messages need at most 315
_UINT16 = 65535
_INT16 = 32767

# Payloads in wire order, extensions at the end.
_HIL_SENSOR = np.dtype(
    [
        ("time_usec", "<u8"),
        ("accel", "<f4", 3),  # m/s^2
        ("gyro", "<f4", 3),  # rad/s
        ("mag", "<f4", 3),  # gauss
        ("abs_pressure", "<f4"),  # hPa
        ("diff_pressure", "<f4"),  # hPa
        ("pressure_alt", "<f4"),  # m
        ("temperature", "<f4"),  # deg C
        ("fields_updated", "<u4"),
        ("id", "u1"),
    ]
)
_HIL_GPS = np.dtype(
    [
        ("time_usec", "<u8"),
        ("lat", "<i4"),  # deg 1e7
        ("lon", "<i4"),
        ("alt", "<i4"),  # mm AMSL
        ("eph", "<u2"),  # cm
        ("epv", "<u2"),
        ("vel", "<u2"),  # cm/s
        ("velocity", "<i2", 3),  # cm/s NED
        ("cog", "<u2"),  # deg 1e2
        ("fix_type", "u1"),
        ("satellites_visible", "u1"),
        ("id", "u1"),
        ("yaw", "<u2"),
    ]
)
_HIL_STATE_QUATERNION = np.dtype(
    [
        ("time_usec", "<u8"),
        ("q", "<f4", 4),  # (w, x, y, z), body to local
        ("rates", "<f4", 3),  # rad/s
        ("lat", "<i4"),
        ("lon", "<i4"),
        ("alt", "<i4"),
        ("velocity", "<i2", 3),  # cm/s NED
        ("ind_airspeed", "<u2"),  # cm/s
        ("true_airspeed", "<u2"),
        ("acceleration", "<i2", 3),  # mm/s^2 NED: PX4 divides by 1000 and logs it as m/s^2
    ]
)
_KINDS = ((_HIL_SENSOR, "HIL_SENSOR"), (_HIL_GPS, "HIL_GPS"), (_HIL_STATE_QUATERNION, "HIL_STATE_QUATERNION"))

_reproject = kernel(projection.reproject)


@kernel
def _limit(value, low, high):
    """Return ``value`` clamped to ``low``..``high`` and rounded to an integer; 0 for NaN."""
    if math.isnan(value):
        return 0
    return round(min(max(value, low), high))


@kernel
def _crc(frame, start, end, extra):
    """Return CRC-16/MCRF4XX of ``frame[start:end]`` and the message's extra byte (MAVLink, "Checksum")."""
    crc = 0xFFFF
    for i in range(start, end + 1):
        byte = int(frame[i]) if i < end else extra
        mixed = (byte ^ (crc & 0xFF)) & 0xFF
        mixed = (mixed ^ (mixed << 4)) & 0xFF
        crc = ((crc >> 8) ^ (mixed << 8) ^ (mixed << 3) ^ (mixed >> 4)) & 0xFFFF
    return crc


@kernel
def _put(out, start, payload, kind, sequence, system):
    """Write the frame of ``payload`` at ``out[start]`` with trailing zeros truncated; return its end."""
    number, extra = kind[0], kind[1]
    length = payload.shape[0]
    while length > 1 and payload[length - 1] == 0:
        length -= 1
    out[start] = _MAGIC
    out[start + 1] = length
    out[start + 2] = 0
    out[start + 3] = 0
    out[start + 4] = sequence & 0xFF
    out[start + 5] = system
    out[start + 6] = COMPONENT
    out[start + 7] = number & 0xFF
    out[start + 8] = (number >> 8) & 0xFF
    out[start + 9] = (number >> 16) & 0xFF
    for i in range(length):
        out[start + _HEADER + i] = payload[i]
    end = start + _HEADER + length
    crc = _crc(out, start + 1, end, extra)
    out[end] = crc & 0xFF
    out[end + 1] = crc >> 8
    return end + 2


@kernel
def _fill_sensor(m, s, time_us):
    m.time_usec = time_us
    fields = ACCEL | GYRO
    for i in range(3):
        m.accel[i] = s.accel[i]
        m.gyro[i] = s.gyro[i]
        m.mag[i] = s.mag[i]
    if s.mag_fresh:
        fields |= MAG
    if s.baro_fresh:
        fields |= BARO
    m.abs_pressure = s.baro_pressure * 0.01
    m.pressure_alt = s.baro_alt
    m.temperature = s.baro_temperature
    m.fields_updated = fields


@kernel
def _fill_gps(m, s, time_us):
    m.time_usec = EPOCH_US + time_us
    m.lat = _limit(s.gps_lat * 1e7, -900000000.0, 900000000.0)
    m.lon = _limit(s.gps_lon * 1e7, -1800000000.0, 1800000000.0)
    m.alt = _limit(s.gps_alt * 1e3, -2147483648.0, 2147483647.0)
    m.eph = _limit(s.gps_eph * 1e2, 1.0, _UINT16)
    m.epv = _limit(s.gps_epv * 1e2, 1.0, _UINT16)
    speed = math.hypot(s.gps_vel[0], s.gps_vel[1])
    m.vel = _limit(speed * 1e2, 0.0, _UINT16 - 1)
    for i in range(3):
        m.velocity[i] = _limit(s.gps_vel[i] * 1e2, -_INT16, _INT16)
    m.cog = _limit(math.degrees(math.atan2(s.gps_vel[1], s.gps_vel[0])) % 360.0 * 1e2, 0.0, 36000.0) % 36000
    m.fix_type = s.gps_fix
    m.satellites_visible = s.gps_satellites


@kernel
def _fill_truth(m, v, time_us, place):
    """Convert the plant state from ENU/FLU: q' = q_ned_enu q q_flu_frd, half turns about (1, 1, 0) and x."""
    m.time_usec = time_us
    w, x, y, z = v.q[0], v.q[1], v.q[2], v.q[3]
    root = math.sqrt(0.5)
    m.q[0] = root * (w + z)
    m.q[1] = root * (x + y)
    m.q[2] = root * (x - y)
    m.q[3] = root * (w - z)
    m.rates[0], m.rates[1], m.rates[2] = v.rates[0], -v.rates[1], -v.rates[2]
    latitude, longitude = _reproject(v.position[1], v.position[0], place[0], place[1])
    m.lat = _limit(latitude * 1e7, -900000000.0, 900000000.0)
    m.lon = _limit(longitude * 1e7, -1800000000.0, 1800000000.0)
    m.alt = _limit((place[2] + v.position[2]) * 1e3, -2147483648.0, 2147483647.0)
    airspeed = 0.0
    for i in range(3):
        airspeed += (v.velocity[i] - v.wind[i]) ** 2
    m.ind_airspeed = m.true_airspeed = _limit(math.sqrt(airspeed) * 1e2, 0.0, _UINT16)
    for i in range(3):
        enu = 1 - i if i < 2 else 2
        sign = 1.0 if i < 2 else -1.0
        m.velocity[i] = _limit(sign * v.velocity[enu] * 1e2, -_INT16, _INT16)
        m.acceleration[i] = _limit(sign * v.acceleration[enu] * 1e3, -_INT16, _INT16)


@kernel
def fill_all(out, ends, sequences, systems, truth_due, sensors, plant, place, time_us, records, payloads, kinds):
    """Write the frames of one step of each vehicle consecutively into its row of ``out``.

    HIL_SENSOR comes last: PX4's time stands still until it arrives, so PX4 has received the other messages when it
    starts to compute.

    Args:
        out: (n, room) bytes; filled.
        ends: (n, 2) start and end of HIL_SENSOR; filled.
        sequences: (n,) MAVLink sequence numbers; advanced.
        systems: (n,) MAVLink system ids.
        truth_due: (n,) whether HIL_STATE_QUATERNION is due.
        sensors, plant: (n,) records.
        place: latitude, longitude (deg) and altitude (m AMSL) of the world's origin.
        time_us: time of the links, microseconds.
        records, payloads: one record per message, and the same memory as bytes.
        kinds: (3, 2) id and CRC extra byte of each message.
    """
    sensor, gps, truth = records
    for i in range(sensors.shape[0]):
        s, end = sensors[i], 0
        if s.gps_fresh:
            _fill_gps(gps[0], s, time_us)
            end = _put(out[i], end, payloads[1], kinds[1], sequences[i], systems[i])
            sequences[i] += 1
        if truth_due[i]:
            _fill_truth(truth[0], plant[i], time_us, place)
            end = _put(out[i], end, payloads[2], kinds[2], sequences[i], systems[i])
            sequences[i] += 1
        _fill_sensor(sensor[0], s, time_us)
        ends[i, 0] = end
        ends[i, 1] = _put(out[i], end, payloads[0], kinds[0], sequences[i], systems[i])
        sequences[i] += 1


class Frames:
    """Encodes the frames of one step for all vehicles.

    Attributes:
        truth_due: (n,) True where the next ``fill`` includes HIL_STATE_QUATERNION; set by the caller.
    """

    def __init__(self, fleet: tuple[Vehicle, ...], place: tuple[float, float, float]) -> None:
        """Allocate the buffers.

        Args:
            fleet: the vehicles.
            place: latitude, longitude (deg) and altitude (m AMSL) of the world's origin.
        """
        count = len(fleet)
        self.truth_due = np.zeros(count, np.bool_)
        self._place = np.array(place)
        self._out = np.zeros((count, _ROOM), np.uint8)
        self._ends = np.zeros((count, 2), np.int64)
        self._rows = [memoryview(row) for row in self._out]
        self._sequences = np.zeros(count, np.int64)
        self._systems = np.array([vehicle.system_id for vehicle in fleet], np.int64)
        self._records = tuple(np.zeros(1, kind) for kind, _ in _KINDS)
        self._payloads = tuple(record.view(np.uint8) for record in self._records)
        messages: list[Any] = [mavlink.mavlink_map[MESSAGE_ID[name]] for _, name in _KINDS]
        self._kinds = np.array([(message.id, message.crc_extra) for message in messages], np.int64)
        self._heartbeat = Format("HEARTBEAT")

    def fill(self, sensors: NDArray[Any], world: World, time_us: int) -> None:
        """Encode the samples in ``sensors`` and the truth in ``world`` at link time ``time_us``, microseconds."""
        fill_all(
            self._out,
            self._ends,
            self._sequences,
            self._systems,
            self.truth_due,
            sensors,
            world.plant,
            self._place,
            time_us,
            self._records,
            self._payloads,
            self._kinds,
        )

    def of(self, index: int, *, samples_only: bool = False) -> memoryview:
        """Return the frames of vehicle ``index``, or HIL_SENSOR alone; valid until the next ``fill``."""
        start, end = self._ends[index]
        return self._rows[index][start if samples_only else 0 : end]

    def heartbeat(self, index: int) -> bytes:
        """Return a HEARTBEAT of the simulator; PX4 ignores it, tools expect it."""
        values = (0, mavlink.MAV_TYPE_GENERIC, mavlink.MAV_AUTOPILOT_INVALID, 0, mavlink.MAV_STATE_ACTIVE, 3)
        sequence = int(self._sequences[index]) & 0xFF
        self._sequences[index] += 1
        return self._heartbeat.frame(self._heartbeat.payload(values), sequence, int(self._systems[index]), COMPONENT)


class Controls(NamedTuple):
    """The content of a HIL_ACTUATOR_CONTROLS.

    Attributes:
        time_us: PX4's time, microseconds since its first HIL_SENSOR.
        outputs: 16 values, motors 0..1.
        armed: motors may turn.
        lockstep: PX4 responds to every HIL_SENSOR, and its time stands still until the next one.
    """

    time_us: int
    outputs: tuple[float, ...]
    armed: bool
    lockstep: bool


class TruthInterval(NamedTuple):
    """Interval of HIL_STATE_QUATERNION that PX4 requests, microseconds; 0 or less for none."""

    interval_us: float


def _controls(message: Any) -> Controls:
    armed = bool(message.mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)
    lockstep = bool(message.flags & mavlink.HIL_ACTUATOR_CONTROLS_FLAGS_LOCKSTEP)
    return Controls(message.time_usec, tuple(message.controls), armed, lockstep)


def _command(message: Any) -> TruthInterval | None:
    wanted = message.command == mavlink.MAV_CMD_SET_MESSAGE_INTERVAL and message.param1 == MESSAGE_ID[_KINDS[2][1]]
    return TruthInterval(message.param2) if wanted else None


_READERS: dict[int, tuple[Decoder, Callable[[Any], Controls | TruthInterval | None]]] = {
    MESSAGE_ID["HIL_ACTUATOR_CONTROLS"]: (decoder("HIL_ACTUATOR_CONTROLS"), _controls),
    MESSAGE_ID["COMMAND_LONG"]: (decoder("COMMAND_LONG"), _command),
    MESSAGE_ID["HEARTBEAT"]: (decoder("HEARTBEAT"), lambda _: None),
}


class Stream:
    """Splits the byte stream of a connection into messages and skips all other bytes.

    Attributes:
        messages: number of MAVLink frames so far.
        garbage: number of bytes outside frames so far.
    """

    def __init__(self) -> None:
        """Start with an empty buffer."""
        self.messages = 0
        self.garbage = 0
        self._buffer = b""

    def take(self, data: bytes) -> Iterator[Controls | TruthInterval]:
        """Append ``data`` to the buffer and yield the relevant messages in it."""
        buffer, start = self._buffer + data, 0
        while start < len(buffer):
            length = _frame_length(buffer, start)
            if length is None or start + length > len(buffer):
                break
            said, good = _read(buffer[start : start + length]) if length else (None, False)
            if good:
                self.messages += 1
                start += length
            else:
                self.garbage += 1
                start += 1
            if said is not None:
                yield said
        self._buffer = buffer[start:]


def _frame_length(buffer: bytes, start: int) -> int | None:
    """Return the length of the frame at ``start``; 0 if no frame starts there, None if more bytes are needed."""
    magic, left = buffer[start], len(buffer) - start
    if magic == _MAGIC:
        if left < 3:
            return None
        flags = buffer[start + 2]
        return buffer[start + 1] + 12 + (13 if flags else 0) if flags <= 1 else 0
    if magic == _MAGIC_V1:
        return buffer[start + 1] + 8 if left > 1 else None
    return 0


def _read(frame: bytes) -> tuple[Controls | TruthInterval | None, bool]:
    """Return the decoded message if it is relevant, and whether the frame is valid."""
    number = frame[7] | frame[8] << 8 | frame[9] << 16 if frame[0] == _MAGIC else frame[5]
    if number not in _READERS:
        return None, message_name(number)[0] != "#"
    decode, read = _READERS[number]
    try:
        return read(decode(frame)), True
    except FrameError:
        return None, False
