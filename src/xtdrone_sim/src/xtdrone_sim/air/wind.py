"""Winds in addition to the world's: their wrench on a vehicle, their use by other effects, and the density of air.

An effect with an attribute ``winds``, (N, 3) m/s ENU of its latest step, is a wind that later effects can use: an
effect with a method ``feel`` gets the earlier winds when a world begins.
"""

from __future__ import annotations

from typing import Any, Protocol

from numpy.typing import NDArray

from xtdrone_control.rotation_kernels import rotate, rotate_inverse
from xtdrone_sim.kernel import kernel

DENSITY = 1.225  # kg/m^3, standard atmosphere at sea level


class FurtherWind(Protocol):
    """An effect that is a wind."""

    @property
    def winds(self) -> NDArray[Any]:
        """Wind at each vehicle in the latest step, (N, 3) m/s ENU."""


@kernel
def add_wind(v, m, x, y, z, force, torque):
    """Add the wrench that an additional wind exerts on one vehicle.

    The drag of rotors and body is linear in the air speed (``plant.rotor_wrench``), so the result is that of a plant
    whose wind contains it.

    Args:
        v, m: the vehicle's ``PLANT`` and ``MODEL``.
        x, y, z: additional wind, m/s ENU.
        force: (3,) N, ENU; added to.
        torque: (3,) N m, body FLU; added to.
    """
    gx, gy, _ = rotate_inverse(v.q, x, y, z)
    fx = fy = 0.0
    for i in range(m.rotor_count):
        drag = m.drag_coefficient * v.rotor_speed[i]
        rolling = m.rolling_moment_coefficient * v.rotor_speed[i]
        px, py, pz = m.rotor_position[i, 0], m.rotor_position[i, 1], m.rotor_position[i, 2]
        fx += drag * gx
        fy += drag * gy
        torque[0] += rolling * gx - pz * drag * gy
        torque[1] += rolling * gy + pz * drag * gx
        torque[2] += px * drag * gy - py * drag * gx
    wx, wy, wz = rotate(v.q, fx, fy, 0.0)
    force[0] += wx + m.linear_drag * x
    force[1] += wy + m.linear_drag * y
    force[2] += wz + m.linear_drag * z
