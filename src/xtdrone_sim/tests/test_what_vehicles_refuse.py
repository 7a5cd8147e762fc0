"""Rejections of all kinds of vehicles have the same texts."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
import pytest

from xtdrone_swarm.full_vehicles import CoreVehicles
from xtdrone_swarm.simplified.simplified_vehicles import SimplifiedVehicles
from xtdrone_swarm.swarm_vehicles import VELOCITY, Vehicles


@pytest.fixture(scope="module", params=[CoreVehicles, SimplifiedVehicles])
def vehicles(request: pytest.FixtureRequest) -> Iterator[Vehicles]:
    made = request.param(2)
    yield made
    made.close()


def test_both_reject_invalid_values(vehicles: Vehicles) -> None:
    all_of_them, still = np.ones(2, dtype=bool), np.zeros((2, 3))
    for index in (-1, 2):
        with pytest.raises(IndexError, match=f"vehicle {index} does not exist; 0 to 1"):
            vehicles.command(index, "ARM")
        with pytest.raises(IndexError, match=f"vehicle {index} does not exist; 0 to 1"):
            vehicles.steer_one(index, VELOCITY, (0.0, 0.0, 0.0))
    with pytest.raises(ValueError, match="kind of setpoint: 7"):
        vehicles.steer(7, still, ~all_of_them)
    with pytest.raises(ValueError, match=r"shapes \(3, 3\) and \(2,\) are not allowed"):
        vehicles.steer(VELOCITY, np.zeros((3, 3)), all_of_them)
    with pytest.raises(ValueError, match=r"setpoint of iris_1: .*finite numbers are needed"):
        vehicles.steer(VELOCITY, np.array([[0.0, 0.0, 0.0], [0.0, math.nan, 0.0]]), all_of_them)
    with pytest.raises(ValueError, match=r"setpoint of iris_0: .*finite numbers are needed"):
        vehicles.steer_one(0, VELOCITY, (0.0, 0.0, 0.0), math.inf)
    with pytest.raises(ValueError, match="time: 3 us is not allowed, a multiple of 4000 us"):
        vehicles.advance(3)
