"""What a swarm steers: the cut between the algorithms and whatever moves the vehicles, simplified or full physics."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

HOLD, VELOCITY, ACCELERATION, POSITION = 0, 1, 2, 3
"""Kinds of a setpoint: stay where it is now; m/s ENU; m/s^2 ENU; m ENU."""


class Vehicles(Protocol):
    """N vehicles, in order of their numbers. All arrays are ENU in the ``map`` frame, and read-only for others.

    Attributes:
        names: as ``iris_0``.
        time_us: simulated time, microseconds; a multiple of ``step_us``.
        step_us: base step, microseconds.
        position: where they believe to be, shape (N, 3), m; in the simplified models the truth.
        velocity: likewise, shape (N, 3), m/s.
        yaw: heading, rad counter-clockwise from east, shape (N,).
        true_position: shape (N, 3), m.
        armed: one a vehicle.
        mode: PX4's mode as MAVROS names it, one a vehicle.
    """

    names: tuple[str, ...]
    time_us: int
    step_us: int
    position: Array
    velocity: Array
    yaw: Array
    true_position: Array
    armed: Sequence[bool]
    mode: Sequence[str]

    def command(self, index: int, text: str) -> str:
        """Give a vehicle an XTDrone command: ARM, DISARM, HOVER or a PX4 mode as OFFBOARD or AUTO.LAND.

        Returns:
            Why it is refused, "" when it is not.
        """

    def steer(self, kind: int, vectors: Array, given: Mask) -> None:
        """Set the setpoints of some vehicles, which act in OFFBOARD from now on until the next; heading is kept.

        Args:
            kind: VELOCITY or ACCELERATION (POSITION where the vehicles take it).
            vectors: shape (N, 3), ENU.
            given: shape (N,), which rows count.
        """

    def steer_one(self, index: int, kind: int, vector: tuple[float, float, float], yaw_rate: float = 0.0) -> None:
        """Set one vehicle's setpoint, ENU, with a yaw rate in rad/s."""

    def advance(self, time_us: int) -> None:
        """Move on to ``time_us``, a multiple of ``step_us``."""

    def restart(self) -> None:
        """Put all back to their start, time too; the same inputs then lead to the same flight, to the last bit."""

    def close(self) -> None:
        """Free what is held."""
