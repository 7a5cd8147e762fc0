"""Speed of one core of this machine by a fixed computation, so that figures of two machines can be compared.

Three loops of a fixed amount of work, none of which touches the packages that are measured or any memory beyond the
first-level cache:

- ``integer``: 30 million steps of Marsaglia's xorshift64 (Journal of Statistical Software 8(14), 2003), compiled;
- ``floating``: 4 million steps of the logistic map and a square root and a division, each needing the last, compiled;
- ``python``: 650 000 steps of a linear congruential generator in plain Python.

The figure is :data:`REFERENCE` by what was measured, the geometric mean of the three: 1 on the reference machine, 2 on
one that is twice as fast. The work must not be changed, or older results lose their meaning.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Any

import numba

from benchmarks.measurement_runner import Row

REFERENCE = {"integer_ms": 50.0, "floating_ms": 47.7, "python_ms": 49.6}
"""CPU ms of the three loops on the reference machine, a virtual core of an AMD EPYC server with AVX-512."""
_INTEGER_STEPS = 30_000_000
_FLOATING_STEPS = 4_000_000
_PYTHON_STEPS = 650_000
_REPEATS = 7


@numba.njit  # type: ignore[untyped-decorator]
def _integer(steps: int) -> Any:
    value = numba.uint64(88172645463325252)  # Marsaglia's seed
    for _ in range(steps):
        value ^= value << numba.uint64(13)
        value ^= value >> numba.uint64(7)
        value ^= value << numba.uint64(17)
    return value


@numba.njit  # type: ignore[untyped-decorator]
def _floating(steps: int) -> float:
    value, total = 0.4, 0.0
    for _ in range(steps):
        value = 3.9 * value * (1.0 - value)
        total += math.sqrt(value + 1.0 / (1.0 + total))
    return total


def _python(steps: int) -> int:
    value = 1
    for _ in range(steps):
        value = (1_103_515_245 * value + 12_345) & 0x7FFF_FFFF
    return value


def calibrate() -> Row:
    """Measure the three loops.

    Returns:
        integer_ms, floating_ms, python_ms: CPU ms, the shortest of several runs: other programs only add to it;
        speed: of one core, 1 on the reference machine.
    """
    row = {
        "integer_ms": _shortest(_integer, _INTEGER_STEPS),
        "floating_ms": _shortest(_floating, _FLOATING_STEPS),
        "python_ms": _shortest(_python, _PYTHON_STEPS),
    }
    return row | {"speed": math.prod(REFERENCE[name] / row[name] for name in REFERENCE) ** (1 / len(REFERENCE))}


def _shortest(work: Callable[[int], Any], steps: int) -> float:
    work(1)  # compiles it
    times = []
    for _ in range(_REPEATS):
        began = time.process_time_ns()
        work(steps)
        times.append(time.process_time_ns() - began)
    return min(times) * 1e-6


def describe(row: Row) -> str:
    """Return the figures as text."""
    parts = ", ".join(f"{name} {row[f'{name}_ms']:.0f} ms" for name in ("integer", "floating", "python"))
    return f"calibration: {row['speed']:.2f} ({parts})"
