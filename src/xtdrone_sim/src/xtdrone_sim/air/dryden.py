"""Turbulence by the Dryden model of MIL-F-8785C for low altitudes (section 3.7.2, figures 10 and 11).

With the height h in feet, 10 to 1000, and the wind W20 at 20 feet::

    sigma_w = 0.1 W20                sigma_u = sigma_v = sigma_w / (0.177 + 0.000823 h)^0.4
    L_w = h                          L_u = L_v = h / (0.177 + 0.000823 h)^1.2

    H_u(s) = sigma_u sqrt(2 L_u / (pi V)) / (1 + L_u/V s)
    H_v(s) = sigma_v sqrt(L_v / (pi V)) (1 + sqrt(3) L_v/V s) / (1 + L_v/V s)^2, and H_w alike

u points along the mean wind, v to its left, w up. V is the vehicle's airspeed: the mean wind carries the turbulence
past a hovering vehicle. The filters are discretised exactly, for any step.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from xtdrone_common.settings import Settings, setting
from xtdrone_sim.kernel import kernel
from xtdrone_sim.physics.vehicle_dynamics import ABSENT

from .wind import add_wind

_FOOT = 0.3048  # m
_LEAST_HEIGHT, _LARGEST_HEIGHT = 10.0, 1000.0  # ft
_LEAST_SPEED = 0.5  # m/s, minimum airspeed of the vehicle; without airspeed the turbulence would be frozen


@dataclass(frozen=True)
class DrydenSettings(Settings):
    """Settings of the turbulence."""

    speed: float = setting(
        7.7, low=0.0, high=60.0, unit="m/s", text="mean wind 6 m above ground: 7.7 light, 15.4 moderate, 23.1 severe"
    )
    direction: float = setting(
        0.0,
        low=-math.pi,
        high=math.pi,
        unit="rad",
        text="direction towards which the mean wind blows, from east towards north",
    )
    mean: bool = setting(False, text="include the mean wind; otherwise only turbulence is added to the world's wind")
    shared: bool = setting(False, text="the same turbulence for all vehicles; otherwise an independent one for each")


@kernel
def intensities(height, speed):
    """Return (sigma_u, sigma_w) m/s and (L_u, L_w) m at a height (m) for the mean wind ``speed`` (m/s) at 6 m."""
    feet = min(max(height / _FOOT, _LEAST_HEIGHT), _LARGEST_HEIGHT)
    base = 0.177 + 0.000823 * feet
    sigma = 0.1 * speed
    return sigma / base**0.4, sigma, feet * _FOOT / base**1.2, feet * _FOOT


@kernel
def _advance_first(state, tau, dt, noise):
    """Return the next value of 1 / (1 + tau s), driven by white noise to a variance of 1."""
    keep = math.exp(-dt / tau)
    return keep * state + math.sqrt(1.0 - keep * keep) * noise


@kernel
def _advance_second(first, second, tau, dt, noise_1, noise_2):
    """Return the next values of 1 / (1 + tau s) and 1 / (1 + tau s)^2, whose covariance is (1, 1/2; 1/2, 1/2)."""
    d = dt / tau
    keep = math.exp(-d)
    square = keep * keep
    q11, q12, q22 = 1.0 - square, 0.5 - square * (0.5 + d), 0.5 - square * (0.5 + d + d * d)
    root = math.sqrt(q11)
    cross = q12 / root
    rest = math.sqrt(max(q22 - cross * cross, 0.0))
    return keep * first + root * noise_1, keep * (second + d * first) + cross * noise_1 + rest * noise_2


@kernel
def _transverse(first, second):
    """Return (1 + sqrt(3) tau s) / (1 + tau s)^2 of a variance of 1."""
    root = math.sqrt(3.0)
    return (root * first + (1.0 - root) * second) * math.sqrt(0.5)


@kernel
def advance(states, noise, vehicles, speed, cos, sin, mean, dt, gusts):
    """Advance the filters and write each vehicle's additional wind.

    Args:
        states: (k, 5) filter states, one row for each vehicle or one for all.
        noise: (k, 5) standard normal.
        vehicles: (n,) ``PLANT``.
        speed: mean wind at 6 m, m/s.
        cos, sin: of its direction.
        mean: 1.0 to add the mean wind, 0.0 for the turbulence alone.
        dt: step, s.
        gusts: (n, 3) m/s ENU, written.
    """
    rows, count = len(states), len(vehicles)
    for row in range(rows):
        height, pace = 0.0, 0.0
        first, last = (row, row + 1) if rows == count else (0, count)
        present = 0
        for i in range(first, last):
            present += vehicles[i].contact != ABSENT
        for i in range(first, last):
            v = vehicles[i]
            if v.contact == ABSENT:
                continue
            x, y, z = v.velocity[0] - speed * cos, v.velocity[1] - speed * sin, v.velocity[2]
            height += v.position[2] / present
            pace += math.sqrt(x * x + y * y + z * z) / present
        pace = max(pace, _LEAST_SPEED)
        sigma_u, sigma_w, length_u, length_w = intensities(height, speed)
        s, n = states[row], noise[row]
        s[0] = _advance_first(s[0], length_u / pace, dt, n[0])
        s[1], s[2] = _advance_second(s[1], s[2], length_u / pace, dt, n[1], n[2])
        s[3], s[4] = _advance_second(s[3], s[4], length_w / pace, dt, n[3], n[4])
        u = sigma_u * s[0] + mean * speed
        across = sigma_u * _transverse(s[1], s[2])
        up = sigma_w * _transverse(s[3], s[4])
        for i in range(first, last):
            gusts[i, 0] = cos * u - sin * across
            gusts[i, 1] = sin * u + cos * across
            gusts[i, 2] = up


@kernel
def _apply(vehicles, models, gusts, force, torque):
    for i in range(len(vehicles)):
        add_wind(vehicles[i], models[i], gusts[i, 0], gusts[i, 1], gusts[i, 2], force[i], torque[i])


class Dryden:
    """Turbulent wind.

    Attributes:
        gusts: (N, 3) m/s ENU, of the latest step.
    """

    name = "dryden"

    def __init__(self, **values: Any) -> None:
        """Create it with settings of ``DrydenSettings``.

        Raises:
            SettingError: a value is not allowed.
        """
        self.settings = DrydenSettings(**values)

    @property
    def winds(self) -> NDArray[Any]:
        """The same, for later effects; see ``wind``."""
        return self.gusts

    def reset(self, models: NDArray[Any], time_step: float, random: np.random.Generator) -> None:
        """Start with turbulence in its stationary state."""
        rows = 1 if self.settings.shared else len(models)
        noise = random.standard_normal((rows, 5))
        self._states = noise.copy()
        for k in (2, 4):  # of covariance (1, 1/2; 1/2, 1/2) with the state before
            self._states[:, k] = 0.5 * (noise[:, k - 1] + noise[:, k])
        self._random, self._step = random, time_step
        self.gusts = np.zeros((len(models), 3))

    def __call__(
        self, time: float, vehicles: NDArray[Any], models: NDArray[Any], force: NDArray[Any], torque: NDArray[Any]
    ) -> None:
        """Add the wrench of this step's turbulence."""
        s = self.settings
        noise = self._random.standard_normal(self._states.shape)
        cos, sin = math.cos(s.direction), math.sin(s.direction)
        advance(self._states, noise, vehicles, s.speed, cos, sin, float(s.mean), self._step, self.gusts)
        _apply(vehicles, models, self.gusts, force, torque)
