"""The smoothed path across resets of the estimator."""

from __future__ import annotations

import numpy as np
import pytest

from xtdrone_autopilot.estimator import fusion
from xtdrone_autopilot.flight_tasks.flight_tasks import follow_resets
from xtdrone_autopilot.state import CONTROL, ESTIMATOR


def test_the_path_keeps_its_distance_from_the_vehicle():
    e, c = np.zeros(1, ESTIMATOR), np.zeros(1, CONTROL)
    e["q"][:, 0] = 1.0
    e["located"] = e["altitude_valid"] = 1
    e["position"][0], e["velocity"][0] = (1.0, 2.0, -3.0), (0.5, 0.0, 0.1)
    c["path"]["position"][0], c["path"]["velocity"][0] = (1.5, 2.5, -3.5), (0.6, 0.1, 0.0)
    c["path"]["yaw"] = 3.0
    c["last_velocity"] = 1.0
    ahead = c["path"]["position"][0] - e["position"][0]
    faster = c["path"]["velocity"][0] - e["velocity"][0]
    fusion.reset_position(e[0], -20.0, 30.0, 1.0)
    fusion.reset_velocity(e[0], 2.0, -2.0, 1.0)
    fusion.reset_height(e[0], 5.0, 1.0)
    fusion.reset_vertical_velocity(e[0], -1.0, 1.0)
    fusion.reset_yaw(e[0], 0.5, 1.0)
    for _ in range(2):  # once for each reset, however often it is called
        follow_resets(c[0]["path"], c[0]["last_velocity"], c[0]["resets_seen"], e[0]["resets"], e[0]["shifts"])
        np.testing.assert_allclose(c["path"]["position"][0] - e["position"][0], ahead)
        np.testing.assert_allclose(c["path"]["velocity"][0] - e["velocity"][0], faster)
        assert c["path"]["yaw"][0] == pytest.approx(3.5 - 2.0 * np.pi)
        assert np.isnan(c["last_velocity"]).all()
