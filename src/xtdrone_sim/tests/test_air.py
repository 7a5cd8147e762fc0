"""Wind, turbulence, ground effect, downwash and drag, against closed form."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.signal import welch

from xtdrone_common.fleet import parse_fleet
from xtdrone_common.settings import SettingError
from xtdrone_sim.air import AIR, BodyDrag, Downwash, Dryden, GroundEffect, WindField, WindRegion
from xtdrone_sim.air.dryden import intensities
from xtdrone_sim.air.rotor_wakes import thrust_ratio, wake_speed
from xtdrone_sim.air.wind import DENSITY, add_wind
from xtdrone_sim.effects import EffectError, load_effects
from xtdrone_sim.physics.vehicle_dynamics import PLANT, rotor_wrench
from xtdrone_sim.simulation import Simulation
from xtdrone_sim.vehicles.vehicle_model import MODEL, load_vehicle

STEP = 0.004


def fleet(count: int, height: float = 6.0) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return vehicles that hover level, and their models."""
    models = np.zeros(count, MODEL)
    models[:] = load_vehicle("iris").record
    plant = np.zeros(count, PLANT)
    plant["q"][:, 0] = 1.0
    plant["position"][:, 2] = height
    plant["rotor_speed"][:, :4] = math.sqrt(models[0]["mass"] * 9.80665 / 4.0 / models[0]["thrust_constant"])
    return plant, models


def wrench(effect: Any, plant: NDArray[Any], models: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    force, torque = np.zeros((len(plant), 3)), np.zeros((len(plant), 3))
    effect(0.0, plant, models, force, torque)
    return force, torque


def test_a_further_wind_is_the_plant_s_own() -> None:
    plant, models = fleet(1)
    random = np.random.default_rng(2)
    v, m = plant[0], models[0]
    q = random.standard_normal(4)
    v["q"], v["velocity"], v["rates"] = q / np.linalg.norm(q), random.standard_normal(3), random.standard_normal(3)
    still, windy, wind = plant.copy(), plant.copy(), np.array([3.0, -2.0, 1.0])
    windy[0]["wind"] = wind
    rotor_wrench(still[0], m)
    rotor_wrench(windy[0], m)
    force, torque = np.zeros(3), np.zeros(3)
    add_wind(v, m, *wind, force, torque)
    np.testing.assert_allclose(windy[0]["force"] - still[0]["force"], force, atol=1e-12)
    np.testing.assert_allclose(windy[0]["torque"] - still[0]["torque"], torque, atol=1e-12)


def test_intensities_and_scales_of_the_specification() -> None:
    """The denominator 0.177 + 0.000823 h is 0.19346 at 20 ft."""
    sigma_u, sigma_w, length_u, length_w = intensities(20 * 0.3048, 15.4)
    assert (sigma_w, length_w) == pytest.approx((1.54, 6.096))
    assert sigma_u == pytest.approx(1.54 / 0.19346**0.4)
    assert length_u == pytest.approx(6.096 / 0.19346**1.2)
    assert intensities(0.0, 15.4) == intensities(3.0, 15.4)  # the model begins at 10 ft
    assert intensities(900.0, 15.4) == intensities(304.8, 15.4)


def gusts(seconds: float, step: float, count: int = 200, **values: Any) -> NDArray[np.float64]:
    """Return the turbulence on hovering vehicles, shape (times, count, 3)."""
    plant, models = fleet(count)
    effect = Dryden(**values)
    effect.reset(models, step, np.random.default_rng(0))
    force, torque = np.zeros((count, 3)), np.zeros((count, 3))
    found = []
    for _ in range(round(seconds / step)):
        effect(0.0, plant, models, force, torque)
        found.append(effect.gusts.copy())
    return np.array(found)


@pytest.mark.parametrize("step", [STEP, 0.5])
def test_the_turbulence_has_its_standard_deviation_from_the_start_and_for_any_step(step: float) -> None:
    sigma_u, sigma_w, _, _ = intensities(6.0, 15.4)
    found = gusts(40 * step, step, count=4000, speed=15.4)
    for row in (found[0], found[-1]):
        np.testing.assert_allclose(row.std(axis=0), (sigma_u, sigma_u, sigma_w), rtol=0.04)
        np.testing.assert_allclose(row.mean(axis=0), 0.0, atol=0.2)


def test_the_turbulence_has_the_spectrum_of_the_specification() -> None:
    speed, step = 15.4, 0.02
    sigma_u, sigma_w, length_u, length_w = intensities(6.0, speed)
    found = gusts(164.0, step, count=60, speed=speed)
    frequency, power = welch(found, fs=1.0 / step, nperseg=2048, axis=0)
    power, chosen = power.mean(axis=1), (frequency > 0.05) & (frequency < 5.0)
    omega = 2.0 * math.pi * frequency[chosen]
    u, w = omega * length_u / speed, omega * length_w / speed
    first = 4.0 * sigma_u**2 * length_u / speed / (1.0 + u**2)  # one-sided, per hertz
    across = 2.0 * sigma_u**2 * length_u / speed * (1.0 + 3.0 * u**2) / (1.0 + u**2) ** 2
    up = 2.0 * sigma_w**2 * length_w / speed * (1.0 + 3.0 * w**2) / (1.0 + w**2) ** 2
    for axis, wanted in enumerate((first, across, up)):
        ratio = power[chosen, axis] / wanted
        bands = [part.mean() for part in np.array_split(ratio, 12)]
        np.testing.assert_allclose(bands, 1.0, atol=0.12)


def test_shared_turbulence_is_one_and_mean_and_direction_count() -> None:
    found = gusts(1.0, 0.1, count=3, shared=True)
    assert (found == found[:, :1]).all()
    assert (gusts(1.0, 0.1, count=3) != found).any()
    mean = gusts(200.0, 0.5, count=100, speed=8.0, mean=True, direction=math.pi / 2).mean(axis=(0, 1))
    np.testing.assert_allclose(mean, (0.0, 8.0, 0.0), atol=0.1)


def test_ground_effect_is_that_of_cheeseman_and_bennett() -> None:
    assert [thrust_ratio(z, 0.127) for z in (0.0, 0.0635, 0.127, 0.254, 12.7)] == pytest.approx(
        [4.0 / 3.0, 4.0 / 3.0, 16.0 / 15.0, 64.0 / 63.0, 1.0], abs=1e-5
    )
    plant, models = fleet(2, height=0.2)
    plant[1]["position"][2] = 20.0
    force, torque = wrench(GroundEffect(), plant, models)
    hub = 0.2 + models[0]["rotor_position"][0, 2]
    weight = models[0]["mass"] * 9.80665
    assert force[0, 2] == pytest.approx(weight * (thrust_ratio(hub, 0.127) - 1.0), rel=1e-9)
    assert force[1, 2] == pytest.approx(0.0, abs=1e-4)
    np.testing.assert_allclose(torque, 0.0, atol=1e-9)


def test_a_wake_has_the_momentum_of_its_thrust_and_pushes_what_is_below() -> None:
    thrust, radius = 15.0, 0.127 * 2.0
    beginning = wake_speed(1e-9, 0.0, thrust, radius, 0.12)
    assert beginning == pytest.approx(math.sqrt(2.0 * thrust / (DENSITY * 4.0 * math.pi * 0.127**2)))
    assert wake_speed(-0.1, 0.0, thrust, radius, 0.12) == 0.0
    radii = np.linspace(0.0, 8.0, 8001)
    for below in (0.1, 1.0, 3.0, 8.0):
        speeds = np.array([wake_speed(below, r, thrust, radius, 0.12) for r in radii])
        assert np.trapz(DENSITY * speeds**2 * 2.0 * math.pi * radii, radii) == pytest.approx(thrust, rel=1e-4)
    plant, models = fleet(3)
    plant["position"] = [(0.0, 0.0, 8.0), (0.1, 0.0, 6.0), (5.0, 0.0, 6.0)]
    force, _ = wrench(Downwash(), plant, models)
    assert force[0, 2] == 0.0
    assert force[1, 2] < -0.1
    assert abs(force[2, 2]) < 1e-6


def test_a_vehicle_without_thrust_falls_at_its_terminal_velocity() -> None:
    plant, models = fleet(1)
    box, linear = models[0]["box"], models[0]["linear_drag"]
    half = 0.5 * DENSITY * 1.2 * box[0] * box[1]
    weight = models[0]["mass"] * 9.80665
    speed = (-linear + math.sqrt(linear**2 + 4.0 * half * weight)) / (2.0 * half)
    plant["velocity"][0, 2] = -speed
    force, _ = wrench(BodyDrag(coefficient=1.2), plant, models)
    assert force[0, 2] + linear * speed == pytest.approx(weight)
    plant["wind"][0] = plant["velocity"][0]
    assert wrench(BodyDrag(), plant, models)[0] == pytest.approx(0.0)


def fallen(seconds: float, coefficient: float, *winds: Any) -> tuple[NDArray[np.float64], Simulation]:
    """Return the velocity of a vehicle without thrust after a fall from rest, and its simulation."""
    effects = [*winds, BodyDrag(coefficient=coefficient)]
    simulation = Simulation(parse_fleet("iris:1"), places=[(0.0, 0.0, 900.0)], effects=effects)
    simulation.world.models["linear_drag"] = 0.15
    simulation.run_until(round(seconds * 1e6))
    velocity = simulation.world.plant["velocity"][0].copy()
    simulation.close()
    return velocity, simulation


def test_a_simulated_fall_in_wind_is_that_of_its_equation() -> None:
    """In level attitude each axis obeys dv/dt = a - b v - c v |v|, with the velocity v relative to the air.

    Downwards, a = g and the terminal speed is the root of a = b v + c v^2; along the wind, a = 0, Bernoulli's equation
    gives v = b / ((b / w + c) exp(b t) - c) from the wind's speed w.
    """
    coefficient, wind, seconds = 1.2, 6.0, 12.0
    velocity, simulation = fallen(
        seconds, coefficient, WindRegion(wind=[4.0, 0.0, 0.0]), WindField(lambda *_: (2.0, 0, 0))
    )
    m = simulation.world.models[0]
    b = m["linear_drag"] / m["mass"]
    down, along = (0.5 * DENSITY * coefficient * m["box"][k] * m["box"][1] / m["mass"] for k in (0, 2))
    terminal = (-b + math.sqrt(b * b + 4.0 * down * 9.80665)) / (2.0 * down)
    assert velocity[2] == pytest.approx(-terminal, rel=1e-3)
    rest = b / ((b / wind + along) * math.exp(b * seconds) - along)
    assert wind - velocity[0] == pytest.approx(rest, rel=5e-3, abs=1e-3)
    assert velocity[1] == pytest.approx(0.0, abs=1e-9)


def test_drag_feels_the_winds_listed_before_it_only() -> None:
    drag, wind = BodyDrag(), WindField(lambda *_: (5.0, 0.0, 0.0))
    simulation = Simulation(parse_fleet("iris:1"), effects=[drag, wind, BodyDrag()])
    assert (len(drag._winds), wind.winds.shape) == (0, (1, 3))
    simulation.close()


def test_turbulence_begins_again_after_a_restart() -> None:
    effect = Dryden(speed=12.0)
    simulation = Simulation(parse_fleet("iris:2"), effects=[effect], seed=5)
    flights = []
    for _ in range(2):
        gusts = []
        while simulation.time_us < 400_000:
            simulation.step()
            gusts.append(effect.gusts.copy())
        flights.append(np.array(gusts))
        simulation.restart()
    assert np.abs(flights[0]).max() > 0.1
    np.testing.assert_array_equal(*flights)
    simulation.close()
    other = Dryden(speed=12.0)
    simulation = Simulation(parse_fleet("iris:2"), effects=[other], seed=6)
    simulation.step()
    assert (other.gusts != flights[0][0]).all()
    simulation.close()


def test_a_region_is_smooth_and_a_field_may_be_one_s_own(tmp_path: Path) -> None:
    plant, models = fleet(4)
    plant["position"][:, 0] = (-1.0, 1.0, 2.5, 5.0)
    region = WindRegion(low=[0.0, -9.0, 0.0], high=[10.0, 9.0, 20.0], wind=[0.0, 4.0, 0.0], edge=2.0)
    force, _ = wrench(region, plant, models)
    whole, _ = wrench(WindField(lambda time, positions: (0.0, 4.0, 0.0)), plant, models)
    np.testing.assert_allclose(force[:, 1] / whole[:, 1], (0.0, 0.5, 1.0, 1.0))
    (tmp_path / "mine.py").write_text("def shear(time, positions):\n    return positions * [0, 0, 0.1] + [1, 0, 0]\n")
    (field,) = load_effects([{"wind_field": {"function": f"{tmp_path}/mine.py:shear"}}])
    assert wrench(field, plant, models)[0][0, 0] == pytest.approx(whole[0, 1] / 4.0)


def test_a_flight_in_all_effects_is_the_same_again() -> None:
    def flown() -> bytes:
        effects = load_effects([{"dryden": {"speed": 5.0}}, "ground_effect", "downwash", "body_drag"])
        simulation = Simulation(parse_fleet("iris:2"), effects=effects, seed=3)
        simulation.run_until(1_000_000)
        for commander in simulation.commanders:
            commander.arm_disarm(True, force=True)
        simulation.run_until(2_000_000)
        result = simulation.world.plant.tobytes()
        simulation.close()
        return result

    assert flown() == flown()


@pytest.mark.parametrize(
    ("entry", "words"),
    [
        ("drydn", "the names are dryden, wind_region"),
        ({"dryden": {"speed": -1.0}}, "speed"),
        ({"dryden": {"sped": 1.0}}, "sped"),
        ({"wind_region": {"low": [0, 0]}}, "3 numbers"),
        ({"wind_region": {"low": [0, 0, 5], "high": [1, 1, 4]}}, "above low"),
        ({"wind_region": {"wind": [0, 0, math.nan]}}, "wind"),
        ({"ground_effect": {"rotor_radius": 0}}, "rotor_radius"),
        ({"wind_field": {"function": "nowhere"}}, "FILE.py:NAME or module:NAME"),
        ({"wind_field": {}}, "function"),
    ],
)
def test_what_is_wrong_is_named(entry: Any, words: str) -> None:
    with pytest.raises(EffectError, match=words):
        load_effects([entry])


def test_every_effect_of_the_table_has_its_name() -> None:
    assert {name: cls.name for name, cls in AIR.items()} == {name: name for name in AIR}
    with pytest.raises(SettingError):
        Dryden(speed="fast")


def test_a_wind_set_in_flight_is_the_world_s_until_a_restart() -> None:
    simulation = Simulation(parse_fleet("iris:2"))
    own = simulation.world.plant["wind"].copy()
    for wind in ((math.nan, 0.0, 0.0), (80.0, 80.0, 0.0), (0.0, math.inf, 0.0)):
        with pytest.raises(ValueError, match=r"wind: .* is not allowed, at most 100 m/s"):
            simulation.set_wind(wind)
    np.testing.assert_array_equal(simulation.world.plant["wind"], own)
    simulation.set_wind((3.0, -2.0, 0.5))
    simulation.reset_vehicle(1)
    np.testing.assert_array_equal(simulation.world.plant["wind"], [(3.0, -2.0, 0.5)] * 2)
    simulation.restart()
    np.testing.assert_array_equal(simulation.world.plant["wind"], own)
