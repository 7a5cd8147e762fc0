"""What is known of the swarm at one place: the latest position and velocity of every vehicle."""

from __future__ import annotations

import math
from collections.abc import Sequence

from xtdrone_coordination.consensus import Vector


class SwarmState:
    """Positions and velocities as they come in; one object may serve all followers of a process.

    Time is counted in ticks of the control loop, so nothing here reads a clock.

    Attributes:
        count: number of vehicles N.
        positions: m, ENU, in the frame all share; None until heard of.
        velocities: m/s, ENU; None until heard of.
    """

    def __init__(self, count: int) -> None:
        """Know nothing yet of ``count`` vehicles."""
        self.count = count
        self.positions: list[Vector | None] = [None] * count
        self.velocities: list[Vector | None] = [None] * count
        self._heard = [0] * count
        self._ticks = 0

    def restart(self) -> None:
        """Know nothing again, as after construction."""
        self.positions[:] = self.velocities[:] = [None] * self.count
        self._heard[:] = [0] * self.count
        self._ticks = 0

    def on_position(self, index: int, position: Vector) -> None:
        """Take a vehicle's position, m ENU; one that is not finite is as if it had not come."""
        if math.isfinite(position[0] + position[1] + position[2]):
            self.positions[index] = position
            self._heard[index] = self._ticks

    def on_velocity(self, index: int, velocity: Vector) -> None:
        """Take a vehicle's velocity, m/s ENU; one that is not finite is as if it had not come."""
        if math.isfinite(velocity[0] + velocity[1] + velocity[2]):
            self.velocities[index] = velocity

    def tick(self) -> None:
        """Count one period of the control loop; call it once per period, after everything has been updated."""
        self._ticks += 1

    def fresh(self, index: int, ticks: int) -> bool:
        """Return whether a position of this vehicle came in the last ``ticks`` ticks."""
        return self.positions[index] is not None and self._ticks - self._heard[index] <= ticks


def as_vector(value: Sequence[float]) -> Vector | None:
    """Return ``value`` (a tuple, list or array) as three finite floats, None if it is not that."""
    try:
        x, y, z = (float(v) for v in value)
    except (TypeError, ValueError):
        return None
    return (x, y, z) if math.isfinite(x) and math.isfinite(y) and math.isfinite(z) else None
