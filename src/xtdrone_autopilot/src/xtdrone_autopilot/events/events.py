"""Events (MAVLink EVENT): numbered messages whose texts are defined in ``event_catalogue``.

An event number consists of the component (1: autopilot) and a hash of the event's name (PX4's events interface,
``events::ID``). The arguments are packed little-endian without padding. Those of an arming check start with the
affected modes (uint32, one bit per navigation state) and the health component (uint8).
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from functools import lru_cache

from xtdrone_autopilot.events.event_catalogue import CATALOGUE

# Log levels (PX4 events::Log). An event has an external and an internal one.
EMERGENCY, ALERT, CRITICAL, ERROR, WARNING, NOTICE, INFO, DEBUG, PROTOCOL = range(9)

_COMPONENT = 1  # MAV_COMP_ID_AUTOPILOT1
_FNV_OFFSET, _FNV_PRIME, _MASK_32 = 0x811C9DC5, 0x01000193, 0xFFFFFFFF
_MASK_24 = 0xFFFFFF
_FLOAT_MAX = 3.4028234e38

# Bit numbers of PX4's health_component_t.
GPS, REMOTE_CONTROL, MOTORS, BATTERY, LINKS = 3, 7, 8, 11, 12
ATTITUDE_ESTIMATE, LOCAL_POSITION, SYSTEM, GLOBAL_POSITION = 16, 17, 20, 24


@lru_cache(maxsize=512)
def event_id(name: str) -> int:
    """Return the number of an event: component in the top byte, FNV-1a of ``name`` in the lower 24 bits."""
    value = _FNV_OFFSET
    for byte in name.encode():
        value = (value ^ byte) * _FNV_PRIME & _MASK_32
    return _COMPONENT << 24 | value & _MASK_24


@dataclass(frozen=True)
class Event:
    """An event with its packed arguments.

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
        """Event number, EVENT.id."""
        return event_id(self.name)

    @property
    def log_levels(self) -> int:
        """EVENT.log_levels: external level in the lower four bits, internal level in the upper four."""
        return self.levels[1] << 4 | self.levels[0]


def _fitting(code: str, value: float) -> float:
    """Return ``value`` limited to the range of the ``struct`` type ``code``."""
    if code == "f":
        return value if abs(value) < _FLOAT_MAX else math.copysign(math.inf, value)
    if math.isnan(value):
        return 0
    bits = 8 * struct.calcsize("<" + code)
    least, most = (-(1 << bits - 1), (1 << bits - 1) - 1) if code.islower() else (0, (1 << bits) - 1)
    return int(min(max(value, least), most))


def event(name: str, level: int, time_us: int, *values: float, internal: int | None = None) -> Event:
    """Return an event with packed arguments.

    Args:
        name: PX4's name.
        level: external log level.
        time_us: simulated time, microseconds.
        values: arguments in the order of the catalogue, clipped to the range of their types.
        internal: internal log level; None for the external one.

    Raises:
        KeyError: the event is not in the catalogue.
        ValueError: the number of arguments differs from the catalogue.
    """
    definition = CATALOGUE[name]
    codes = definition.layout.format[1:]
    arguments = definition.layout.pack(*(_fitting(code, value) for code, value in zip(codes, values, strict=True)))
    return Event(name, (level, level if internal is None else internal), arguments, time_us)
