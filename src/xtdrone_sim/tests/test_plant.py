"""Free-flight dynamics against closed forms."""

from __future__ import annotations

import math

import numpy as np
import pytest

from xtdrone_sim.physics import vehicle_dynamics
from xtdrone_sim.physics.vehicle_dynamics import PLANT
from xtdrone_sim.vehicles.vehicle_model import load_vehicle

GRAVITY = 9.80665
DT = 0.004


@pytest.fixture
def iris():
    return np.array([load_vehicle("iris").record])


def body(**fields):
    state = np.zeros(1, PLANT)
    state["q"][:, 0] = 1.0
    for name, value in fields.items():
        state[name] = value
    return state


def fly(state, models, steps, actuators=None, armed=0):
    commands = np.zeros((1, 8)) if actuators is None else actuators
    for _ in range(steps):
        vehicle_dynamics.step_all(state, models, commands, np.array([armed], np.int32), GRAVITY, DT)


def test_free_fall_is_exact(iris):
    state = body(position=(0.0, 0.0, 100.0), velocity=(2.0, -1.0, 0.0))
    fly(state, iris, 250)
    np.testing.assert_allclose(state["position"][0], (2.0, -1.0, 100.0 - 0.5 * GRAVITY), atol=1e-9)
    np.testing.assert_allclose(state["velocity"][0], (2.0, -1.0, -GRAVITY), atol=1e-9)


def test_upstream_hover_command_holds_weight(iris):
    m = iris[0]
    hover = math.sqrt(m["mass"] * GRAVITY / (4 * m["thrust_constant"]))
    command = (hover - m["idle_speed"]) / m["input_scaling"]
    assert command == pytest.approx(0.563, abs=0.001)
    state = body(position=(0.0, 0.0, 10.0))
    state["rotor_speed"][0, :4] = hover
    fly(state, iris, 500, np.full((1, 8), command), armed=1)
    np.testing.assert_allclose(state["position"][0], (0.0, 0.0, 10.0), atol=1e-6)


def test_rotor_lag_is_first_order(iris):
    state = body()
    m = iris[0]
    steps = 3
    for _ in range(steps):
        vehicle_dynamics.advance_rotors(state[0], m, vehicle_dynamics.rotor_lag(m, DT), np.full(8, 0.5), 1)
    expected = 600.0 * (1.0 - math.exp(-steps * DT / m["time_constant_up"]))
    np.testing.assert_allclose(state["rotor_speed"][0, :4], expected, rtol=1e-12)


def test_torque_free_spin_keeps_angular_momentum_and_energy(iris):
    models = iris.copy()
    models["inertia"] = (0.02, 0.03, 0.055)
    state = body(rates=(3.0, 0.5, -2.0))
    inertia = models["inertia"][0]

    def momentum():
        v = state[0]
        return np.array(vehicle_dynamics.rotate(v["q"], *(inertia * v["rates"])))

    before, energy = momentum(), float(inertia @ state["rates"][0] ** 2)
    fly(state, models, 500)
    np.testing.assert_allclose(momentum(), before, atol=2e-4)
    assert float(inertia @ state["rates"][0] ** 2) == pytest.approx(energy, rel=1e-3)


def test_yaw_torque_follows_rotor_directions(iris):
    state = body()
    state["rotor_speed"][0, :2] = 700.0  # the counter-clockwise pair is faster: the body turns clockwise
    state["rotor_speed"][0, 2:4] = 600.0
    vehicle_dynamics.rotor_wrench(state[0], iris[0])
    m = iris[0]
    expected = -m["moment_constant"] * m["thrust_constant"] * 2 * (700.0**2 - 600.0**2)
    assert state["torque"][0, 2] == pytest.approx(expected)


def test_rotor_drag_brakes_and_leans_against_the_wind(iris):
    state = body(velocity=(3.0, 0.0, 0.0))
    state["rotor_speed"][0, :4] = 600.0
    vehicle_dynamics.rotor_wrench(state[0], iris[0])
    assert state["force"][0, 0] == pytest.approx(-4 * 1.75e-4 * 600.0 * 3.0)
    still = body(velocity=(3.0, 0.0, 0.0), wind=(3.0, 0.0, 0.0))
    still["rotor_speed"][0, :4] = 600.0
    vehicle_dynamics.rotor_wrench(still[0], iris[0])
    assert still["force"][0, 0] == pytest.approx(0.0)


def test_linear_drag_slows_a_body_exponentially():
    """m v' = -c v relative to the air: v - w = (v0 - w) exp(-c t / m)."""
    models = np.array([load_vehicle("px4_reference").record])
    state = body(position=(0.0, 0.0, 100.0), velocity=(5.0, 0.0, 0.0), wind=(1.0, 0.0, 0.0))
    fly(state, models, 500)
    assert state["velocity"][0, 0] - 1.0 == pytest.approx(4.0 * math.exp(-0.1 * 2.0 / 1.5), rel=1e-3)


def test_assumed_rotor_layout_is_the_allocator_s_and_not_the_plant_s():
    model = load_vehicle("px4_reference")
    np.testing.assert_allclose(np.abs(model.rotor_layout.positions[:, :2]), 0.15)
    np.testing.assert_allclose(np.abs(model.rotor_layout.moment_ratios), 0.05)
    np.testing.assert_allclose(model.record["rotor_position"][0], (0.13, -0.22, 0.023))
    own = load_vehicle("iris")
    np.testing.assert_allclose(own.rotor_layout.positions[0], (0.13, 0.22, -0.023))
