"""User-defined effects: forces and torques on the vehicles, against closed forms, and rejections."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from numba import njit

from xtdrone_common import modes
from xtdrone_common.fleet import StartPose, parse_fleet
from xtdrone_sim.effects import EffectError, Effects, load_effects
from xtdrone_sim.physics.world import World
from xtdrone_sim.simulation import Simulation
from xtdrone_sim.vehicles.vehicle_model import load_vehicle
from xtdrone_worlds.worlds.catalogue import load_world

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"
DT = 0.004
GRAVITY = 9.80665


@njit
def pushed_and_turned(time, vehicles, models, force, torque):
    force[:, 0] += 0.3
    torque[:, 2] += 0.02


def nothing(time, vehicles, models, force, torque):
    pass


class Counter:
    """Pushes harder with each step, by an amount drawn at the reset."""

    def reset(self, models, time_step, random):
        self.push, self.steps = random.standard_normal(), 0

    def __call__(self, time, vehicles, models, force, torque):
        assert time == pytest.approx(self.steps * DT) or self.steps == 0
        force[:, 0] += self.push + 0.001 * self.steps
        self.steps += 1


def flying_world(*effects, places=((0.0, 0.0, 50.0),)):
    applied = Effects(effects)
    world = World(
        load_world("empty"), [load_vehicle("iris")] * len(places), [StartPose(*place) for place in places], DT, applied
    )
    applied.begin(world.plant, world.models)
    return world


def run(world, steps, armed=0):
    count = len(world.plant)
    for _ in range(steps):
        world.step(np.zeros((count, 8)), np.full(count, armed, np.int32))


def test_force_accelerates_by_mass_and_torque_turns_by_inertia():
    world = flying_world(pushed_and_turned)
    run(world, 250)
    v, m = world.plant[0], world.models[0]
    assert v["velocity"][0] == pytest.approx(0.3 / m["mass"], rel=1e-9)
    assert v["position"][0] == pytest.approx(0.5 * 0.3 / m["mass"], rel=1e-2)
    assert v["velocity"][2] == pytest.approx(-GRAVITY, rel=1e-9)
    assert v["rates"][2] == pytest.approx(0.02 / m["inertia"][2], rel=1e-9)


def test_effects_add_up_in_order_and_see_those_before():
    seen = []

    def watch(time, vehicles, models, force, torque):
        seen.append(float(vehicles["force"][0, 0]))

    run(flying_world(watch, pushed_and_turned, watch, pushed_and_turned, watch), 10)
    assert np.diff(seen[-3:]) == pytest.approx([0.3, 0.3])


def test_hovering_vehicle_leans_against_a_constant_force():
    """At rest the thrust's horizontal part balances the force: tan(tilt) = F / (m g)."""
    simulation = Simulation(parse_fleet("iris:1"), effects=[load_effects([f"{__file__}:east_wind"])[0]])
    commander = simulation.commanders[0]
    simulation.run_until(2_000_000)
    commander.request(modes.AUTO_TAKEOFF)
    commander.arm_disarm(True)
    simulation.run_until(20_000_000)
    tilts = []
    for _ in range(500):
        simulation.step()
        _, x, y, _ = simulation.world.plant["q"][0]
        tilts.append(math.acos(1.0 - 2.0 * (x * x + y * y)))
    v, m = simulation.world.plant[0], simulation.world.models[0]
    assert np.linalg.norm(v["velocity"]) < 0.2
    assert np.mean(tilts) == pytest.approx(math.atan2(1.5, m["mass"] * GRAVITY), rel=0.05)
    simulation.close()


def east_wind(time, vehicles, models, force, torque):
    if vehicles["position"][0, 2] > 1.0:
        force[:, 0] += 1.5


def test_an_effect_of_nothing_leaves_every_bit():
    plants = []
    for effects in ((), (nothing,)):
        simulation = Simulation(parse_fleet("iris:2"), effects=effects)
        simulation.run_until(2_000_000)
        for commander in simulation.commanders:
            commander.request(modes.AUTO_TAKEOFF)
            commander.arm_disarm(True)
        simulation.run_until(8_000_000)
        plants.append(simulation.world.plant.tobytes())
        simulation.close()
    assert plants[0] == plants[1]


def test_restart_resets_state_and_noise_and_the_seed_changes_it():
    counter = Counter()
    simulation = Simulation(parse_fleet("iris:1"), effects=[counter], seed=3)
    first = counter.push
    simulation.run_until(100_000)
    plant = simulation.world.plant.tobytes()
    assert counter.steps == 25
    simulation.restart()
    assert (counter.push, counter.steps) == (first, 0)
    simulation.run_until(100_000)
    assert simulation.world.plant.tobytes() == plant
    simulation.close()
    Simulation(parse_fleet("iris:1"), effects=[counter], seed=4).close()
    assert counter.push != first


def test_sleeping_vehicles_do_not_move():
    world = flying_world(pushed_and_turned, places=((0.0, 0.0, 0.0),))
    world.plant["still_steps"] = 1000
    run(world, 50)
    assert not world.plant["rates"].any()


def test_gust_of_the_examples_has_its_strength_and_wanders():
    (gust,) = load_effects([{f"{EXAMPLES}/gust.py:Gust": {"speed": 2.0, "correlation": 0.2}}])
    world = flying_world(gust)
    world.plant["rotor_speed"] = 600.0
    pushes = []
    for step in range(20_000):
        force = np.zeros((1, 3))
        gust(step * DT, world.plant, world.models, force, force.copy())
        pushes.append(force[0, :2])
    drag = world.models["drag_coefficient"][0] * world.plant["rotor_speed"][0].sum()
    assert np.std(pushes) == pytest.approx(2.0 * drag, rel=0.15)
    later = np.corrcoef(np.array(pushes)[:-50, 0], np.array(pushes)[50:, 0])[0, 1]
    assert later == pytest.approx(math.exp(-1.0), abs=0.1)


def test_downwash_of_the_examples_pushes_the_lower_one_alone():
    (downwash,) = load_effects([f"{EXAMPLES}/downwash.py:downwash"])
    world = flying_world(downwash, places=((0.0, 0.0, 10.0), (0.2, 0.0, 8.0), (9.0, 0.0, 8.0)))
    world.plant["rotor_speed"][:, :4] = 600.0
    force, torque = np.zeros((3, 3)), np.zeros((3, 3))
    downwash(0.0, world.plant, world.models, force, torque)
    assert force[0, 2] == 0.0
    assert -10.0 < force[1, 2] < -0.3
    assert abs(force[2, 2]) < 1e-3
    assert not force[:, :2].any()
    assert not torque.any()


def raises(time, vehicles, models, force, torque):
    raise RuntimeError("no wind today")


def writes_nan(time, vehicles, models, force, torque):
    force[0, 1] = math.nan


def moves_vehicles(time, vehicles, models, force, torque):
    vehicles["position"] = 0.0


def too_few(time, vehicles):
    pass


class Broken:
    def reset(self, models, time_step, random):
        raise ValueError("no table")

    def __call__(self, time, vehicles, models, force, torque):
        pass


@pytest.mark.parametrize(
    ("effect", "text"),
    [
        (raises, r"effect raises: failed at 0.000 s: RuntimeError: no wind today"),
        (writes_nan, r"effect writes_nan: force or torque on vehicle 0 is not finite at 0.000 s"),
        (moves_vehicles, r"effect moves_vehicles: failed .* read-only"),
        (too_few, r"effect too_few: the signature is \(time, vehicles\), it must be \(time, vehicles, models, force"),
        (njit(too_few), r"effect too_few: the signature is"),
        (Counter, r"effect Counter: is a class; pass an instance, Counter\(\.\.\.\)"),
        (Broken(), r"effect Broken: reset\(\) has failed: ValueError: no table"),
        ("gust", r"effect str: cannot be called"),
    ],
)
def test_an_invalid_effect_is_reported_before_the_flight(effect, text):
    with pytest.raises(EffectError, match=text):
        flying_world(effect)


def test_an_effect_that_fails_in_flight_is_reported_with_the_time():
    def late(time, vehicles, models, force, torque):
        force[0, 2] = math.inf if time > 0.05 else 0.0

    world = flying_world(nothing, late)
    with pytest.raises(EffectError, match=r"effect late: force or torque on vehicle 0 is not finite at 0\.052 s"):
        run(world, 50)


def test_effects_of_the_same_name_are_numbered_and_draw_separate_noise():
    first, second = Counter(), Counter()
    world = flying_world(first, second)
    assert world._effects.names == ("Counter", "Counter_2")
    assert first.push != second.push


@pytest.mark.parametrize(
    ("entries", "text"),
    [
        ("gust.py", r"~effects: 'gust.py' is not allowed, a list"),
        (["gust.py"], r"'gust.py' is not allowed, NAME, FILE.py:NAME"),
        ([3], r"3 is not allowed"),
        ([{"a.py:A": 1}], r"is not allowed"),
        (["/no/such.py:Gust"], r"/no/such.py:Gust cannot be loaded: FileNotFoundError"),
        (["no_such_module:Gust"], r"no_such_module:Gust cannot be loaded: ModuleNotFoundError"),
        ([f"{EXAMPLES}/gust.py:Gusts"], r"cannot be loaded: AttributeError"),
        ([{f"{EXAMPLES}/gust.py:Gust": {"sped": 1}}], r"with arguments \{'sped': 1\}: TypeError"),
    ],
)
def test_wrong_entries_of_the_parameter_are_rejected(entries, text):
    with pytest.raises(EffectError, match=text):
        load_effects(entries, "~effects")
