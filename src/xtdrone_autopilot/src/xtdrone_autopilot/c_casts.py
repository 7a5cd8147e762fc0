"""C's conversions of a command's floats to integers, with the results of PX4's simulator on x86-64.

PX4 casts parameters of MAV_CMDs without a check. For NaN and values out of range C leaves the result open; x86's
conversion (CVTTSS2SI) gives the smallest integer of its width, whose low bits are zero.
"""

from __future__ import annotations

import math


def _cast(value: float, bits: int) -> int:
    least = -(1 << bits - 1)
    # NaN compares false
    return math.trunc(value) if least <= value < -least else least


def to_int(value: float) -> int:
    """Return ``(int)value``: truncated towards zero, -2^31 for NaN and values out of range."""
    return _cast(value, 32)


def to_byte(value: float) -> int:
    """Return ``(uint8_t)value``, 0..255: the low byte of ``(int)value``."""
    return to_int(value) & 0xFF


def to_uint16(value: float) -> int:
    """Return ``(uint16_t)value``, 0..65535: the low half of ``(int)value``."""
    return to_int(value) & 0xFFFF


def to_int16(value: float) -> int:
    """Return ``(int16_t)value``, -32768..32767: the low half of ``(int)value``, with its sign."""
    return (to_uint16(value) ^ 0x8000) - 0x8000


def to_unsigned(value: float) -> int:
    """Return ``(uint32_t)value``, 0..2^32-1: the low half of a conversion to 64 bits."""
    return _cast(value, 64) & 0xFFFFFFFF


def low_32(value: int) -> int:
    """Return the low 32 bits of ``value``, with their sign."""
    return ((value & 0xFFFFFFFF) ^ 0x80000000) - 0x80000000


def nearest(value: float) -> int:
    """Return ``lroundf(value)``: halves away from zero, -2^63 for NaN and values out of range."""
    return _cast(math.copysign(math.floor(abs(value) + 0.5), value) if math.isfinite(value) else value, 64)
