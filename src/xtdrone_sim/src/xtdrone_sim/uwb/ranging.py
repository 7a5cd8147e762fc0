"""What a UWB sensor measures: ranges and bearings of its neighbours, true and with errors.

A measured range is::

    r = d + bias + noise N(0, 1) + [blocked] (blocked_bias + blocked_noise N(0, 1)) + [outlier] E(outlier_excess)

An outlier is a signal whose first path has been missed, so that the next one counts: as paths arrive at random times
with a constant rate, its excess has an exponential distribution (A. A. M. Saleh and R. A. Valenzuela, A statistical
model for indoor multipath propagation, IEEE J. Sel. Areas Commun. 5(2), 1987).
"""

from __future__ import annotations

import math
import zlib
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from xtdrone_control.rotation_arrays import rotate_inverse
from xtdrone_sim.shapes.visual import Pose
from xtdrone_sim.vehicles.mounts.uwb_mounts import SIGHT_BIASED, SIGHT_NEEDED, UwbMount

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Neighbours:
    """Ranges and bearings of n neighbours, true or measured.

    Attributes:
        ranges: (n,) m.
        azimuths: (n,) rad, from x to y of the sensor's frame, -pi to pi.
        elevations: (n,) rad, from its plane x, y to z.
        blocked: (n,) whether something stands between.
        heard: (n,) whether there is a measurement.
    """

    ranges: Array
    azimuths: Array
    elevations: Array
    blocked: NDArray[np.bool_]
    heard: NDArray[np.bool_]

    def deviations(self, mount: UwbMount) -> Array:
        """Return the declared standard deviation (n,) of each range, m."""
        return np.where(self.blocked, math.hypot(mount.noise, mount.blocked_noise), mount.noise)


def seen_from(sensor: Pose, positions: Array, range_max: float) -> Neighbours:
    """Return where neighbours truly are, with nothing between.

    Args:
        sensor: pose of the sensor in the map.
        positions: (n, 3) m, map; NaN: not there.
        range_max: m, beyond which they are not heard.
    """
    offsets = positions - np.array(sensor.position)
    ranges = np.sqrt(np.sum(offsets * offsets, axis=1))
    x, y, z = rotate_inverse(np.array(sensor.orientation), offsets).T
    azimuths, elevations = np.arctan2(y, x), np.arctan2(z, np.hypot(x, y))
    return Neighbours(ranges, azimuths, elevations, np.zeros(len(ranges), bool), ranges <= range_max)


def measured(
    mount: UwbMount, vehicle: str, number: int, true: Neighbours, bias: float = 0.0, lost: float = 0.0
) -> Neighbours:
    """Return the measurement of neighbours: with bias, noise, outliers and dropouts.

    The random numbers depend on seed, vehicle, name, number of the measurement and place of the neighbour in the fleet
    only.

    Args:
        mount: the sensor.
        vehicle: name.
        number: of the measurement since the start.
        true: all neighbours, in the fleet's order.
        bias: m, added to every range.
        lost: further share of the ranges that are lost, 0..1.
    """
    n = len(true.ranges)
    key = zlib.crc32(f"{vehicle}/{mount.name}".encode()), number
    generator = np.random.Generator(np.random.PCG64(np.random.SeedSequence(mount.seed, spawn_key=key)))
    white = generator.standard_normal((4, n))  # of range, blocked range, azimuth, elevation
    chance = generator.random((2, n))  # of dropouts, outliers
    excess = mount.outlier_excess * generator.standard_exponential(n)
    ranges = true.ranges + mount.bias + bias + mount.noise * white[0]
    if mount.line_of_sight == SIGHT_BIASED:
        ranges += np.where(true.blocked, mount.blocked_bias + mount.blocked_noise * white[1], 0.0)
    ranges += np.where(chance[1] < mount.outliers, excess, 0.0)
    heard = true.heard & (chance[0] >= 1.0 - (1.0 - mount.dropouts) * (1.0 - lost))
    if mount.line_of_sight == SIGHT_NEEDED:
        heard &= ~true.blocked
    turn = true.azimuths + mount.bearing_noise * white[2]
    azimuths = turn - 2.0 * math.pi * np.floor((turn + math.pi) / (2.0 * math.pi))
    elevations = np.clip(true.elevations + mount.bearing_noise * white[3], -0.5 * math.pi, 0.5 * math.pi)
    return Neighbours(np.maximum(ranges, 0.0), azimuths, elevations, true.blocked, heard)
