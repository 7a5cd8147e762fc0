"""Events: what PX4 tells as numbers (MAVLink EVENT), for a ground station that knows their texts.

An event's number is its component (1: autopilot) and a hash of its name (PX4's events interface, ``events::ID``);
its arguments lie packed, little endian, without gaps. A check's event begins with the modes that it concerns (uint32,
one bit a navigation state) and the component that it is about (uint8). ``event_catalogue`` has them all.
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from functools import lru_cache

from xtdrone_control.autopilot.events.event_catalogue import CATALOGUE

# Log levels (PX4 events::Log), the external and the internal one of an event.
EMERGENCY, ALERT, CRITICAL, ERROR, WARNING, NOTICE, INFO, DEBUG, PROTOCOL = range(9)

_COMPONENT = 1  # MAV_COMP_ID_AUTOPILOT1
_FNV_OFFSET, _FNV_PRIME, _MASK_32 = 0x811C9DC5, 0x01000193, 0xFFFFFFFF
_MASK_24 = 0xFFFFFF
_FLOAT_MAX = 3.4028234e38

# Bits of the arguments of checks: PX4's health_component_t.
GPS, REMOTE_CONTROL, MOTORS, BATTERY, LINKS = 3, 7, 8, 11, 12
ATTITUDE_ESTIMATE, LOCAL_POSITION, SYSTEM, GLOBAL_POSITION = 16, 17, 20, 24


@lru_cache(maxsize=512)
def event_id(name: str) -> int:
    """Return the event's number: component in the top byte, FNV-1a of ``name`` in the lower 24 bits."""
    value = _FNV_OFFSET
    for byte in name.encode():
        value = (value ^ byte) * _FNV_PRIME & _MASK_32
    return _COMPONENT << 24 | value & _MASK_24


@dataclass(frozen=True)
class Event:
    """One event.

    Attributes:
        name: PX4's name.
        levels: external and internal log level.
        arguments: packed arguments, at most 25 bytes.
        time_us: simulated time, microseconds.
    """

    name: str
    levels: tuple[int, int]
    arguments: bytes = b""
    time_us: int = 0

    @property
    def number(self) -> int:
        """The event's number, EVENT.id."""
        return event_id(self.name)

    @property
    def log_levels(self) -> int:
        """EVENT.log_levels: external level in the lower four bits, internal one in the upper."""
        return self.levels[1] << 4 | self.levels[0]


def _fitting(code: str, value: float) -> float:
    """Return ``value`` as a ``struct`` type takes it."""
    if code == "f":
        return value if abs(value) < _FLOAT_MAX else math.copysign(math.inf, value)
    if math.isnan(value):
        return 0
    bits = 8 * struct.calcsize("<" + code)
    least, most = (-(1 << bits - 1), (1 << bits - 1) - 1) if code.islower() else (0, (1 << bits) - 1)
    return int(min(max(value, least), most))


def event(name: str, level: int, time_us: int, *values: float, internal: int | None = None) -> Event:
    """Make an event.

    Args:
        name: PX4's name.
        level: external log level.
        time_us: simulated time, microseconds.
        values: the arguments, as the catalogue has them; what is beyond a type's range becomes its limit.
        internal: internal log level; the external one when it is not given.

    Raises:
        KeyError: the catalogue has no such event.
        ValueError: more or less arguments than the catalogue has.
    """
    definition = CATALOGUE[name]
    codes = definition.layout.format[1:]
    arguments = definition.layout.pack(*(_fitting(code, value) for code, value in zip(codes, values, strict=True)))
    return Event(name, (level, level if internal is None else internal), arguments, time_us)
