"""Models that fall, rest, are pushed and sleep; placed vehicles; wrenches: against closed forms."""

from __future__ import annotations

import ctypes
import gc
import math
from dataclasses import replace

import numpy as np
import pytest

from xtdrone_common.fleet import StartPose, parse_fleet
from xtdrone_common.poses import Pose, compose
from xtdrone_common.rotation import from_euler
from xtdrone_sim.physics.bodies.movable_bodies import mass_of
from xtdrone_sim.physics.vehicle_dynamics import ASLEEP, FREE, TOUCHING
from xtdrone_sim.physics.world import World
from xtdrone_sim.physics.wrenches import Wrench
from xtdrone_sim.simulation import Simulation
from xtdrone_sim.vehicles.vehicle_model import load_vehicle
from xtdrone_worlds.shapes.visual import Box, Collision, Cylinder
from xtdrone_worlds.worlds.catalogue import load_world
from xtdrone_worlds.worlds.sdf import SdfLink, SdfModel, read_model
from xtdrone_worlds.worlds.urdf import Inertial

DT = 0.004
G = 9.8


def crate(position: tuple[float, float, float], mass: float = 2.0) -> SdfModel:
    """Return a cube of 1 m."""
    inertial = Inertial(mass, Pose(), (mass / 6.0, mass / 6.0, mass / 6.0, 0.0, 0.0, 0.0))
    link = SdfLink("l", collisions=(Collision(Box((1.0, 1.0, 1.0))),), inertial=inertial)
    return SdfModel("crate", Pose(position), False, (link,))


def make(models: tuple[SdfModel, ...], places: list[tuple[float, float, float]]) -> World:
    empty = replace(load_world("empty"), gravity=G)
    return World(
        replace(empty, models=models), [load_vehicle("iris")] * len(places), [StartPose(*place) for place in places], DT
    )


def run(world: World, steps: int, armed: bool = False) -> None:
    count = len(world.plant)
    for _ in range(steps):
        world.step(np.zeros((count, 8)), np.full(count, int(armed), np.int32))


def test_a_crate_falls_lies_and_sleeps() -> None:
    world = make((crate((50.0, 0.0, 20.0)),), [(0.0, 0.0, 0.0)])
    body = world.bodies.by_number[0]
    run(world, 250)
    assert body.velocity[2] == pytest.approx(-G, rel=1e-9)
    assert body.pose.position[2] == pytest.approx(20.0 - 0.5 * G, abs=0.5 * G * DT + 1e-6)  # Bullet: first order
    assert world.is_busy
    run(world, 1200)
    assert body.pose.position == pytest.approx((50.0, 0.0, 0.5), abs=0.03)
    assert body.velocity == (0.0, 0.0, 0.0)
    assert not world.is_busy
    world.close()


def test_what_lies_is_pushed_by_what_comes_and_nothing_else() -> None:
    world = make((crate((5.0, 0.0, 0.5)), crate((5.0, 9.0, 0.5))), [(0.0, 0.0, 0.3)])
    run(world, 500)
    assert not world.is_busy
    world.place_vehicle(0, (3.0, 0.0, 0.6), (1.0, 0.0, 0.0, 0.0), (12.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    run(world, 400)
    assert world.bodies.by_number[0].pose.position[0] > 5.05
    assert world.bodies.by_number[1].pose.position == pytest.approx((5.0, 9.0, 0.5), abs=5e-3)
    assert world.collisions == {(0, 1)}
    world.close()


def test_a_crate_wakes_the_vehicle_that_it_falls_on() -> None:
    world = make((crate((0.0, 0.2, 2.0), mass=20.0),), [(0.0, 0.0, 0.0)])
    run(world, 3)
    world.place_model(0, Pose((0.0, 0.2, 80.0)), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    run(world, 600)
    assert world.plant["contact"][0] == ASLEEP
    before = world.plant["position"][0].copy()
    run(world, 800)
    assert math.dist(before, world.plant["position"][0]) > 0.005
    world.close()


def test_a_removed_support_lets_its_load_fall() -> None:
    table = SdfModel(
        "table", Pose((4.0, 0.0, 1.0)), True, (SdfLink("l", collisions=(Collision(Box((2.0, 2.0, 0.1))),)),)
    )
    world = make((table, crate((4.0, 0.0, 1.6))), [(0.0, 0.0, 0.0)])
    run(world, 600)
    assert world.bodies.by_number[1].pose.position[2] == pytest.approx(1.55, abs=5e-3)
    assert world.has_obstacles
    world.remove_model(0)
    run(world, 600)
    assert world.bodies.by_number[1].pose.position[2] == pytest.approx(0.5, abs=5e-3)
    world.remove_model(1)
    assert not world.has_obstacles
    world.close()


def test_a_held_model_and_a_held_vehicle_stand_in_the_air_until_their_time_has_passed() -> None:
    world = make((crate((5.0, 0.0, 0.5)),), [(0.0, 0.0, 0.0), (9.0, 9.0, 0.0)])
    run(world, 50)
    up = from_euler(0.0, 0.0, 1.0)
    world.place_model(0, Pose((5.0, 5.0, 3.0), up), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), hold=100)
    world.place_vehicle(0, (2.0, 2.0, 3.0), up, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), hold=100)
    run(world, 95)
    assert world.bodies.by_number[0].pose == Pose((5.0, 5.0, 3.0), up)
    assert world.plant["position"][0].tolist() == [2.0, 2.0, 3.0]
    run(world, 60)
    assert world.bodies.by_number[0].pose.position[2] < 2.9
    assert world.plant["position"][0, 2] < 2.9
    world.close()


def test_a_held_vehicle_flies_when_it_is_armed() -> None:
    world = make((), [(0.0, 0.0, 0.0)])
    world.place_vehicle(0, (2.0, 2.0, 3.0), (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), hold=1000)
    run(world, 20)
    assert world.plant["contact"][0] == ASLEEP
    run(world, 20, armed=True)
    assert world.plant["position"][0, 2] < 3.0
    assert not world.has_obstacles
    world.close()


@pytest.mark.parametrize("duration", [0.25, 0.1234])
def test_a_wrench_gives_its_impulse_exactly(duration: float) -> None:
    """In free fall the velocity follows from force and time, the rates from torque and time."""
    world = make((crate((60.0, 0.0, 60.0)),), [(0.0, 0.0, 50.0)])
    run(world, 10)
    assert world.plant["contact"][0] == FREE
    m = world.models[0]
    vx, rate = float(world.plant["velocity"][0, 0]), float(world.plant["rates"][0, 2])
    begin = world.steps
    world.wrenches.add(Wrench(0, (3.0, 0.0, 0.0), (0.0, 0.0, 0.02), begin, begin + duration / DT))
    world.wrenches.add(Wrench(1, (4.0, 0.0, 0.0), (0.0, 0.1, 0.0), begin, begin + duration / DT))
    run(world, 80)
    drag = float(m["linear_drag"])
    assert drag == 0.0
    gained = float(world.plant["velocity"][0, 0]) - vx
    assert gained == pytest.approx(3.0 * duration / float(m["mass"]), rel=1e-9)
    assert float(world.plant["rates"][0, 2]) - rate == pytest.approx(0.02 * duration / float(m["inertia"][2]), rel=1e-6)
    body = world.bodies.by_number[0]
    assert body.velocity[0] == pytest.approx(4.0 * duration / 2.0, rel=1e-9)
    assert body.spin[1] == pytest.approx(0.1 * duration / (2.0 / 6.0), rel=1e-6)
    assert not world.wrenches
    world.close()


def test_a_wrench_wakes_what_sleeps() -> None:
    world = make((crate((5.0, 0.0, 0.5)),), [(0.0, 0.0, 0.0)])
    run(world, 600)
    assert world.plant["contact"][0] == ASLEEP
    assert not world.is_busy
    for target, weight in ((0, float(world.models[0]["mass"])), (1, 2.0)):
        world.wrenches.add(Wrench(target, (0.0, 0.0, 2.0 * weight * G), (0.0, 0.0, 0.0), world.steps, world.steps + 50))
    run(world, 50)
    assert world.plant["contact"][0] != ASLEEP
    assert world.plant["velocity"][0, 2] == pytest.approx(G * 50 * DT, rel=0.02)
    assert world.bodies.by_number[0].velocity[2] == pytest.approx(G * 50 * DT, rel=0.02)
    world.close()


def test_links_are_one_body_with_their_common_mass() -> None:
    """A dumbbell of two discs, rotated in its model, has the mass, centre and principal moments computed by hand."""
    part = Inertial(1.5, Pose(), (0.02, 0.02, 0.01, 0.0, 0.0, 0.0))
    turn = from_euler(0.0, 0.0, 0.6)
    links = tuple(
        SdfLink(f"l{side}", compose(Pose((1.0, 0.0, 0.0), turn), Pose((side, 0.0, 0.0))), inertial=part)
        for side in (-0.4, 0.4)
    )
    mass, frame, moments = mass_of(SdfModel("d", Pose(), False, links))
    assert mass == 3.0
    assert frame.position == pytest.approx((1.0, 0.0, 0.0))
    across = 0.02 + 2.0 * 1.5 * 0.4**2 + 0.02
    assert sorted(moments.tolist()) == pytest.approx(sorted([0.04, across, 0.02 + 3.0 * 0.4**2]))
    model = SdfModel(
        "d", Pose(), False, tuple(replace(link, collisions=(Collision(Cylinder(0.3, 0.1)),)) for link in links)
    )
    world = make((replace(model, pose=Pose((0.0, 30.0, 20.0))),), [(0.0, 0.0, 0.0)])
    world.wrenches.add(Wrench(1, (0.0, 0.0, 3.0 * G), (0.0, 0.0, 0.5), 0.0, 100.0))
    run(world, 100)
    body = world.bodies.by_number[0]
    assert body.spin[2] == pytest.approx(0.5 * 100 * DT / (0.02 + 3.0 * 0.4**2), rel=1e-6)
    assert body.centre == pytest.approx((1.0, 30.0, 20.0), abs=1e-6)
    world.close()


def test_a_teleported_vehicle_keeps_to_the_state_that_it_was_given() -> None:
    world = make((), [(0.0, 0.0, 0.0), (5.0, 0.0, 0.0)])
    run(world, 300)
    assert world.plant["contact"].tolist() == [ASLEEP, ASLEEP]
    q = from_euler(0.1, -0.2, 2.0)
    world.place_vehicle(1, (-3.0, 4.0, 30.0), q, (1.0, 2.0, 3.0), (0.1, 0.2, 0.3))
    assert world.plant["contact"].tolist() == [ASLEEP, TOUCHING]
    run(world, 100)
    assert world.plant["contact"].tolist() == [ASLEEP, FREE]
    t = 100 * DT
    x, y, z = world.plant["position"][1]
    assert (x, y) == pytest.approx((-3.0 + t, 4.0 + 2.0 * t), abs=1e-2)
    assert z == pytest.approx(30.0 + 3.0 * t - 0.5 * G * t * t, abs=0.05)
    world.close()


@pytest.mark.parametrize("models", [(), (crate((1.0, 40.0, 0.5)),)])
def test_free_flight_gives_the_bits_of_single_steps(models: tuple[SdfModel, ...]) -> None:
    """This holds with a model that rests and is pushed later, a wrench, and a teleport."""

    def fly(whole: bool) -> bytes:
        simulation = Simulation(parse_fleet("iris:2"), seed=3)
        model = replace(simulation.world.model, models=models)
        simulation._model = model
        simulation.restart()
        out = b""
        for part in range(1, 31):
            if part == 8:
                world = simulation.world
                world.place_vehicle(0, (0.0, 0.0, 30.0), (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
                world.place_vehicle(1, (9.0, 0.0, 30.0), (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
            if part == 12:
                begin = simulation.world.steps + 3.5
                simulation.world.wrenches.add(Wrench(1, (0.0, 1.0, 1.0), (0.01, 0.0, 0.0), begin, begin + 20.2))
            until = part * 100_000
            if whole:
                simulation.run_until(until)
            while simulation.time_us < until:
                simulation.step()
            out += simulation.world.plant.tobytes()
        simulation.close()
        return out

    assert fly(True) == fly(False)


class _Allocations(ctypes.Structure):
    """Result of glibc's mallinfo2, bytes."""

    _fields_ = [(name, ctypes.c_size_t) for name in (
        *("arena", "ordblks", "smblks", "hblks", "hblkhd", "usmblks", "fsmblks", "uordblks", "fordblks", "keepcost"),
    )]  # fmt: skip


def _allocated() -> int:
    """Return the bytes allocated by malloc; skip the test without glibc 2.33 or later."""
    libc = ctypes.CDLL(None)
    if not hasattr(libc, "mallinfo2"):
        pytest.skip("no mallinfo2")
    libc.mallinfo2.restype = _Allocations
    gc.collect()
    found = libc.mallinfo2()
    return int(found.uordblks + found.hblkhd)


def test_models_added_and_deleted_again_share_their_shapes() -> None:
    """Bullet keeps shapes until it is disconnected: 30 kB for the 16 boxes of this model."""
    world = World(load_world("empty"), [load_vehicle("iris")], [StartPose(0.0, 0.0)], DT)
    box = "<geometry><box><size>1 1 1</size></box></geometry>"
    boxes = "".join(f'<collision name="c{k}"><pose>{k} 0 0 0 0 0</pose>{box}</collision>' for k in range(16))
    model = read_model(f'<sdf version="1.6"><model name="m"><link name="l">{boxes}</link></model></sdf>', "m")
    for number in range(300):
        if number == 100:
            before = _allocated()
        world.add_model(number, model, Pose((20.0, 0.0, 5.0)))
        world.remove_model(number)
    assert (_allocated() - before) / 200 < 15_000
    world.close()
