"""A boat and its waves against closed form: draught, heave, orbits, speed; and on deck."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from xtdrone_common.fleet import StartPose
from xtdrone_common.poses import Pose
from xtdrone_common.rotation import from_euler, to_euler
from xtdrone_sim.physics.world import World
from xtdrone_sim.robots.boat_dynamics import Boat, water_at
from xtdrone_sim.robots.wheel_drives import drive_of
from xtdrone_sim.vehicles.vehicle_model import load_vehicle
from xtdrone_worlds.descriptions import ModelError
from xtdrone_worlds.worlds.catalogue import load_world
from xtdrone_worlds.worlds.robots.robot_model import BoatModel, load_robot
from xtdrone_worlds.worlds.robots.robot_settings import DENSITY, GRAVITY, BoatLimits, HullSettings, WaveSettings
from xtdrone_worlds.worlds.robots.robot_urdf import urdf_of

DT = 0.004
FREE = BoatLimits(
    linear_drag=(0, 0, 0), quadratic_drag=(0, 0, 0), turning_drag=(0, 0, 0), added_mass=(0, 0, 0), timeout=0.0
)


def sail(boat: Boat, seconds: float) -> np.ndarray:
    """Return the positions (n, 3), m, of a boat after each step."""
    places = []
    for _ in range(round(seconds / DT)):
        boat.propose(DT)
        boat.accept()
        places.append(boat.state.pose.position)
    return np.array(places)


# waves


def test_waves_obey_the_dispersion_of_deep_water_and_their_own_derivatives() -> None:
    settings = WaveSettings(amplitude=0.2, period=4.0, count=12, direction=0.7, seed=5)
    waves = settings.waves
    numbers = np.hypot(waves["kx"], waves["ky"])
    np.testing.assert_allclose(waves["frequency"] ** 2, GRAVITY * numbers, rtol=1e-12)
    assert np.sqrt(np.sum(waves["amplitude"] ** 2)) == pytest.approx(0.2)
    assert waves["frequency"].min() >= math.tau / (4.0 * 1.3)
    directions = np.arctan2(waves["ky"], waves["kx"])
    assert np.abs(directions - 0.7).max() <= 0.3
    x, y, t, h = 3.0, -2.0, 1.7, 1e-5
    w, ax, ay, az = water_at(waves, x, y, t)[3:]
    after, before = water_at(waves, x, y, t + h), water_at(waves, x, y, t - h)
    assert w == pytest.approx((after[0] - before[0]) / (2 * h), rel=1e-6)  # the surface moves with the water
    assert (ax, ay, az) == pytest.approx([(after[k] - before[k]) / (2 * h) for k in (1, 2, 3)], rel=1e-6)
    slopes = [
        (water_at(waves, x + dx, y + dy, t)[0] - water_at(waves, x - dx, y - dy, t)[0]) / (2 * h)
        for dx, dy in ((h, 0.0), (0.0, h))
    ]
    assert (ax, ay) == pytest.approx([-GRAVITY * slope for slope in slopes], rel=1e-6)


def test_a_single_wave_is_regular_and_a_seed_makes_the_sea() -> None:
    waves = WaveSettings(amplitude=0.2, period=4.0, direction=math.pi / 2).waves
    heights = [water_at(waves, 50.0, 0.0, t)[0] for t in (0.0, 1.0, 2.0, 4.0)]
    assert heights == pytest.approx([0.2, 0.0, -0.2, 0.2], abs=1e-9)  # crests along x
    seas = [WaveSettings(amplitude=0.2, count=5, seed=seed).waves.tobytes() for seed in (1, 1, 2)]
    assert seas[0] == seas[1] != seas[2]


# the hull


@pytest.mark.parametrize("mass", [300.0, 800.0, 2000.0])
def test_a_boat_floats_at_the_draught_of_its_weight(mass: float) -> None:
    hull = HullSettings(mass=mass)
    assert hull.draught == pytest.approx(mass / (DENSITY * 3.0 * 1.6))
    boat = Boat(hull, BoatLimits(), WaveSettings(level=2.0), Pose((1.0, 2.0, 0.0)))
    boat._record["position"][0, 2] += 0.1
    sail(boat, 20.0)
    assert boat.state.pose.position == pytest.approx((1.0, 2.0, 2.0), abs=1e-3)
    assert boat.is_still


@pytest.mark.parametrize("added", [0.0, 1.0])
def test_heave_in_still_water_has_the_period_of_a_box(added: float) -> None:
    """T = 2 pi sqrt((1 + c) draught / g): the stiffness is density times g times the area."""
    hull = HullSettings()
    limits = BoatLimits(**{**FREE.__dict__, "added_mass": (0.0, 0.0, added)})
    boat = Boat(hull, limits, WaveSettings())
    boat._record["position"][0, 2] = 0.004
    heights = sail(boat, 10.0)[:, 2]
    down = np.flatnonzero((heights[:-1] > 0.0) & (heights[1:] <= 0.0))
    period = float(np.diff(down).mean()) * DT
    assert period == pytest.approx(math.tau * math.sqrt((1.0 + added) * hull.draught / GRAVITY), rel=0.01)
    assert np.abs(heights).max() == pytest.approx(0.004, rel=0.03)


def test_roll_has_the_period_of_its_metacentric_height() -> None:
    """I phi'' = -m g GM phi, GM = draught / 2 + width^2 / (12 draught) - draught, for a finite number of columns."""
    hull = HullSettings()
    boat = Boat(hull, FREE, WaveSettings())
    boat._record["q"][0] = from_euler(0.02, 0.0, 0.0)
    angles = []
    for _ in range(2500):
        sail(boat, DT)
        angles.append(to_euler(boat.state.pose.orientation)[0])
    rolled = np.array(angles)
    down = np.flatnonzero((rolled[:-1] > 0.0) & (rolled[1:] <= 0.0))
    width2 = hull.width**2 * (1.0 - 1.0 / 25.0)  # second moment of five strips
    height = -0.5 * hull.draught + width2 / (12.0 * hull.draught)
    inertia = (hull.width**2 + hull.depth**2) / 12.0
    expected = math.tau * math.sqrt(inertia / (GRAVITY * height))
    assert float(np.diff(down).mean()) * DT == pytest.approx(expected, rel=0.02)


@pytest.mark.parametrize("direction", [0.0, 2.0])
def test_a_small_body_follows_the_orbit_of_the_water(direction: float) -> None:
    """Once a period, it moves on a circle of the wave's amplitude in the wave's plane, but for second-order drift."""
    amplitude, period = 0.2, 4.0
    hull = HullSettings(length=0.3, width=0.3, depth=0.1, mass=4.5)
    limits = BoatLimits(
        linear_drag=(20, 20, 60),
        quadratic_drag=(0, 0, 0),
        turning_drag=(2, 2, 2),
        added_mass=(0.5, 0.5, 1.0),
        timeout=0,
    )
    boat = Boat(hull, limits, WaveSettings(amplitude=amplitude, period=period, direction=direction))
    sail(boat, 5.0 * period)
    places = sail(boat, 10.0 * period)
    along = places[:, :2] @ (math.cos(direction), math.sin(direction))
    across = places[:, :2] @ (-math.sin(direction), math.cos(direction))
    steps = np.arange(len(along)) * DT
    drift = np.polyfit(steps, along, 1)
    assert np.sqrt(2.0) * np.std(along - np.polyval(drift, steps)) == pytest.approx(amplitude, rel=0.05)
    assert np.sqrt(2.0) * np.std(places[:, 2]) == pytest.approx(amplitude, rel=0.03)
    stokes = math.tau / period * (math.tau / period) ** 2 / GRAVITY * amplitude**2
    assert 0.0 < drift[0] < 1.5 * stokes
    assert np.abs(across).max() < 0.01


def test_terminal_speed_is_that_of_thrust_and_drag() -> None:
    """With both thrusters at their limit, 2 F = a v + b v^2."""
    limits = BoatLimits(
        thrust=100.0, speed=50.0, linear_drag=(40, 400, 2000), quadratic_drag=(30, 600, 1000), timeout=0
    )
    boat = Boat(HullSettings(), limits, WaveSettings())
    boat.command(50.0, 0.0)
    sail(boat, 60.0)
    expected = (-40.0 + math.sqrt(40.0**2 + 4.0 * 30.0 * 200.0)) / 60.0
    assert boat.twist[0][0] == pytest.approx(expected, rel=1e-3)


def test_commands_are_followed_and_end() -> None:
    boat = Boat(HullSettings(), BoatLimits(timeout=0.0), WaveSettings())
    for speed, rate, off in ((1.5, 0.0, 1e-3), (0.0, 0.2, 1e-3), (1.5, 0.2, 0.15)):  # it slips in a curve
        boat.command(speed, rate)
        sail(boat, 20.0)
        velocity, rates = boat.twist
        assert (velocity[0], rates[2]) == pytest.approx((speed, rate), abs=off)
    with pytest.raises(ValueError, match=r"linear\.x: nan is not allowed, a finite number"):
        boat.command(math.nan, 0.0)
    other = Boat(HullSettings(), BoatLimits(timeout=0.1, linear_drag=(400, 400, 2000)), WaveSettings())
    other.command(1.5, 0.2)
    sail(other, 0.2)
    assert other.thrusts() == (0.0, 0.0)
    assert not other.is_still
    sail(other, 20.0)
    assert other.is_still


# in the world


def test_a_vehicle_stays_on_deck_in_waves() -> None:
    model = load_robot("boat")
    assert isinstance(model, BoatModel)
    assert model.platform is not None
    start = StartPose(0.1, -0.1, model.platform.height + 0.1)
    world = World(load_world("empty"), [load_vehicle("iris")], [start], DT)
    boat, alone = drive_of(model, Pose()), drive_of(model, Pose())
    world.add_model(0, model.model("boat_0", Pose()), Pose(), boat)
    assert world.overlaps(0) == []  # the hull extends below the plane z = 0
    for _ in range(round(8.0 / DT)):
        boat.command(1.0, 0.1)
        alone.command(1.0, 0.1)
        world.step(np.zeros((1, 8)), np.zeros(1, np.int32))
        alone.propose(DT)
        alone.accept()
    assert boat.state == alone.state  # to the last bit
    place, vehicle = boat.state.pose, world.plant[0]["position"]
    assert math.hypot(*place.position[:2]) > 3.0
    offset = vehicle - place.position
    assert math.hypot(*offset[:2]) < 0.4
    assert offset[2] == pytest.approx(model.platform.height + 0.055, abs=0.05)


def test_the_description_has_hull_and_platform() -> None:
    model = load_robot("boat")
    text = urdf_of("boat_0", model)
    assert "platform_joint" in text
    assert "wheel" not in text


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("hull: {mass: 9000}", "mass: 9000.0 is not allowed, at most 2736 kg: its box displaces 2880 kg"),
        ("hull: {width: 0.3, depth: 2.0, mass: 500}", "width: 0.3 is not allowed, more than"),
        ("hull: {length: 0.3, depth: 2.0, mass: 150}", "length: 0.3 is not allowed, more than"),
        ("hull: {mass: 0.5}", "hull mass: 0.5 is not allowed, at least 0.753 kg"),
        ("limits: {linear_drag: [0, 0, 1000000]}", "limits linear_drag and quadratic_drag: [120.0, 1800.0, 1003000.0]"),
        ("limits: {turning_drag: [0, 0, 1000000]}", "limits turning_drag: [0.0, 0.0, 1000000.0] is not allowed, at"),
        ("waves: {amplitude: 2, period: 2}", "amplitude: 2.0 is not allowed, at most 0.248 m"),
        ("waves: {amplitude: .nan}", "amplitude: nan is not allowed, 0 to 10 m"),
        ("limits: {thrust: -1}", "limits thrust: -1 is not allowed, 0 to 1000000 N"),
        ("platform: {height: 0.2}", "platform height: 0.2 is not allowed, at least hull and plate"),
        ("body: {length: 2}", "field 'body' is not known; there are drive, limits, hull, waves, platform"),
    ],
)
def test_a_wrong_boat_is_named(text: str, words: str, tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text(f"drive: boat\n{text}\n")
    with pytest.raises(ModelError) as caught:
        load_robot(str(path))
    assert words in str(caught.value)
