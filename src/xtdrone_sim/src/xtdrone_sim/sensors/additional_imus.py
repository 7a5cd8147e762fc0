"""Additional IMUs: measurements at any position on a moving body, with the noise of a data sheet.

At the position r, with the angular rate w and the specific force f of the centre, in the body's frame::

    f(r) = f + dw/dt x r + w x (w x r)

White noise of density d has the standard deviation d sqrt(rate) in a sample. The bias is a random walk: it changes by
N(0, walk sqrt(1 s)) in each second, linearly within it. Both depend only on seed, name and time: a sample is the same
whether or not earlier ones had subscribers.
"""

from __future__ import annotations

import math
import zlib

import numpy as np
from numpy.typing import NDArray

from xtdrone_control.rotation_kernels import rotate_inverse
from xtdrone_sim.vehicles.mounts.imu_mounts import ImuMount

_WHITE, _WALK = 0, 1  # streams of random numbers


class Imu:
    """One IMU of one vehicle."""

    def __init__(self, vehicle: str, mount: ImuMount) -> None:
        """Draw the first bias.

        Args:
            vehicle: name of the vehicle.
            mount: the IMU.
        """
        self.mount = mount
        self._key = (mount.seed, zlib.crc32(f"{vehicle}/{mount.name}".encode()))
        self._scale = np.repeat([mount.gyro_noise, mount.accel_noise], 3) * math.sqrt(mount.rate)
        self._walk = np.repeat([mount.gyro_walk, mount.accel_walk], 3)
        first = self._normal(_WALK, 0) * np.repeat([mount.gyro_bias, mount.accel_bias], 3)
        self._biases = [first]  # at whole seconds
        self._position = np.array(mount.position)
        self._turn = np.array(mount.pose.orientation)

    def _normal(self, purpose: int, number: int) -> NDArray[np.float64]:
        return np.random.default_rng((*self._key, purpose, number)).standard_normal(6)

    def bias(self, time_us: int) -> NDArray[np.float64]:
        """Return the biases (6,) of gyroscope, rad/s, and accelerometer, m/s^2, at a simulated time."""
        second, rest = divmod(time_us, 1_000_000)
        while len(self._biases) < second + 2:
            self._biases.append(self._biases[-1] + self._walk * self._normal(_WALK, len(self._biases)))
        share = rest * 1e-6
        return (1.0 - share) * self._biases[second] + share * self._biases[second + 1]

    def measure(
        self, time_us: int, rates: NDArray[np.float64], change: NDArray[np.float64], force: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return a sample: angular rate, rad/s, and specific force, m/s^2, in the IMU's frame.

        Args:
            time_us: simulated time, microseconds.
            rates: (3,) rad/s, body FLU.
            change: (3,) their rate of change, rad/s^2.
            force: (3,) specific force of the body's centre, m/s^2, FLU.
        """
        arm = self._position
        there = force + np.cross(change, arm) + np.cross(rates, np.cross(rates, arm))
        true = np.concatenate([rotate_inverse(self._turn, *rates), rotate_inverse(self._turn, *there)])
        white = self._scale * self._normal(_WHITE, time_us) if self._scale.any() else 0.0
        sample: NDArray[np.float64] = true + self.bias(time_us) + white
        return sample[:3], sample[3:]
