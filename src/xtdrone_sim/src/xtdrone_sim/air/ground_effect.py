"""Ground effect: rotors near the ground give more thrust.

I. C. Cheeseman, W. E. Bennett, "The effect of the ground on a helicopter rotor in forward flight", ARC R&M 3021, 1955:
for a rotor of radius R at the height z, T / T_free = 1 / (1 - (R / 4z)^2). The formula has a pole at z = R/4; below z =
R/2, where it has not been verified, the ratio at that height, 4/3, is kept. The ground is the plane z = 0.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from numpy.typing import NDArray

from xtdrone_control.rotation_kernels import rotate
from xtdrone_control.settings import Settings, setting
from xtdrone_sim.kernel import kernel


@dataclass(frozen=True)
class GroundSettings(Settings):
    """Settings of the ground effect."""

    rotor_radius: float = setting(0.127, above=0.0, high=5.0, unit="m", text="radius of the rotors (iris: 10 inch)")


@kernel
def thrust_ratio(height, radius):
    """Return the thrust at a height (m) above ground relative to that far from it, for rotors of a radius (m)."""
    ratio = radius / (4.0 * max(height, 0.5 * radius))
    return 1.0 / (1.0 - ratio * ratio)


@kernel
def _apply(vehicles, models, radius, force, torque):
    for i in range(len(vehicles)):
        v, m = vehicles[i], models[i]
        total = 0.0
        for k in range(m.rotor_count):
            px, py, pz = m.rotor_position[k, 0], m.rotor_position[k, 1], m.rotor_position[k, 2]
            _, _, up = rotate(v.q, px, py, pz)
            gain = thrust_ratio(v.position[2] + up, radius) - 1.0
            more = gain * m.thrust_constant * v.rotor_speed[k] ** 2
            total += more
            torque[i, 0] += py * more
            torque[i, 1] -= px * more
        x, y, z = rotate(v.q, 0.0, 0.0, total)
        force[i, 0] += x
        force[i, 1] += y
        force[i, 2] += z


class GroundEffect:
    """Thrust that grows near the ground."""

    name = "ground_effect"

    def __init__(self, **values: Any) -> None:
        """Create it with settings of ``GroundSettings``.

        Raises:
            SettingError: a value is not allowed.
        """
        self.settings = GroundSettings(**values)

    def __call__(
        self, time: float, vehicles: NDArray[Any], models: NDArray[Any], force: NDArray[Any], torque: NDArray[Any]
    ) -> None:
        """Add the additional thrust of each rotor."""
        _apply(vehicles, models, self.settings.rotor_radius, force, torque)
