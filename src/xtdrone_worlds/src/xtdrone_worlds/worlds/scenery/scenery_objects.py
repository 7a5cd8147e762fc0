"""The individual objects of a scene: their visuals, collisions and the space that they need.

Each function returns an object that stands on z = 0 of its frame.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from xtdrone_common.poses import Pose
from xtdrone_common.rotation import from_euler
from xtdrone_worlds.shapes.visual import Box, Collision, Colour, Cylinder, Geometry, Mesh, Sphere, Visual
from xtdrone_worlds.worlds.scenery import assets
from xtdrone_worlds.worlds.scenery.materials import Kit

HIGHEST = 8.5  # m, maximum height of all objects: vehicles that search for people fly above them


@dataclass(frozen=True)
class Thing:
    """An object of a scene.

    Attributes:
        visuals: visible shapes.
        collisions: collision shapes.
        radius: radius of the circle that it occupies on the ground, m.
    """

    visuals: tuple[Visual, ...]
    collisions: tuple[Collision, ...]
    radius: float


def _at(x: float, y: float, z: float, roll: float = 0.0, pitch: float = 0.0, yaw: float = 0.0) -> Pose:
    return Pose((round(x, 4), round(y, 4), round(z, 4)), from_euler(roll, pitch, yaw))


def _solid(radius: float, *visuals: Visual) -> Thing:
    """Return an object whose collision shapes equal its visuals."""
    return Thing(visuals, tuple(Collision(v.geometry, v.pose) for v in visuals), radius)


def _upright(geometry: Geometry, height: float, colour: Colour, z: float = 0.0) -> Visual:
    return Visual(geometry, _at(0.0, 0.0, z + 0.5 * height), colour)


def _cylinder(radius: float, height: float, colour: Colour, z: float = 0.0) -> Visual:
    return _upright(Cylinder(round(radius, 3), round(height, 3)), height, colour, z)


# plants


def leafy_tree(kit: Kit) -> Thing:
    """Return a tree with a round, broad or slender crown."""
    radius = kit.uniform(1.2, 3.2)
    half = radius * kit.uniform(0.75, 1.5)
    trunk = kit.uniform(1.2, 2.6)
    half = round(min(half, (HIGHEST - trunk) / 1.85), 3)
    thick = round(0.07 * radius + kit.uniform(0.03, 0.1), 3)
    top = Visual(
        Mesh(kit.mesh("crown"), (radius, radius, half)),
        _at(0, 0, trunk + 0.85 * half),
        kit.green(),
        kit.texture("leaves"),
    )
    stem = _cylinder(thick, trunk + 0.4 * half, kit.brown())
    body = Collision(Sphere(round(0.8 * min(radius, half), 3)), top.pose)
    return Thing((stem, top), (Collision(stem.geometry, stem.pose), body), radius)


def conifer(kit: Kit) -> Thing:
    """Return a spruce."""
    radius, height, foot = kit.uniform(1.0, 2.2), kit.uniform(4.0, HIGHEST - 1.0), kit.uniform(0.3, 1.0)
    stem = _cylinder(kit.uniform(0.1, 0.2), foot + 0.3 * height, kit.brown())
    top = Visual(
        Mesh(kit.mesh("conifer"), (radius, radius, height)),
        _at(0, 0, foot),
        kit.hsv((0.25, 0.45), (0.35, 0.7), (0.22, 0.45)),
        kit.texture("leaves"),
    )
    body = Collision(Mesh(assets.mesh("cone"), (round(0.8 * radius, 3), round(0.8 * radius, 3), height)), top.pose)
    return Thing((stem, top), (Collision(stem.geometry, stem.pose), body), radius)


def bush(kit: Kit) -> Thing:
    """Return a bush."""
    radius = kit.uniform(0.35, 1.2)
    half = round(radius * kit.uniform(0.6, 1.1), 3)
    top = Visual(
        Mesh(kit.mesh("bush"), (radius, radius, half)), _at(0, 0, 0.75 * half), kit.green(), kit.texture("leaves")
    )
    return Thing((top,), (Collision(Sphere(round(0.7 * min(radius, half), 3)), top.pose),), radius)


def stump(kit: Kit) -> Thing:
    """Return a tree stump."""
    radius, height = kit.uniform(0.18, 0.4), kit.uniform(0.3, 1.3)
    cut = kit.hsv((0.06, 0.12), (0.25, 0.5), (0.6, 0.85))
    return _solid(radius, _cylinder(radius, height, kit.brown()), _cylinder(0.93 * radius, 0.02, cut, height))


# buildings


def house(kit: Kit) -> Thing:
    """Return a house: walls, roof, door, windows, possibly a chimney."""
    deep, wide, high = kit.uniform(5.0, 8.0), kit.uniform(6.0, 11.0), kit.uniform(2.6, 5.2)
    rise = kit.uniform(1.2, 2.8)
    if kit.rng.uniform() < 0.4:
        walls, wall_texture = kit.hsv((0.0, 1.0), (0.0, 0.08), (0.75, 1.0)), kit.texture("bricks")
    else:
        walls, wall_texture = kit.hsv((0.02, 0.62), (0.05, 0.35), (0.7, 0.97)), kit.texture("wall")
    tiles = kit.hsv((-0.06, 0.09), (0.1, 0.75), (0.3, 0.75))
    trim = kit.any_colour()
    roof = Mesh(kit.mesh("gable" if kit.rng.uniform() < 0.7 else "hip"), (deep + 0.8, wide + 0.8, rise))
    body = Visual(Box((deep, wide, high)), _at(0, 0, 0.5 * high), walls, wall_texture)
    top = Visual(roof, _at(0, 0, high), tiles, kit.texture("roof"))
    visuals = [body, top, Visual(Box((0.06, 1.0, 2.0)), _at(0.5 * deep + 0.02, kit.uniform(-1.0, 1.0), 1.0), trim)]
    visuals += _windows(deep, wide, high)
    shapes = [Collision(v.geometry, v.pose) for v in (body, top)]
    if kit.rng.uniform() < 0.6:
        x, y = 0.2 * deep, kit.uniform(-0.3, 0.3) * wide
        chimney = Visual(
            Box((0.6, 0.6, 1.6)), _at(x, y, high + 0.6 * rise + 0.4), kit.hsv((0, 0.05), (0.2, 0.6), (0.3, 0.6))
        )
        visuals.append(chimney)
        shapes.append(Collision(chimney.geometry, chimney.pose))
    return Thing(tuple(visuals), tuple(shapes), round(0.5 * math.hypot(deep + 0.8, wide + 0.8), 3))


def _windows(deep: float, wide: float, high: float) -> list[Visual]:
    glass = (0.16, 0.2, 0.25, 1.0)
    windows = []
    for z in (1.5, 4.0):
        if z + 0.8 > high:
            break
        for side in (-1.0, 1.0):
            windows += [
                Visual(Box((1.1, 0.05, 1.1)), _at(x * deep, side * (0.5 * wide + 0.01), z), glass)
                for x in (-0.25, 0.25)
            ]
            windows += [
                Visual(Box((0.05, 1.1, 1.1)), _at(side * (0.5 * deep + 0.01), y * wide, z), glass)
                for y in (-0.33, 0.33)
            ]
    return windows


def shed(kit: Kit) -> Thing:
    """Return a wooden hut."""
    deep, wide, high = kit.uniform(2.0, 3.5), kit.uniform(2.0, 4.5), kit.uniform(1.9, 2.4)
    rise = kit.uniform(0.4, 1.2)
    body = Visual(Box((deep, wide, high)), _at(0, 0, 0.5 * high), kit.brown(), kit.texture("wood"))
    top = Visual(
        Mesh(kit.mesh("gable"), (deep + 0.4, wide + 0.4, rise)), _at(0, 0, high), kit.grey(), kit.texture("roof")
    )
    return _solid(round(0.5 * math.hypot(deep + 0.4, wide + 0.4), 3), body, top)


# vehicles and street


def car(kit: Kit) -> Thing:
    """Return a car, its front towards x."""
    name = assets.CARS[int(kit.rng.integers(len(assets.CARS)))]
    body = Visual(Mesh(kit.mesh(f"car_{name}_body")), Pose(), kit.any_colour())
    glass = Visual(Mesh(kit.mesh(f"car_{name}_glass")), Pose(), (0.1, 0.12, 0.15, 1.0))
    wheels = Visual(Mesh(kit.mesh(f"car_{name}_wheels")), Pose(), (0.06, 0.06, 0.06, 1.0))
    return Thing((body, glass, wheels), (Collision(body.geometry), Collision(glass.geometry)), 2.7)


def pole(kit: Kit) -> Thing:
    """Return a lamp post or a power pole."""
    height = kit.uniform(3.5, 7.0)
    colour = kit.brown() if kit.rng.uniform() < 0.5 else kit.grey()
    arm = Visual(Box((0.9, 0.1, 0.1)), _at(0.35, 0, height - 0.1), colour)
    return _solid(0.3, _cylinder(kit.uniform(0.06, 0.14), height, colour), arm)


def sign(kit: Kit) -> Thing:
    """Return a traffic sign: round, square or triangular."""
    height = kit.uniform(1.9, 2.5)
    post = _cylinder(0.035, height, kit.grey())
    form = int(kit.rng.integers(3))
    lean = 0.5 * math.pi
    if form == 0:
        plate = Visual(Cylinder(0.32, 0.03), _at(0.05, 0, height, 0.0, lean), kit.any_colour())
    elif form == 1:
        plate = Visual(Box((0.03, 0.6, 0.6)), _at(0.05, 0, height), kit.any_colour())
    else:
        triangle = Mesh(assets.mesh("triangle"), (0.75, 0.03, 0.75))
        plate = Visual(triangle, _at(0.05, 0, height - 0.35, 0.0, 0.0, lean), kit.any_colour())
    return _solid(0.4, post, plate)


def hydrant(kit: Kit) -> Thing:
    """Return a fire hydrant."""
    colour = kit.hsv((-0.05, 0.18), (0.6, 0.95), (0.5, 0.9))
    arms = Visual(Cylinder(0.07, 0.45), _at(0, 0, 0.5, 0.5 * math.pi), colour)
    return _solid(0.25, _cylinder(0.14, 0.7, colour), Visual(Sphere(0.15), _at(0, 0, 0.7), colour), arms)


def bin_(kit: Kit) -> Thing:
    """Return a dustbin."""
    high = kit.uniform(0.8, 1.3)
    body = Visual(Box((0.6, 0.55, high)), _at(0, 0, 0.5 * high), kit.any_colour())
    lid = Visual(Box((0.66, 0.6, 0.07)), _at(0, 0, high + 0.03), kit.any_colour())
    return _solid(0.45, body, lid)


def bench(kit: Kit) -> Thing:
    """Return a bench."""
    colour = kit.brown()
    seat = Visual(Box((0.45, 1.8, 0.07)), _at(0, 0, 0.45), colour)
    back = Visual(Box((0.06, 1.8, 0.4)), _at(-0.22, 0, 0.7), colour)
    legs = [Visual(Box((0.4, 0.08, 0.42)), _at(0, y, 0.21), kit.grey()) for y in (-0.75, 0.75)]
    return _solid(0.95, seat, back, *legs)


def cone(kit: Kit) -> Thing:
    """Return a traffic cone."""
    colour = kit.hsv((0.0, 0.12), (0.7, 0.95), (0.7, 0.95))
    body = Visual(Mesh(assets.mesh("cone"), (0.17, 0.17, 0.75)), _at(0, 0, 0.03), colour)
    return _solid(0.25, body, Visual(Box((0.4, 0.4, 0.04)), _at(0, 0, 0.02), kit.grey()))


def fence(kit: Kit) -> Thing:
    """Return a 4 m section of fence along x."""
    colour = kit.brown() if kit.rng.uniform() < 0.7 else kit.grey()
    high = kit.uniform(0.9, 1.4)
    posts = [Visual(Box((0.1, 0.1, high)), _at(x, 0, 0.5 * high), colour) for x in (-1.95, 0.0, 1.95)]
    rails = [Visual(Box((4.0, 0.04, 0.12)), _at(0, 0, z * high), colour) for z in (0.45, 0.85)]
    return _solid(2.05, *posts, *rails)


# fields and yards


def rock(kit: Kit) -> Thing:
    """Return a boulder."""
    x, y, z = (kit.uniform(0.3, 1.1) for _ in range(3))
    body = Visual(Mesh(kit.mesh("rock"), (x, y, z)), _at(0, 0, 0.5 * z), kit.grey(), kit.texture("stone"))
    return _solid(max(x, y), body)


def hay_bale(kit: Kit) -> Thing:
    """Return a round or square bale of hay."""
    colour = kit.hsv((0.09, 0.15), (0.05, 0.3), (0.85, 1.0))
    if kit.rng.uniform() < 0.6:
        radius = kit.uniform(0.55, 0.8)
        pose = _at(0, 0, radius, 0.5 * math.pi)
        return _solid(1.0, Visual(Cylinder(radius, 1.2), pose, colour, kit.texture("hay")))
    return _solid(0.8, Visual(Box((1.2, 0.8, 0.8)), _at(0, 0, 0.4), colour, kit.texture("hay")))


def crate(kit: Kit) -> Thing:
    """Return one crate, or one on another."""
    size = kit.uniform(0.5, 1.3)
    low = Visual(Box((size, size, size)), _at(0, 0, 0.5 * size), kit.brown(), kit.texture("wood"))
    if kit.rng.uniform() < 0.6:
        return _solid(round(0.71 * size, 3), low)
    high = Visual(
        Box((0.8 * size, 0.8 * size, 0.7 * size)), _at(0, 0, 1.35 * size), kit.any_colour(), kit.texture("wood")
    )
    return _solid(round(0.71 * size, 3), low, high)


def barrel(kit: Kit) -> Thing:
    """Return a barrel or a stack of two."""
    radius, high = kit.uniform(0.25, 0.35), kit.uniform(0.75, 1.0)
    low = _cylinder(radius, high, kit.any_colour())
    if kit.rng.uniform() < 0.6:
        return _solid(radius, low)
    return _solid(radius, low, _cylinder(radius, high, kit.any_colour(), high))


def animal(kit: Kit) -> Thing:
    """Return a sheep or a cow, its head towards x."""
    size = 1.0 if kit.rng.uniform() < 0.6 else kit.uniform(1.6, 1.9)
    coat = kit.hsv((0.04, 0.12), (0.0, 0.5), (0.15, 0.95))
    head = kit.hsv((0.04, 0.12), (0.0, 0.5), (0.1, 0.8))
    body = Visual(Box((1.0 * size, 0.42 * size, 0.45 * size)), _at(0, 0, 0.62 * size), coat)
    face = Visual(Box((0.32 * size, 0.2 * size, 0.22 * size)), _at(0.62 * size, 0, 0.8 * size), head)
    legs = [
        Visual(Box((0.1 * size, 0.1 * size, 0.42 * size)), _at(x * size, y * size, 0.21 * size), head)
        for x in (-0.4, 0.4)
        for y in (-0.14, 0.14)
    ]
    return _solid(round(0.85 * size, 3), body, face, *legs)


# of a person's size, but not a person


def post(kit: Kit) -> Thing:
    """Return a painted post of a person's height, with or without a knob of another colour."""
    radius, height = kit.uniform(0.12, 0.26), kit.uniform(1.2, 1.7)
    body = _cylinder(radius, height, kit.any_colour())
    if kit.rng.uniform() < 0.4:
        return _solid(radius, body)
    knob = Visual(Sphere(kit.uniform(0.1, 0.16)), _at(0, 0, height + 0.05), kit.any_colour())
    return _solid(radius, body, knob)


def scarecrow(kit: Kit) -> Thing:
    """Return a wooden cross with a sack on it."""
    wood = kit.brown()
    mast, arm = (
        Visual(Box((0.08, 0.08, 1.8)), _at(0, 0, 0.9), wood),
        Visual(Box((0.07, 1.5, 0.07)), _at(0, 0, 1.35), wood),
    )
    sack = Visual(
        Box((0.2, 0.45, 0.6)), _at(0, 0, 1.1), kit.hsv((0.07, 0.15), (0.2, 0.5), (0.5, 0.85)), kit.texture("hay")
    )
    return _solid(0.8, mast, arm, sack)


def parcel(kit: Kit) -> Thing:
    """Return a lying bundle in a tarpaulin, as long as a person."""
    length, radius = kit.uniform(1.2, 2.0), kit.uniform(0.15, 0.3)
    body = Visual(Cylinder(radius, length), _at(0, 0, radius, 0.0, 0.5 * math.pi), kit.any_colour())
    return _solid(round(0.5 * length + 0.1, 3), body)


def cupboard(kit: Kit) -> Thing:
    """Return a switch box or a vending machine of a person's height."""
    high = kit.uniform(1.2, 1.9)
    body = Visual(Box((kit.uniform(0.3, 0.6), kit.uniform(0.4, 0.9), high)), _at(0, 0, 0.5 * high), kit.any_colour())
    return _solid(0.55, body)


def parasol(kit: Kit) -> Thing:
    """Return a garden umbrella."""
    radius, high = kit.uniform(0.5, 1.4), kit.uniform(1.8, 2.4)
    top = Visual(Mesh(assets.mesh("cone"), (radius, radius, 0.5)), _at(0, 0, high), kit.any_colour())
    return _solid(radius, _cylinder(0.03, high + 0.3, kit.grey()), top)


Maker = Callable[[Kit], Thing]

STREET: dict[str, Maker] = {"pole": pole, "sign": sign, "hydrant": hydrant, "bin": bin_, "bench": bench, "cone": cone}
YARD: dict[str, Maker] = {
    "rock": rock,
    "hay_bale": hay_bale,
    "crate": crate,
    "barrel": barrel,
    "animal": animal,
    "stump": stump,
    "shed": shed,
    "fence": fence,
}
LOOKALIKE: dict[str, Maker] = {
    "post": post,
    "scarecrow": scarecrow,
    "parcel": parcel,
    "cupboard": cupboard,
    "parasol": parasol,
}
