"""Joints between models: parsing, and motion against the equations of a pendulum, an incline and limits."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from xtdrone_common.fleet import StartPose
from xtdrone_sim.physics.world import World
from xtdrone_sim.vehicles.vehicle_model import load_vehicle
from xtdrone_worlds.worlds.sdf import SdfWorld, read_world, write_world

FILE = Path("joints.world")
G = 9.8
DT = 0.004

ROD = """
<link name='{name}'><pose>{pose}</pose>
  <inertial><mass>2</mass><inertia><ixx>0.01</ixx><iyy>0.06</iyy><izz>0.06</izz></inertia></inertial>
  <collision name='c'><geometry><box><size>0.6 0.05 0.05</size></box></geometry></collision>
</link>"""


def sdf(inside: str) -> SdfWorld:
    text = f"<sdf version='1.7'><world name='w'><gravity>0 0 -{G}</gravity>{inside}</world></sdf>"
    return read_world(text, FILE)


def joint(kind: str, inside: str = "<axis><xyz>0 1 0</xyz></axis>", parent: str = "world", child: str = "rod") -> str:
    ends = f"<parent>{parent}</parent><child>{child}</child>"
    return f"<joint name='j' type='{kind}'>{ends}<pose>-0.3 0 0 0 0 0</pose>{inside}</joint>"


def model(inside: str, pose: str = "0 0 5 0 0 0") -> SdfWorld:
    return sdf(f"<model name='m'><pose>{pose}</pose>{ROD.format(name='rod', pose='0.3 0 0 0 0 0')}{inside}</model>")


def simulation(read: SdfWorld) -> World:
    values = replace(read, wind=(0.0, 0.0, 0.0), friction=1.0, restitution=0.0)
    return World(values, [load_vehicle("iris")], [StartPose(50.0, 0.0)], DT)


def run(world: World, seconds: float) -> None:
    for _ in range(round(seconds / DT)):
        world.step(np.zeros((1, 8)), np.zeros(1, np.int32))


def test_a_hinge_swings_with_the_period_of_a_physical_pendulum() -> None:
    """T = 2 pi sqrt(I / (m g l)) for small angles about the hanging position."""
    world = simulation(model(joint("revolute"), "0 0 5 0 1.5 0"))  # 0.07 rad from the hanging position
    hinge = world.joints["m::j"]
    middle, crossings = math.pi / 2 - 1.5, []
    last = hinge.position - middle
    for step in range(2500):
        run(world, DT)
        now = hinge.position - middle
        if last < 0.0 <= now:
            crossings.append(step + last / (last - now))
        last = now
    period = 2.0 * math.pi * math.sqrt((0.06 + 2.0 * 0.3**2) / (2.0 * G * 0.3))
    assert np.diff(crossings).mean() * DT == pytest.approx(period, rel=3e-3)
    assert np.ptp(np.diff(crossings)) * DT < 3e-3
    tip = world.bodies.by_number[0].pose.position
    assert np.linalg.norm(np.subtract(tip, (0.0, 0.0, 5.0))) < 2e-3  # the axis stays in place


def test_a_slide_falls_along_its_axis() -> None:
    tilted = "<axis><xyz>0.6 0 -0.8</xyz></axis>"
    world = simulation(model(joint("prismatic", tilted)))
    run(world, 0.5)
    slide = world.joints["m::j"]
    assert slide.rate == pytest.approx(0.8 * G * 0.5, rel=0.01)
    assert slide.position == pytest.approx(0.5 * 0.8 * G * 0.25, rel=0.02)
    x, y, z = np.subtract(world.bodies.by_number[0].pose.position, (0.0, 0.0, 5.0))
    assert [y, 0.8 * x + 0.6 * z] == pytest.approx([0.0, 0.0], abs=2e-3)


@pytest.mark.parametrize(("kind", "axis", "limit"), [("revolute", "0 1 0", 0.4), ("prismatic", "0 0 -1", 0.25)])
def test_limits_stop_without_a_rebound_and_hold_the_weight(kind: str, axis: str, limit: float) -> None:
    world = simulation(model(joint(kind, f"<axis><xyz>{axis}</xyz><limit><upper>{limit}</upper></limit></axis>")))
    run(world, 1.5)
    one = world.joints["m::j"]
    assert one.position == pytest.approx(limit, abs=2e-3)
    assert abs(one.rate) < 1e-3
    run(world, 4.0)
    assert not world.bodies.awake
    assert one.position == pytest.approx(limit, abs=2e-3)


def test_damping_brings_a_falling_slide_to_its_final_speed_and_friction_holds_it() -> None:
    """The final speed is that of m g = d v; friction above m g holds the slide."""
    loose = "<axis><xyz>0 0 -1</xyz><dynamics><damping>40</damping></dynamics></axis>"
    world = simulation(model(joint("prismatic", loose)))
    run(world, 0.6)
    assert world.joints["m::j"].rate == pytest.approx(2.0 * G / 40.0, rel=0.01)
    tight = "<axis><xyz>0 0 -1</xyz><dynamics><friction>25</friction></dynamics></axis>"
    world = simulation(model(joint("prismatic", tight)))
    run(world, 2.0)
    assert abs(world.joints["m::j"].position) < 2e-3


@pytest.mark.parametrize("kind", ["revolute", "ball", "prismatic"])
def test_free_bodies_keep_momentum_and_energy_falls(kind: str) -> None:
    """Without gravity, two joined bodies keep the sum of their momenta after a blow."""
    first = ROD.format(name="a", pose="0 0 0 0 0 0").replace("</link>", "<gravity>0</gravity></link>")
    second = ROD.format(name="b", pose="0.7 0 0 0 0 0").replace("</link>", "<gravity>0</gravity></link>")
    axis = "<axis><xyz>0 1 0</xyz><limit><lower>-0.2</lower><upper>0.2</upper></limit></axis>"
    inside = joint(kind, "" if kind == "ball" else axis, "a", "b")
    world = simulation(sdf(f"<model name='m'><pose>0 0 5 0 0 0</pose>{first}{second}{inside}</model>"))
    assert [one.name for one in world.model.models] == ["m", "m::b"]
    world.bodies.place(1, world.bodies.by_number[1].pose, (0.0, 0.4, 0.6), (0.0, 0.5, 0.0))
    energies = []
    for _ in range(100):
        run(world, 0.02)
        bodies = [world.bodies.by_number[k] for k in (0, 1)]
        speeds = [np.array(body.velocity) for body in bodies]  # mass centres are the origins
        np.testing.assert_allclose(sum(speeds), (0.0, 0.4, 0.6), atol=2e-3)
        energies.append(sum(float(v @ v) for v in speeds))
    assert max(energies) < 2.0  # at the start m v^2 / 2 is 0.52 and the spin has 0.03, in the same unit
    if kind != "prismatic":
        ends = [np.array(bodies[0].pose.position), np.array(bodies[1].pose.position)]
        assert 0.3 < np.linalg.norm(ends[1] - ends[0]) < 0.71


def test_a_joined_model_is_divided_and_written_and_read_again() -> None:
    links = ROD.format(name="rod", pose="0.3 0 0 0 0 0.5") + ROD.format(name="tip", pose="0.9 0 0 0 0 0")
    fixed = "<joint name='f' type='fixed'><parent>rod</parent><child>tip</child></joint>"
    post = ROD.format(name="post", pose="-0.4 0 0 0 0 0")
    limited = "<axis><xyz>0 1 0</xyz><limit><lower>-1</lower><upper>2</upper></limit></axis>"
    text = f"<model name='m'><pose>1 2 5 0 0 1</pose>{post}{links}{fixed}{joint('revolute', limited, 'post')}</model>"
    read = sdf(text)
    assert [(one.name, [link.name for link in one.links]) for one in read.models] == [
        ("m", ["post"]),
        ("m::rod", ["rod", "tip"]),
    ]
    (one,) = read.joints
    assert (one.name, one.parent, one.child, one.lower, one.upper) == ("m::j", "m", "m::rod", -1.0, 2.0)
    assert one.axis == pytest.approx((-math.sin(1.5), math.cos(1.5), 0.0))
    again = read_world(write_world(read), FILE)
    assert (again.joints, [one.pose for one in again.models]) == (read.joints, [one.pose for one in read.models])


def test_a_link_fixed_to_the_world_stands() -> None:
    fixed = "<joint name='f' type='fixed'><parent>world</parent><child>rod</child></joint>"
    (one,) = model(fixed).models
    assert one.static


@pytest.mark.parametrize(
    ("inside", "words"),
    [
        (joint("revolute", ""), "<joint>: needs a <axis>"),
        (joint("revolute", "<axis><xyz>0 0 0</xyz></axis>"), "0 0 0 is not allowed as an axis"),
        (joint("prismatic", "<axis><limit><lower>2</lower><upper>1</upper></limit></axis>"), "lower 2 is not allowed"),
        (joint("revolute", "<axis><dynamics><damping>-1</damping></dynamics></axis>"), "-1"),
        (joint("revolute", "<axis><limit><lower>nan</lower></limit></axis>"), "nan"),
    ],
)
def test_invalid_joints_are_rejected(inside: str, words: str) -> None:
    with pytest.raises(Exception, match="line 5") as caught:
        model(inside)
    assert words in str(caught.value)
