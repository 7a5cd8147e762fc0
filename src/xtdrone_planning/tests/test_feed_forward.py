"""Acceleration setpoints of a trajectory."""

from __future__ import annotations

import numpy as np
import pytest

from xtdrone_planning.planner_settings import PlannerSettings
from xtdrone_planning.replanning.planner import acceleration_setpoint
from xtdrone_planning.trajectories.splines.uniform_spline import UniformSpline, coasting

PLAIN = PlannerSettings(attitude_lag=0.0, drag=0.0, damping=0.0)
WAY = UniformSpline(1.0, 0.5, np.array([[k * k, -0.5 * k * k, 0.2 * k * k] for k in range(9)], float))


def test_alone_it_is_that_of_the_trajectory() -> None:
    assert acceleration_setpoint(WAY, 2.2, PLAIN) == pytest.approx(WAY.at(2.2)[2])


def test_at_constant_speed_it_holds_against_the_drag_and_not_vertically() -> None:
    steady = coasting(np.zeros(3), np.array([3.0, -2.0, 1.0]), 0.0)
    assert acceleration_setpoint(steady, 5.0, PlannerSettings(drag=0.3)) == pytest.approx([0.9, -0.6, 0.0])


def test_the_autopilot_s_derivative_term_is_cancelled() -> None:
    found = acceleration_setpoint(WAY, 2.2, PlannerSettings(attitude_lag=0.0, drag=0.0, damping=0.25))
    assert found == pytest.approx(WAY.at(2.2)[2] * [1.25, 1.25, 1.0])


def test_it_leads_by_the_attitude_s_lag_and_is_zero_after_the_end() -> None:
    ahead = PlannerSettings(attitude_lag=0.3, drag=0.0, damping=0.0)
    assert acceleration_setpoint(WAY, 2.0, ahead) == pytest.approx(WAY.at(2.3)[2])
    assert acceleration_setpoint(WAY, WAY.end - 0.2, ahead) == pytest.approx(np.zeros(3))
