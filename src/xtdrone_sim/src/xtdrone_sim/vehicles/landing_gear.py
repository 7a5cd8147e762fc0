"""Landing gears: legs that are up in flight, out of the camera's way, and down to stand on.

The autopilot says when they are to be up (PX4: in AUTO modes more than 2 m above home); they move as fast as the
slowest of their joints. What touches the ground is the vehicle's box, wherever they are.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from xtdrone_control.autopilot.commander.commander import Commander
from xtdrone_sim.vehicles.vehicle_model import VehicleModel

_STEPS = 5  # 50 Hz: how often they move

GEAR = np.dtype(
    [
        ("raised", "f8"),  # 0 down, 1 up
        ("rate", "f8"),  # 1/s, of that
        ("speed", "f8"),  # 1/s, its largest; 0: there is none
    ],
    align=True,
)


class LandingGears:
    """The landing gears of a fleet.

    Attributes:
        records: (n,) ``GEAR``.
    """

    def __init__(self, models: Sequence[VehicleModel]) -> None:
        """Fit them, all down.

        Args:
            models: one a vehicle.
        """
        self.records = np.zeros(len(models), GEAR)
        for record, model in zip(self.records, models, strict=True):
            record["speed"] = min((joint.velocity / joint.upper for joint in model.landing_gear), default=0.0)
        self._fitted: list[int] = np.flatnonzero(self.records["speed"]).tolist()

    def step(self, steps: int, commanders: Sequence[Commander], dt: float) -> None:
        """Advance by one step.

        Args:
            steps: number of this step.
            commanders: the autopilots' modes, one a vehicle; empty where the autopilots are not ours: all stays down.
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
