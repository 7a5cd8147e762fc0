"""Directions and times of a lidar's rays, scan by scan."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from xtdrone_common.files import read_text
from xtdrone_sim.vehicles.mounts.lidar_mounts import MOST_RAYS, ROSETTE, LidarMount

Array = NDArray[np.float64]

_LARGEST_FILE = 64_000_000  # bytes
_COLUMNS = 3
# Turns per second of the two prisms of a rosette: G. F. Marshall, Risley prism scan patterns, Proc. SPIE 3787 (1999).
# Their ratio is not a fraction of small numbers, so that the pattern fills the field of view more and more over time.
_FIRST_PRISM, _SECOND_PRISM = 121.567, -77.772


class PatternError(ValueError):
    """A pattern file that cannot be used; the message names file, line, value and what is allowed."""


@dataclass(frozen=True)
class Rays:
    """The rays of one scan, in the order in which they are cast.

    Attributes:
        directions: (n, 3) unit vectors, in the lidar's frame (x ahead, y left, z up).
        times: (n,) s after the scan's beginning.
        rings: (n,) plane of each ray, 0 the lowest.
    """

    directions: Array
    times: Array
    rings: NDArray[np.uint16]


def directions_of(azimuth: Array, elevation: Array) -> Array:
    """Return unit vectors (n, 3) of angles (n,), rad: azimuth from x to y, elevation from the plane to z."""
    level = np.cos(elevation)
    return np.stack([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)], axis=-1)


def rays_of(mount: LidarMount, number: int) -> Rays:
    """Return the rays of a scan.

    Args:
        mount: the lidar.
        number: number of the scan since the start of simulated time; used only for patterns.

    Raises:
        PatternError: the pattern file cannot be used.
    """
    if mount.kind == "pattern":
        return _rosette(mount, number) if mount.pattern == ROSETTE else _from_file(mount, number)
    return _planes(mount)


@lru_cache(maxsize=64)
def _planes(mount: LidarMount) -> Rays:
    """Return the rays of a scan in one or several planes, column by column.

    The columns of a scan include both of its ends, as those of a LaserScan; a spinning lidar's turn ends where the next
    begins.
    """
    n, spinning = mount.samples, mount.kind == "spinning"
    planes = mount.channels if spinning else 1
    azimuth = np.linspace(mount.angle_min, mount.angle_max, n, endpoint=not spinning)
    elevation = np.linspace(mount.vertical_min, mount.vertical_max, planes) if spinning else np.zeros(1)
    times = np.arange(n) / n * mount.duration
    return Rays(
        directions_of(np.repeat(azimuth, planes), np.tile(elevation, n)),
        np.repeat(times, planes),
        np.tile(np.arange(planes, dtype=np.uint16), n),
    )


def _rosette(mount: LidarMount, number: int) -> Rays:
    """Return the rays behind two thin prisms that turn against each other.

    Each prism deviates the ray by half of ``half_angle`` towards its thick side; the deviations add up, as they do for
    small angles.
    """
    n = mount.samples
    since = np.arange(n) / n / mount.rate
    begin = number / mount.rate
    half = 0.5 * mount.half_angle
    angle = [2.0 * math.pi * (rate * begin % 1.0 + rate * since) for rate in (_FIRST_PRISM, _SECOND_PRISM)]
    left = half * (np.cos(angle[0]) + np.cos(angle[1]))
    up = half * (np.sin(angle[0]) + np.sin(angle[1]))
    off = np.hypot(left, up)
    across = np.sinc(off / math.pi)  # sin(off) / off
    directions = np.stack([np.cos(off), across * left, across * up], axis=-1)
    return Rays(directions, since if mount.skew else np.zeros(n), np.zeros(n, np.uint16))


def _from_file(mount: LidarMount, number: int) -> Rays:
    """Return the next rays of a file, which restarts after its last ray."""
    directions = read_pattern(mount.pattern_file)
    n = mount.samples
    rows = (number * n + np.arange(n)) % len(directions)
    times = np.arange(n) / n * mount.duration
    return Rays(directions[rows], times, np.zeros(n, np.uint16))


@lru_cache(maxsize=8)
def read_pattern(path: Path) -> Array:
    """Return the directions (n, 3) of a pattern file.

    The file is that of livox_laser_simulation: comma-separated values with a line of headings, and in each line time
    (s), azimuth (deg, from x to y) and zenith angle (deg, from z down) of a ray. The times only order the rays.

    Raises:
        PatternError: missing file, or a line that is not allowed.
    """
    try:
        lines = read_text(path, _LARGEST_FILE).splitlines()
    except (OSError, ValueError) as error:
        raise PatternError(f"pattern: {path}: {error}") from error
    rows = []
    for number, line in enumerate(lines[1:], start=2):
        if line.strip():
            rows.append(_row(path, number, line))
    if not 1 <= len(rows) <= MOST_RAYS:
        raise PatternError(f"pattern: {path}: {len(rows)} rays are not allowed, 1 to {MOST_RAYS}")
    _, azimuth, zenith = np.array(rows).T
    return directions_of(np.radians(azimuth), np.radians(90.0 - zenith))


def _row(path: Path, number: int, line: str) -> tuple[float, ...]:
    parts = line.split(",")
    try:
        values = tuple(float(part) for part in parts)
    except ValueError:
        values = ()
    if len(values) != _COLUMNS or not all(map(math.isfinite, values)) or not 0.0 <= values[2] <= 180.0:
        raise PatternError(
            f"pattern: {path}: line {number}: {line.strip()[:80]!r} is not allowed, three numbers: time (s), azimuth "
            "(deg), zenith angle (0 to 180 deg)"
        )
    return values
