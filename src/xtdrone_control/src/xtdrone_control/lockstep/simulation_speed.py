"""The simulation's target speed: its range, and its declaration as a setting."""

from __future__ import annotations

import math
from typing import Any

from xtdrone_control.settings import setting

LEAST_SPEED = 0.01
"""Minimum target real-time factor; below it a 20 ms tick would take more than two seconds."""


def speed_setting(
    text: str = "target speed (default: unlimited)", *, default: Any = 0.0, positional: bool = False
) -> Any:
    """Declare a target real-time factor; 0 for ``unlimited``."""
    return setting(
        default,
        parse=_parse_speed,
        allowed=f"a real-time factor of at least {LEAST_SPEED}, or 'unlimited'",
        metavar="FACTOR",
        text=text,
        positional=positional,
    )


def _parse_speed(text: object) -> float:
    if text == "unlimited":
        return 0.0
    value = float(text) if isinstance(text, (str, int, float)) else math.nan
    if not (math.isfinite(value) and value >= LEAST_SPEED):
        raise ValueError
    return value
