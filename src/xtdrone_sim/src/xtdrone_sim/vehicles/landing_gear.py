"""Landing gears, raised in flight out of the camera's view and lowered on the ground.

The autopilot commands the position (PX4: raised in AUTO modes more than 2 m above home). The joints move at the speed
of the slowest. Contact with the ground is that of the vehicle's collision box, independent of the gear.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from xtdrone_control.autopilot.commander.commander import Commander
from xtdrone_sim.vehicles.vehicle_model import VehicleModel

_STEPS = 5  # steps between two updates: 50 Hz

GEAR = np.dtype(
    [
        ("raised", "f8"),  # 0 down, 1 up
        ("rate", "f8"),  # 1/s, rate of ``raised``
        ("speed", "f8"),  # 1/s, maximum rate; 0: no landing gear
    ],
    align=True,
)


class LandingGears:
    """The landing gears of a fleet.

    Attributes:
        records: (n,) ``GEAR``.
        any: whether a vehicle has one.
    """

    def __init__(self, models: Sequence[VehicleModel]) -> None:
        """Create the landing gears, lowered.

        Args:
            models: one per vehicle.
        """
        self.records = np.zeros(len(models), GEAR)
        for index, model in enumerate(models):
            self.fit(index, model)

    def fit(self, index: int, model: VehicleModel | None) -> None:
        """Fit the vehicle ``index`` with the landing gear of a model, lowered; None removes it."""
        joints = () if model is None else model.landing_gear
        self.records[index] = np.zeros(1, GEAR)[0]
        self.records[index]["speed"] = min((joint.velocity / joint.upper for joint in joints), default=0.0)
        self._fitted: list[int] = np.flatnonzero(self.records["speed"]).tolist()
        self.any = bool(self._fitted)

    def reset(self, index: int) -> None:
        """Lower the landing gear of vehicle ``index`` at once."""
        self.records[index]["raised"] = self.records[index]["rate"] = 0.0

    def step(self, steps: int, commanders: Sequence[Commander], dt: float) -> None:
        """Advance by one step.

        Args:
            steps: number of this step.
            commanders: one per vehicle; empty for external autopilots: the gears stay down.
            dt: s.
        """
        if steps % _STEPS or not commanders:
            return
        for i in self._fitted:
            gear = self.records[i]
            before = float(gear["raised"])
            change = float(gear["speed"]) * dt * _STEPS
            raised = min(before + change, 1.0) if commanders[i].gear_up else max(before - change, 0.0)
            gear["raised"] = raised
            gear["rate"] = (raised - before) / (dt * _STEPS)
