"""Countryside generated from a seed: ground, trees, houses, a road with cars, many small objects, and people."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from xtdrone_common.poses import Pose
from xtdrone_common.rotation import from_euler
from xtdrone_common.settings import Settings, check_range, setting
from xtdrone_worlds.shapes.visual import Mesh, Visual
from xtdrone_worlds.worlds.people_meshes import names
from xtdrone_worlds.worlds.scenery import assets, scenery_objects
from xtdrone_worlds.worlds.scenery.materials import SPLITS, Kit
from xtdrone_worlds.worlds.scenery.scenery_objects import Thing
from xtdrone_worlds.worlds.scenery.start_area_and_ground import FreeGround, Rectangle
from xtdrone_worlds.worlds.sdf import (
    Light,
    SdfActor,
    SdfLink,
    SdfModel,
    SdfWorld,
    Trajectory,
    Waypoint,
    load_world_file,
)

REGION: Rectangle = (-10.0, -10.0, 90.0, 50.0)
CLEAR: Rectangle = (-3.0, -3.0, 18.0, 13.0)
LIGHTS = ("noon", "morning", "evening", "overcast", "any")

_MARGIN = 40.0  # m around the region, with sparser scenery for oblique views
_GROUND = 256.0  # m, side of one tile of ground
# m; layers of ground, separated enough for cameras with coarse depth at altitude
_LAWN, _PATCH, _PATH, _ROAD = -0.12, -0.08, -0.04, 0.0
_PATHS = 4
_WHITE = (1.0, 1.0, 1.0, 1.0)
# patches of ground: texture, region area per patch in m^2, minimum and maximum radius in m
_PATCHES = (
    ("crops", 1200.0, 8.0, 18.0),
    ("water", 8000.0, 3.0, 7.0),
    ("gravel", 4000.0, 2.0, 5.0),
    ("meadow", 450.0, 5.0, 14.0),
    ("grass", 700.0, 3.0, 8.0),
)
_TRIES = 60
_PERSON = 0.5  # m, free radius around a person
_DEGREES = math.pi / 180.0

# default number per 1000 m^2
_DENSITY = {"tree": 7.0, "bush": 5.0, "house": 0.6, "street": 1.6, "yard": 4.0, "lookalike": 2.5, "car": 0.7}


@dataclass(frozen=True)
class OutdoorOptions(Settings):
    """Options of a scene.

    Attributes:
        region: x0, y0, x1, y1, m ENU; area of objects and people, each side 10 to 2000 m.
        clear: rectangle without objects for the start of the vehicles.
        skins: skins of the people; empty leaves the actors' skins unspecified.
        within: predicate of x, y (m ENU) for the places where people may stand or turn; None: all of ``region``.
    """

    region: Rectangle = REGION
    clear: Rectangle = CLEAR
    persons: int = setting(1, low=0, high=100, text="number of persons")
    walking: bool = setting(False, text="persons walk in circuits instead of standing")
    skins: Sequence[str] = ()
    split: str = setting("all", choices=SPLITS, text="colours, textures and shapes to choose from")
    objects: float = setting(1.0, low=0.0, high=3.0, text="factor on the number of things")
    light: str = setting("noon", choices=LIGHTS, text="time of day and weather")
    person_distance: float = setting(10.0, low=0.0, high=1000.0, unit="m", text="distance of persons from ``clear``")
    within: Callable[[float, float], bool] | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        x0, y0, x1, y1 = self.region
        for name, side in (("x", x1 - x0), ("y", y1 - y0)):
            check_range(f"region: its side along {name}", side, 10.0, 2000.0, "m")


def outdoor(seed: int, **options: object) -> SdfWorld:
    """Generate the scene of a seed; equal seeds and options give the same world.

    Args:
        seed: 0 or more.
        options: see :class:`OutdoorOptions`. The number of people does not affect the placement of objects.

    Raises:
        ValueError: an option is not allowed, or a person has no free place.
    """
    wanted = OutdoorOptions(**options)  # type: ignore[arg-type]
    check_range("seed", seed, 0)
    scene = _Scene(seed, wanted)
    scene.furnish()
    world = replace(load_world_file("empty"), name=f"outdoor_{seed}", light=scene.light(), models=tuple(scene.models))
    return replace(world, actors=tuple(_people(seed, wanted, world)))


class _Scene:
    """A scene under construction."""

    def __init__(self, seed: int, options: OutdoorOptions) -> None:
        self._seed = seed
        self._options = options
        self.models: list[SdfModel] = []
        self._circles: list[tuple[float, float, float]] = []
        self._road = 0.0  # y of the centre line, m

    def _kit(self, purpose: int) -> Kit:
        """Return a separate random kit for each purpose, so that the purposes do not influence each other."""
        return Kit(self._options.split, np.random.default_rng((self._seed, purpose)))

    def furnish(self) -> None:
        """Add everything except people."""
        self._ground(self._kit(1))
        self._roadside(self._kit(2))
        self._scatter(3, "house", {"house": scenery_objects.house})
        self._scatter(4, "tree", {"tree": scenery_objects.leafy_tree, "spruce": scenery_objects.conifer}, margin=True)
        self._scatter(5, "yard", scenery_objects.YARD)
        self._scatter(6, "lookalike", scenery_objects.LOOKALIKE)
        self._scatter(7, "street", scenery_objects.STREET)
        self._scatter(8, "car", {"parked_car": scenery_objects.car})
        self._scatter(9, "bush", {"bush": scenery_objects.bush}, margin=True)

    def light(self) -> Light:
        """Return random sunlight and sky."""
        rng = self._kit(10).rng
        kind = self._options.light
        if kind == "any":
            kind = LIGHTS[int(rng.integers(len(LIGHTS) - 1))]
        height = {"noon": 60.0, "morning": 35.0, "evening": 25.0, "overcast": 70.0}[kind] * _DEGREES
        around = float(rng.uniform(0.0, 2.0 * math.pi))
        direction = tuple(
            round(value, 3)
            for value in (math.cos(around) * math.cos(height), math.sin(around) * math.cos(height), -math.sin(height))
        )
        colours = {
            "noon": ((0.75, 0.74, 0.7), (0.45, 0.46, 0.48), (0.62, 0.77, 0.93)),
            "morning": ((0.7, 0.66, 0.58), (0.42, 0.44, 0.5), (0.72, 0.8, 0.9)),
            "evening": ((0.75, 0.58, 0.42), (0.38, 0.38, 0.46), (0.88, 0.75, 0.62)),
            "overcast": ((0.25, 0.25, 0.26), (0.68, 0.69, 0.71), (0.8, 0.82, 0.84)),
        }
        diffuse, ambient, background = colours[kind]
        x, y, z = direction
        return Light((x, y, z), diffuse, ambient, background, kind != "overcast")

    # ground

    def _ground(self, kit: Kit) -> None:
        x0, y0, x1, y1 = self._options.region
        visuals = self._lawn(kit)
        area = (x1 - x0) * (y1 - y0)
        circles: list[tuple[float, float, float]] = []
        for kind, share, low, high in _PATCHES:
            for _ in range(max(1, round(area / share))):
                size, turn = kit.uniform(low, high), kit.uniform(-3.14, 3.14)
                x, y = kit.uniform(x0 - 20.0, x1 + 20.0), kit.uniform(y0 - 20.0, y1 + 20.0)
                form = Mesh(kit.mesh("blob"), (size, round(size * kit.uniform(0.5, 1.0), 3), 1.0))
                texture = kit.texture(kind)
                if all(math.hypot(x - a, y - b) > 1.3 * (size + r) for a, b, r in circles):
                    circles.append((x, y, size))
                    pose = Pose((x, y, _PATCH), from_euler(0.0, 0.0, turn))
                    visuals.append(Visual(form, pose, _WHITE, texture))
        visuals += self._ways(kit)
        self.models.append(SdfModel("ground", links=(SdfLink("link", visuals=tuple(visuals)),)))

    def _lawn(self, kit: Kit) -> list[Visual]:
        """Return the ground, extending far beyond the region, in square tiles."""
        x0, y0, x1, y1 = self._options.region
        texture = kit.texture("grass")
        pieces = []
        across = [2 * math.ceil(0.5 * side / _GROUND) + 1 for side in (x1 - x0, y1 - y0)]
        for i in range(across[0]):
            for j in range(across[1]):
                place = (
                    round(0.5 * (x0 + x1) + (i - 0.5 * (across[0] - 1)) * _GROUND, 3),
                    round(0.5 * (y0 + y1) + (j - 0.5 * (across[1] - 1)) * _GROUND, 3),
                    _LAWN,
                )
                form = Mesh(assets.mesh("ground"), (_GROUND, _GROUND, 1.0))
                pieces.append(Visual(form, Pose(place), _WHITE, texture))
        return pieces

    def _ways(self, kit: Kit) -> list[Visual]:
        """Return footpaths, and a road along x on one side of the clear rectangle."""
        x0, y0, x1, y1 = self._options.region
        low, high = self._options.clear[3] + 6.0, y1 - 4.0
        if low > high:
            low = high = y1 + 8.0
        self._road = kit.uniform(low, high)
        ways = []
        gravel = kit.texture("gravel")
        for _ in range(max(1, min(_PATHS, round((x1 - x0) * (y1 - y0) / 3500.0)))):
            form = Mesh(kit.mesh("path"), (kit.uniform(40.0, 90.0), kit.uniform(1.0, 2.2), 1.0))
            place = (kit.uniform(x0, x1), kit.uniform(y0, y1), _PATH)
            pose = Pose(place, from_euler(0.0, 0.0, kit.uniform(-3.14, 3.14)))
            ways.append(Visual(form, pose, _WHITE, gravel))
        road = Mesh(assets.mesh("road"), (round(x1 - x0 + 2 * _MARGIN + 40.0, 3), 6.0, 1.0))
        pose = Pose((round(0.5 * (x0 + x1), 3), self._road, _ROAD))
        return [*ways, Visual(road, pose, _WHITE, kit.texture("asphalt"))]

    # objects

    def _roadside(self, kit: Kit) -> None:
        """Place cars on the road, and keep the rest of it free."""
        x0, _, x1, _ = self._options.region
        cars = round(self._options.objects * (x1 - x0) / 35.0)
        for _ in range(cars):
            side = 1.0 if kit.rng.uniform() < 0.5 else -1.0
            y = round(self._road - 1.5 * side, 3)
            self._try(
                kit, "car", scenery_objects.car(kit), lambda y=y: (kit.uniform(x0, x1), y), 0.0 if side > 0 else 3.1416
            )
        step = 3.0
        for x in np.arange(x0 - _MARGIN, x1 + _MARGIN, step):
            self._circles.append((float(x), self._road, 3.6))

    def _scatter(self, purpose: int, kind: str, makers: dict[str, scenery_objects.Maker], margin: bool = False) -> None:
        kit = self._kit(purpose)
        x0, y0, x1, y1 = self._options.region
        area = (x1 - x0) * (y1 - y0)
        inside = round(self._options.objects * _DENSITY[kind] * area / 1000.0)
        names = list(makers)
        for _ in range(inside):
            name = names[int(kit.rng.integers(len(names)))]
            self._try(kit, name, makers[name](kit), lambda: (kit.uniform(x0, x1), kit.uniform(y0, y1)))
        if margin:
            for _ in range(round(0.5 * inside)):
                name = names[int(kit.rng.integers(len(names)))]
                self._try(kit, name, makers[name](kit), lambda: self._beside(kit))

    def _beside(self, kit: Kit) -> tuple[float, float]:
        """Return a random place in the margin around the region."""
        x0, y0, x1, y1 = self._options.region
        while True:
            x, y = kit.uniform(x0 - _MARGIN, x1 + _MARGIN), kit.uniform(y0 - _MARGIN, y1 + _MARGIN)
            if not (x0 <= x <= x1 and y0 <= y <= y1):
                return x, y

    def _try(self, kit: Kit, kind: str, thing: Thing, place: object, turn: float | None = None) -> None:
        """Place an object on free ground; skip it after too many failed attempts."""
        yaw = kit.uniform(-3.14, 3.14) if turn is None else turn
        for _ in range(_TRIES):
            x, y = place()  # type: ignore[operator]
            if self._is_free(x, y, thing.radius):
                break
        else:
            return
        self._circles.append((x, y, thing.radius))
        link = SdfLink("link", visuals=thing.visuals, collisions=thing.collisions)
        number = sum(model.name.rpartition("_")[0] == kind for model in self.models)
        self.models.append(SdfModel(f"{kind}_{number}", Pose((x, y, 0.0), from_euler(0.0, 0.0, yaw)), True, (link,)))

    def _is_free(self, x: float, y: float, radius: float) -> bool:
        x0, y0, x1, y1 = self._options.clear
        if math.hypot(max(x0 - x, 0.0, x - x1), max(y0 - y, 0.0, y - y1)) < radius:
            return False
        return all(math.hypot(x - a, y - b) >= radius + r + 0.3 for a, b, r in self._circles)


# people


def _people(seed: int, options: OutdoorOptions, world: SdfWorld) -> list[SdfActor]:
    rng = np.random.default_rng((seed, 20))
    ground = FreeGround(world)
    actors: list[SdfActor] = []
    skins = list(options.skins)
    # separate generator: the choice of skins does not affect the positions
    order = np.random.default_rng((seed, 21)).permutation(len(skins))
    for k in range(options.persons):
        skin = skins[order[k % len(order)]] if skins else ""
        speed = round(float(rng.uniform(0.8, 1.4)), 2)
        x, y = _place(rng, options, ground, [actor.pose.position for actor in actors])
        yaw = round(float(rng.uniform(-3.14, 3.14)), 3)
        pose = Pose((x, y, 0.0), from_euler(0.0, 0.0, yaw))
        way = _way(rng, options, ground, (x, y), speed) if options.walking else None
        actors.append(SdfActor(f"actor_{k}", skin, pose, way, speed))
    return actors


def _place(
    rng: np.random.Generator, options: OutdoorOptions, ground: FreeGround, others: list[tuple[float, float, float]]
) -> tuple[float, float]:
    for _ in range(1000):
        x, y = _anywhere(rng, options.region)
        if (
            _distance(options.clear, x, y) >= options.person_distance
            and (options.within is None or options.within(x, y))
            and ground.is_free(x, y, _PERSON)
            and all(math.hypot(x - a, y - b) >= 2.0 for a, b, _ in others)
        ):
            return x, y
    raise ValueError(
        f"persons: {options.persons} is not allowed here: no free place is {options.person_distance:g} m away from "
        "where the vehicles start; a larger region, fewer objects or a smaller person_distance is needed"
    )


def _anywhere(rng: np.random.Generator, region: Rectangle) -> tuple[float, float]:
    x0, y0, x1, y1 = region
    return round(float(rng.uniform(x0, x1)), 2), round(float(rng.uniform(y0, y1)), 2)


def _distance(rectangle: Rectangle, x: float, y: float) -> float:
    x0, y0, x1, y1 = rectangle
    return math.hypot(max(x0 - x, 0.0, x - x1), max(y0 - y, 0.0, y - y1))


def _way(
    rng: np.random.Generator, options: OutdoorOptions, ground: FreeGround, start: tuple[float, float], speed: float
) -> Trajectory | None:
    """Return a closed walk of straight segments over free ground; None without room to walk."""
    corners = [start]
    x0, y0, x1, y1 = options.region
    for _ in range(400):
        length, angle = rng.uniform(4.0, 15.0), rng.uniform(-math.pi, math.pi)
        x, y = (
            round(float(value), 2)
            for value in (corners[-1][0] + length * math.cos(angle), corners[-1][1] + length * math.sin(angle))
        )
        inside = x0 <= x <= x1 and y0 <= y <= y1 and _distance(options.clear, x, y) >= 0.5 * options.person_distance
        inside = inside and (options.within is None or options.within(x, y))
        if inside and ground.is_free_way(corners[-1], (x, y), _PERSON):
            corners.append((x, y))
        if len(corners) >= 3 and ground.is_free_way(corners[-1], start, _PERSON) and rng.uniform() < 0.5:
            break
    if len(corners) < 2:
        return None
    back = corners if ground.is_free_way(corners[-1], start, _PERSON) else corners + corners[-2:0:-1]
    return _walk([*back, start], speed)


def _walk(corners: list[tuple[float, float]], speed: float) -> Trajectory:
    """Return the walk along corners, turning in place at each; the last corner equals the first."""
    time, waypoints = 0.0, []
    legs = list(itertools.pairwise(corners))
    headings = [round(math.atan2(b[1] - a[1], b[0] - a[0]), 3) for a, b in legs]
    for k, (a, b) in enumerate(legs):
        waypoints.append(_waypoint(time, a, headings[k]))
        time = round(time + math.hypot(b[0] - a[0], b[1] - a[1]) / speed, 3)
        waypoints.append(_waypoint(time, b, headings[k]))
        time = round(time + 1.0, 3)
    waypoints.append(_waypoint(time, corners[0], headings[0]))
    return Trajectory(tuple(waypoints))


def _waypoint(time: float, place: tuple[float, float], heading: float) -> Waypoint:
    return Waypoint(time, Pose((*place, 0.0), from_euler(0.0, 0.0, heading)))


def is_free(world: SdfWorld, x: float, y: float, radius: float) -> bool:
    """Return whether only ground is within ``radius`` m of (x, y), m ENU, at any height; see ``free_ground.Ground``."""
    return FreeGround(world).is_free(x, y, radius)


@dataclass(frozen=True)
class CountrysideSettings(Settings):
    """Options of a countryside."""

    seed: int = setting(0, low=0, text="seed of all random choices")
    length: float = setting(100.0, low=30.0, high=1000.0, unit="m", text="along x, from -10 m on")
    width: float = setting(60.0, low=30.0, high=1000.0, unit="m", text="along y, from -10 m on")
    persons: int = setting(1, low=0, high=100, text="number of persons")
    walking: bool = setting(False, text="persons walk instead of standing")
    objects: float = setting(1.0, low=0.0, high=3.0, text="factor on the number of things")
    light: str = setting("noon", choices=LIGHTS, text="time of day and weather")


def countryside(settings: CountrysideSettings) -> SdfWorld:
    """Generate the countryside of a seed.

    Raises:
        ValueError: a person has no free place.
    """
    return outdoor(
        settings.seed,
        region=(-10.0, -10.0, settings.length - 10.0, settings.width - 10.0),
        persons=settings.persons,
        walking=settings.walking,
        skins=names(),
        objects=settings.objects,
        light=settings.light,
    )
