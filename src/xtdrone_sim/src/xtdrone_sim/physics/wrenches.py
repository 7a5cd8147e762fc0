"""Forces and torques of limited duration on vehicles and bodies, by request."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from xtdrone_common.rotation import Vector
from xtdrone_common.rotation_kernels import rotate_inverse
from xtdrone_sim.physics.bodies.movable_bodies import Bodies


@dataclass(frozen=True)
class Wrench:
    """A constant force and torque.

    Attributes:
        target: index of the vehicle, or the number of vehicles plus the number of the model.
        force: N, world, at the centre of mass.
        torque: N m, world.
        begin, end: steps since the start, with fractions: the wrench acts for that share of the first and last step.
    """

    target: int
    force: Vector
    torque: Vector
    begin: float
    end: float = math.inf


class Wrenches:
    """All wrenches that act now or later."""

    def __init__(self) -> None:
        """Start without wrenches."""
        self._wrenches: list[Wrench] = []

    def __len__(self) -> int:
        """Number of wrenches."""
        return len(self._wrenches)

    def add(self, wrench: Wrench) -> None:
        """Add a wrench."""
        self._wrenches.append(wrench)

    def clear(self, target: int) -> int:
        """Remove all wrenches of a target; return their number."""
        kept = [wrench for wrench in self._wrenches if wrench.target != target]
        removed = len(self._wrenches) - len(kept)
        self._wrenches = kept
        return removed

    def active(self, step: int) -> list[tuple[Wrench, float]]:
        """Return the wrenches that act during a step, with their share of it, and remove those that are over."""
        self._wrenches = [wrench for wrench in self._wrenches if wrench.end > step]
        shares = [(wrench, min(step + 1.0, wrench.end) - max(float(step), wrench.begin)) for wrench in self._wrenches]
        return [(wrench, share) for wrench, share in shares if share > 0.0]


def apply(active: list[tuple[Wrench, float]], plant: NDArray[np.void], bodies: Bodies) -> None:
    """Add the wrenches of a step to ``plant`` (n,) ``PLANT`` and to the bodies that are awake."""
    count = len(plant)
    for wrench, share in active:
        force = [share * value for value in wrench.force]
        if wrench.target < count:
            v = plant[wrench.target]
            v["force"] += force
            v["torque"] += rotate_inverse(v["q"], *(share * value for value in wrench.torque))
            continue
        body = bodies.by_number.get(wrench.target - count)
        if body is not None:
            body.force = [a + b for a, b in zip(body.force, force, strict=True)]
            body.torque = [a + share * b for a, b in zip(body.torque, wrench.torque, strict=True)]
