"""The latest state of a vehicle, from its telemetry."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, field
from typing import Any

from pymavlink.dialects.v20 import common as mavlink

from xtdrone_common import modes

TELEMETRY = (
    "HEARTBEAT",
    "SYS_STATUS",
    "EXTENDED_SYS_STATE",
    "GLOBAL_POSITION_INT",
    "LOCAL_POSITION_NED",
    "GPS_RAW_INT",
    "ESTIMATOR_STATUS",
    "STATUSTEXT",
)
"""Messages that update the state."""

_FIXES = ("no GPS", "no fix", "2D", "3D", "DGPS", "RTK float", "RTK fixed", "static", "PPP")  # by GPS_FIX_TYPE
_LANDED = ("", "landed", "in air", "taking off", "landing")  # by MAV_LANDED_STATE
_AHRS = mavlink.MAV_SYS_STATUS_AHRS
_PREARM = mavlink.MAV_SYS_STATUS_PREARM_CHECK
_UNKNOWN_U8, _UNKNOWN_U16 = 0xFF, 0xFFFF
_REQUIRED = (  # ESTIMATOR_STATUS_FLAGS of which at least one has to be set, and the problem otherwise
    (mavlink.ESTIMATOR_ATTITUDE, "no attitude"),
    (mavlink.ESTIMATOR_POS_HORIZ_ABS | mavlink.ESTIMATOR_POS_HORIZ_REL, "no position"),
    (mavlink.ESTIMATOR_POS_VERT_ABS, "no height"),
)
_FORBIDDEN = ((mavlink.ESTIMATOR_GPS_GLITCH, "GPS glitch"), (mavlink.ESTIMATOR_ACCEL_ERROR, "acceleration error"))
_TEXTS_KEPT = 20


MODES = {mode.custom_mode: mode.name for mode in reversed(modes.SUPPORTED)} | {
    4 << 16 | 8 << 24: "AUTO.FOLLOW_TARGET",
    3 << 16 | 1 << 24: "ORBIT",
}
"""Names of PX4's modes by ``custom_mode``."""


def name_constant(enumeration: str, number: int) -> str:
    """Return the lower-case name of a MAVLink constant, without the prefix of its enumeration."""
    entry = mavlink.enums[enumeration].get(number)
    return str(number) if entry is None else entry.name.removeprefix(f"{enumeration}_").lower()


@dataclass
class VehicleState:
    """State of one vehicle; None for values that have not been received.

    Attributes:
        name: in this ground station.
        system: MAVLink system id; 0 if unknown.
        heard: time of the last message, s of the monotonic clock.
        told: time of the last message other than heartbeats and texts, s of the monotonic clock.
        kind: name of its MAV_TYPE, such as ``quadrotor``.
        autopilot: name of its MAV_AUTOPILOT, such as ``px4``.
        armed: whether the vehicle is armed.
        ready: whether the checks before arming pass.
        mode: Name of PX4's mode; "mode" and its number for another one.
        landed: name of its MAV_LANDED_STATE.
        latitude, longitude: degrees.
        altitude: m AMSL.
        height: m above home.
        local: position in its local frame, m, ENU.
        speed: ground speed, m/s.
        climb: climb rate, m/s.
        heading: degrees clockwise from north.
        battery: per cent.
        voltage: V.
        gps: kind of fix.
        satellites: number of satellites.
        estimator: "ok", or a list of problems.
        texts: latest status texts with their MAV_SEVERITY, newest last.
    """

    name: str
    system: int = 0
    heard: float = -math.inf
    told: float = -math.inf
    kind: str | None = None
    autopilot: str | None = None
    armed: bool | None = None
    ready: bool | None = None
    mode: str | None = None
    landed: str | None = None
    latitude: float | None = None
    longitude: float | None = None
    altitude: float | None = None
    height: float | None = None
    local: tuple[float, float, float] | None = None
    speed: float | None = None
    climb: float | None = None
    heading: float | None = None
    battery: int | None = None
    voltage: float | None = None
    gps: str | None = None
    satellites: int | None = None
    estimator: str | None = None
    texts: list[tuple[int, str]] = field(default_factory=list)
    _parts: tuple[int, int] = (0, 0)  # id of a text in several messages, and number of the next one
    _told_by_estimator: bool = False

    def update(self, name: str, message: Any, now: float) -> None:
        """Update the state by a message out of ``TELEMETRY``; ``now``: s of the monotonic clock."""
        self.heard = now
        if name not in ("HEARTBEAT", "STATUSTEXT"):
            self.told = now
        getattr(self, f"_{name.lower()}")(message)

    def as_json(self, now: float) -> dict[str, Any]:
        """Return the state as JSON data; ``age``: s since the last message, null for none."""
        found = {key: value for key, value in asdict(self).items() if not key.startswith("_")}
        heard = found.pop("heard")
        del found["told"]
        found["age"] = round(max(now - heard, 0.0), 3) if math.isfinite(heard) else None
        found["texts"] = [{"severity": severity, "text": text} for severity, text in self.texts]
        return found

    # one method per message

    def _heartbeat(self, m: Any) -> None:
        self.kind = name_constant("MAV_TYPE", m.type)
        self.autopilot = name_constant("MAV_AUTOPILOT", m.autopilot)
        self.armed = bool(m.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)
        known = MODES if m.autopilot == mavlink.MAV_AUTOPILOT_PX4 else {}
        self.mode = known.get(m.custom_mode, f"mode {m.custom_mode}")

    def _sys_status(self, m: Any) -> None:
        self.battery = m.battery_remaining if 0 <= m.battery_remaining <= 100 else None
        self.voltage = None if m.voltage_battery in (0, _UNKNOWN_U16) else round(m.voltage_battery * 1e-3, 3)
        if m.onboard_control_sensors_enabled & _PREARM or self.autopilot == "px4":  # which does not set the bit
            self.ready = bool(m.onboard_control_sensors_health & _PREARM)
        if not self._told_by_estimator and m.onboard_control_sensors_present & _AHRS:
            self.estimator = "ok" if m.onboard_control_sensors_health & _AHRS else "unhealthy"

    def _extended_sys_state(self, m: Any) -> None:
        self.landed = _LANDED[m.landed_state] if m.landed_state < len(_LANDED) else None

    def _global_position_int(self, m: Any) -> None:
        self.latitude, self.longitude = round(m.lat * 1e-7, 7), round(m.lon * 1e-7, 7)
        self.altitude, self.height = round(m.alt * 1e-3, 3), round(m.relative_alt * 1e-3, 3)
        self.speed, self.climb = math.hypot(m.vx, m.vy) * 1e-2, -m.vz * 1e-2
        self.heading = None if m.hdg == _UNKNOWN_U16 else m.hdg * 1e-2

    def _local_position_ned(self, m: Any) -> None:
        self.local = (round(m.y, 3), round(m.x, 3), round(-m.z, 3))
        if self.latitude is None:  # no global position
            self.speed, self.climb = math.hypot(m.vx, m.vy), -m.vz

    def _gps_raw_int(self, m: Any) -> None:
        self.gps = _FIXES[m.fix_type] if m.fix_type < len(_FIXES) else str(m.fix_type)
        self.satellites = None if m.satellites_visible == _UNKNOWN_U8 else m.satellites_visible

    def _estimator_status(self, m: Any) -> None:
        wrong = [text for bit, text in _REQUIRED if not m.flags & bit] + [
            text for bit, text in _FORBIDDEN if m.flags & bit
        ]
        self.estimator = ", ".join(wrong) or "ok"
        self._told_by_estimator = True

    def _statustext(self, m: Any) -> None:
        text = str(m.text).split("\0", 1)[0].rstrip("\t\r\n ")  # a trailing tab marks texts that are events, too
        text = "".join(letter if letter.isprintable() else "?" for letter in text)
        continued = m.id != 0 and self._parts == (m.id, m.chunk_seq) and self.texts
        if continued:
            self.texts = [*self.texts[:-1], (m.severity, self.texts[-1][1] + text)]
        else:
            self.texts = [*self.texts, (m.severity, text)][-_TEXTS_KEPT:]
        self._parts = (m.id, m.chunk_seq + 1)
