"""The surface of water: a sum of regular waves, small and on deep water (Airy's linear theory).

A wave of amplitude a, wave vector k and frequency w raises the surface by a cos(k x - w t + p); on deep water
w^2 = g |k|, and a particle at the surface moves on a circle of radius a (J. N. Newman, Marine Hydrodynamics, MIT Press
1977, 6.2-6.3). At the surface the horizontal acceleration of the water is -g times its slope.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from xtdrone_control.settings import SettingError, Settings, setting
from xtdrone_sim.kernel import kernel

GRAVITY = 9.80665  # m/s^2
STEEPEST = 0.25
"""Largest sum of amplitude times wave number: linear theory holds for small slopes, and waves break at 0.44."""

_BAND = 0.3  # periods of several waves are within this share of the period

WAVE = np.dtype([("amplitude", "f8"), ("kx", "f8"), ("ky", "f8"), ("frequency", "f8"), ("phase", "f8")])


@dataclass(frozen=True)
class WaveSettings(Settings):
    """Waves on the water that a boat floats on; boats with equal settings float on the same waves."""

    level: float = setting(0.0, low=-1000.0, high=1000.0, unit="m", text="height of the still water in the map")
    amplitude: float = setting(
        0.0, low=0.0, high=10.0, unit="m", text="of the wave, or of one with the energy of all waves; 0: still water"
    )
    period: float = setting(4.0, low=0.5, high=30.0, unit="s", text="of the wave, or the middle period of several")
    direction: float = setting(
        0.0, low=-2.0 * math.pi, high=2.0 * math.pi, unit="rad", text="direction of travel, from east counter-clockwise"
    )
    spread: float = setting(
        0.3, low=0.0, high=1.5, unit="rad", text="largest deviation of the direction of one of several waves"
    )
    count: int = setting(1, low=1, high=50, text="number of waves: 1 is regular, more are irregular")
    seed: int = setting(0, low=0, high=2**31 - 1, text="of periods, directions and phases of several waves")

    def __post_init__(self) -> None:
        super().__post_init__()
        steep = float(np.sum(self.waves["amplitude"] * np.hypot(self.waves["kx"], self.waves["ky"])))
        if steep > STEEPEST:
            most = self.amplitude * STEEPEST / steep
            raise SettingError(
                "amplitude", self.amplitude, f"at most {most:.3g} m with this period and count: waves are not steep"
            )

    @property
    def waves(self) -> NDArray[np.void]:
        """The waves (count,) ``WAVE``; a single one has its crest at the map's origin at time 0."""
        waves = np.zeros(self.count, WAVE)
        waves["amplitude"] = self.amplitude / math.sqrt(self.count)
        random = np.random.Generator(np.random.PCG64(self.seed)).random((3, self.count))
        several = self.count > 1
        for k in range(self.count):
            period, direction = self.period, self.direction
            if several:
                period *= 1.0 + _BAND * (2.0 * float(random[0, k]) - 1.0)
                direction += self.spread * (2.0 * float(random[1, k]) - 1.0)
                waves["phase"][k] = math.tau * float(random[2, k])
            frequency = math.tau / period
            number = frequency * frequency / GRAVITY
            waves["frequency"][k] = frequency
            waves["kx"][k], waves["ky"][k] = number * math.cos(direction), number * math.sin(direction)
        return waves


@kernel
def water_at(waves, x, y, time):
    """Return the water's surface at a place.

    Args:
        waves: (n,) ``WAVE``.
        x, y: m, map.
        time: s.

    Returns:
        Height above the still water, m; the water's velocity there (3 numbers), m/s; and its acceleration (3), m/s^2.
    """
    height, u, v, w, ax, ay, az = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for k in range(waves.shape[0]):
        one = waves[k]
        angle = one.kx * x + one.ky * y - one.frequency * time + one.phase
        c, s = one.amplitude * math.cos(angle), one.amplitude * math.sin(angle)
        number = math.sqrt(one.kx * one.kx + one.ky * one.ky)
        east, north = one.kx / number, one.ky / number
        speed, push = one.frequency * c, one.frequency * one.frequency * s
        height += c
        u += east * speed
        v += north * speed
        w += one.frequency * s
        ax += east * push
        ay += north * push
        az -= one.frequency * one.frequency * c
    return height, u, v, w, ax, ay, az
