"""Measurements of a UWB sensor: ranges and bearings of its neighbours, true and with errors.

A measured range is::

    r = d + bias + noise N(0, 1) + [blocked] (blocked_bias + blocked_noise N(0, 1)) + [outlier] E(outlier_excess)

An outlier is a signal whose first path has been missed, so that the next one is measured: since paths arrive at random
times with a constant rate, its excess has an exponential distribution (A. A. M. Saleh and R. A. Valenzuela, A
statistical model for indoor multipath propagation, IEEE J. Sel. Areas Commun. 5(2), 1987).
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from xtdrone_common.poses import Pose
from xtdrone_common.rotation import rotate_all_inverse
from xtdrone_sim.vehicles.mounts.body_sensors import SIGHT_BIASED, SIGHT_NEEDED, UwbMount
from xtdrone_sim.vehicles.mounts.fleet_sensor import Antenna

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Neighbours:
    """Ranges and bearings of n neighbours, true or measured.

    Attributes:
        ranges: (n,) m.
        azimuths: (n,) rad, from x to y of the sensor's frame, -pi to pi.
        elevations: (n,) rad, from its plane x, y to z.
        blocked: (n,) whether there is no line of sight.
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


def neighbours_of(own: int, antennas: Sequence[Antenna]) -> tuple[int, ...]:
    """Return the antennas that an antenna measures: for each other vehicle, the one of the same name, else its first.

    Args:
        own: index of the measuring antenna.
        antennas: antennas of a fleet, vehicle by vehicle.

    Returns:
        Indices, in the fleet's order.
    """
    chosen: dict[str, int] = {}
    for k, antenna in enumerate(antennas):
        if antenna.vehicle == antennas[own].vehicle:
            continue
        if antenna.vehicle not in chosen or antenna.mount.name == antennas[own].mount.name:
            chosen[antenna.vehicle] = k
    return tuple(chosen.values())


def find_neighbours(sensor: Pose, positions: Array, range_max: float) -> Neighbours:
    """Return the true ranges and bearings of neighbours, all with line of sight.

    Args:
        sensor: pose of the sensor in the map.
        positions: (n, 3) m, map; NaN: absent.
        range_max: m, range beyond which they are not received.
    """
    offsets = positions - np.array(sensor.position)
    ranges = np.sqrt(np.sum(offsets * offsets, axis=1))
    x, y, z = rotate_all_inverse(np.array(sensor.orientation), offsets).T
    azimuths, elevations = np.arctan2(y, x), np.arctan2(z, np.hypot(x, y))
    return Neighbours(ranges, azimuths, elevations, np.zeros(len(ranges), bool), ranges <= range_max)


def measure_ranges(
    mount: UwbMount,
    vehicle: str,
    number: int,
    true: Neighbours,
    bias: float = 0.0,
    lost: float = 0.0,
    joined: Sequence[str] = (),
) -> Neighbours:
    """Return the measurement of neighbours: with bias, noise, outliers and dropouts.

    The random numbers depend only on seed, vehicle, name, number of the measurement and index of the neighbour in the
    fleet. For a neighbour that has joined in flight, its name replaces the index, so that the numbers of the others do
    not change.

    Args:
        mount: the sensor.
        vehicle: name.
        number: number of the measurement since the start.
        true: all neighbours, in the fleet's order.
        bias: m, added to every range.
        lost: further share of the ranges that are lost, 0..1.
        joined: names of the last neighbours, which have joined in flight.
    """
    key = zlib.crc32(f"{vehicle}/{mount.name}".encode()), number
    draws = _draws(mount.seed, key, len(true.ranges) - len(joined))
    for name in joined:
        draws = np.hstack((draws, _draws(mount.seed, (*key, zlib.crc32(name.encode())), 1)))
    white, chance, excess = draws[:4], draws[4:6], mount.outlier_excess * draws[6]
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


def _draws(seed: int, key: tuple[int, ...], n: int) -> Array:
    """Return random numbers (7, n) for n neighbours.

    The first four are normal: of range, blocked range, azimuth, elevation; two uniform: of dropouts, outliers; one
    exponential: of the outlier's excess.
    """
    generator = np.random.Generator(np.random.PCG64(np.random.SeedSequence(seed, spawn_key=key)))
    white, chance = generator.standard_normal((4, n)), generator.random((2, n))
    return np.vstack((white, chance, generator.standard_exponential(n)))
