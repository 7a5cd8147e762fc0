"""Checks of values that users give: the message names the thing, the value and what is allowed."""

from __future__ import annotations

import math


def check_range(name: str, value: float, low: float, high: float = math.inf, unit: str = "") -> float:
    """Return ``value`` as a number within limits.

    Args:
        name: what it is called where the user wrote it.
        value: what the user gave; anything.
        low, high: limits, both allowed.
        unit: for the message, as "m/s".

    Raises:
        ValueError: it is no finite number, or outside.
    """
    number = isinstance(value, (int, float)) and not isinstance(value, bool)
    if number and math.isfinite(value) and low <= value <= high:
        return float(value)
    allowed = f"at least {low:g}" if math.isinf(high) else f"{low:g} to {high:g}"
    raise ValueError(f"{name}: {value!r} is not allowed, {allowed}{' ' if unit else ''}{unit}")


def check_choice(name: str, value: str, allowed: tuple[str, ...]) -> str:
    """Return ``value`` if it is one of ``allowed``.

    Raises:
        ValueError: it is none of them.
    """
    if value in allowed:
        return value
    raise ValueError(f"{name}: {value!r} is not allowed, {' or '.join(allowed)}")
