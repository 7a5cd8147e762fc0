"""Indoor: a building of one storey with rooms on both sides of corridors, doors, and furniture.

The corridors run along x from a lobby on the west side, whose door faces the start area. Each room has a door to its
corridor; some have a second one to the room beside them.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from xtdrone_common.poses import Pose
from xtdrone_common.settings import SettingError, Settings, setting
from xtdrone_worlds.shapes.visual import Colour, Cylinder, Visual
from xtdrone_worlds.worlds.scenery.materials import Kit
from xtdrone_worlds.worlds.scenery.start_area_and_ground import (
    BESIDE,
    START,
    Places,
    Rectangle,
    box,
    ground,
    solid,
    world,
)
from xtdrone_worlds.worlds.sdf import SdfModel, SdfWorld

_WALL: Colour = (0.88, 0.87, 0.83, 1.0)
_FLOOR: Colour = (0.6, 0.5, 0.42, 1.0)
_SHORTEST = 1e-6  # m, of a piece of wall
_BESIDE_DOORS = 0.35  # share of the walls between two rooms that have a door
_DOOR_SPACE = 0.9  # m, radius that furniture leaves free on both sides of a door


@dataclass(frozen=True)
class IndoorSettings(Settings):
    """Options of a building."""

    seed: int = setting(0, low=0, text="seed of all random choices")
    length: float = setting(24.0, low=8.0, high=200.0, unit="m", text="along x")
    width: float = setting(16.0, low=6.0, high=200.0, unit="m", text="along y")
    room: float = setting(5.0, low=2.5, high=50.0, unit="m", text="mean length of rooms along the corridor")
    corridor: float = setting(2.0, low=1.2, high=10.0, unit="m", text="width of the corridors")
    height: float = setting(2.8, low=2.2, high=12.0, unit="m", text="height of the walls")
    wall: float = setting(0.15, low=0.05, high=0.6, unit="m", text="thickness of the walls")
    door: float = setting(1.0, low=0.7, high=4.0, unit="m", text="width of the doors")
    lintel: float = setting(2.1, low=1.8, high=12.0, unit="m", text="height of the doors")
    furniture: float = setting(1.0, low=0.0, high=4.0, text="factor on the number of tables, shelves and boxes")
    ceiling: bool = setting(False, text="a ceiling, which hides the rooms from cameras above")

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.door > self.corridor - 0.3:
            raise SettingError("door", self.door, f"at most {self.corridor - 0.3:g} m, 0.3 m less than the corridor")
        if self.lintel > self.height:
            raise SettingError("lintel", self.lintel, f"at most the height, {self.height:g} m")


Wall = tuple[tuple[float, float], tuple[float, float], tuple[float, ...]]
"""Start, end, and the centres of the doors as distances from the start; along x or y, m."""


@dataclass
class Plan:
    """A floor plan; lengths in m, in a frame with the building's south-west corner as its origin.

    Attributes:
        rooms: x0, y0, x1, y1 of rooms, lobby and corridors; the latter two have no furniture.
        halls: indices in ``rooms`` of lobby and corridors.
        walls: see ``Wall``.
        doors: (x, y) of all doors.
        links: pairs of indices in ``rooms`` that a door, or an opening without a wall, connects.
    """

    rooms: list[Rectangle] = field(default_factory=list)
    halls: set[int] = field(default_factory=set)
    walls: list[Wall] = field(default_factory=list)
    doors: list[tuple[float, float]] = field(default_factory=list)
    links: set[tuple[int, int]] = field(default_factory=set)

    def add_wall(self, start: tuple[float, float], end: tuple[float, float], doors: Sequence[float] = ()) -> None:
        """Add a wall with doors at distances from its start."""
        self.walls.append((start, end, tuple(doors)))
        along_x = start[1] == end[1]
        self.doors += [(start[0] + at, start[1]) if along_x else (start[0], start[1] + at) for at in doors]


def floor_plan(settings: IndoorSettings) -> Plan:
    """Return the floor plan of a seed."""
    rng = np.random.default_rng((settings.seed, 60))
    length, width, corridor = settings.length, settings.width, settings.corridor
    bands = max(1, round(width / (2.0 * settings.room + corridor)))  # of a corridor with rooms on both sides
    deep = (width / bands - corridor) / 2.0
    if deep < 2.0:
        raise SettingError("width", width, f"at least {corridor + 4.0:g} m, for rooms of 2 m beside a corridor")
    plan = Plan()
    lobby = corridor if bands > 1 or length > 2.0 * settings.room else 0.0
    if lobby:
        plan.rooms.append((0.0, 0.0, lobby, width))
        plan.halls.add(0)
    entrance = width / bands * (bands // 2) + deep + 0.5 * corridor
    plan.add_wall((0.0, 0.0), (0.0, width), (entrance,))
    plan.add_wall((length, 0.0), (length, width))
    plan.add_wall((0.0, 0.0), (length, 0.0))
    plan.add_wall((0.0, width), (length, width))
    for band in range(bands):
        _add_band(plan, settings, rng, lobby, width / bands * band, deep)
        if band:
            plan.add_wall((lobby, width / bands * band), (length, width / bands * band))
    return plan


def _add_band(plan: Plan, s: IndoorSettings, rng: np.random.Generator, x0: float, y0: float, deep: float) -> None:
    """Add a corridor from ``x0`` to the east wall, and the rooms to its south and north."""
    hall = len(plan.rooms)
    plan.rooms.append((x0, y0 + deep, s.length, y0 + deep + s.corridor))
    plan.halls.add(hall)
    if x0:
        plan.links.add((0, hall))
    for south in (True, False):
        low = y0 if south else y0 + deep + s.corridor
        inner = low + deep if south else low  # y of the wall to the corridor
        edges = _edges(rng, x0, s.length, s.room)
        doors = []
        for k, (a, b) in enumerate(itertools.pairwise(edges)):
            number = len(plan.rooms)
            plan.rooms.append((a, low, b, low + deep))
            plan.links.add((hall, number))
            slack = 0.5 * s.door + s.wall
            doors.append(float(rng.uniform(a + slack, b - slack)) - x0)
            if k:
                beside = (float(rng.uniform(slack, deep - slack)),) if rng.uniform() < _BESIDE_DOORS else ()
                plan.add_wall((a, low), (a, low + deep), beside)
                if beside:
                    plan.links.add((number - 1, number))
        plan.add_wall((x0, inner), (s.length, inner), doors)
        if x0:
            plan.add_wall((x0, low), (x0, low + deep))


def _edges(rng: np.random.Generator, x0: float, x1: float, mean: float) -> list[float]:
    """Return the ends of rooms between ``x0`` and ``x1``, of 0.75 to 1.25 times their mean length."""
    count = max(1, round((x1 - x0) / mean))
    shares = rng.uniform(0.75, 1.25, count)
    ends = x0 + (x1 - x0) * np.cumsum(shares) / shares.sum()
    return [x0, *ends[:-1].tolist(), x1]


def indoor(settings: IndoorSettings) -> SdfWorld:
    """Generate the building of a seed.

    Raises:
        SettingError: the building is too narrow for a corridor with rooms.
    """
    plan = floor_plan(settings)
    entrance = plan.doors[0][1]
    corner = BESIDE, 0.5 * (START[1] + START[3]) - entrance  # the entrance is opposite the centre of the start area
    pieces = [piece for wall in plan.walls for piece in _pieces(wall, settings)]
    walls = [box(size, (corner[0] + x, corner[1] + y, z), _WALL) for size, (x, y, z) in pieces]
    region = (*corner, corner[0] + settings.length, corner[1] + settings.width)
    middle = (0.5 * (region[0] + region[2]), 0.5 * (region[1] + region[3]))
    floor = box((settings.length, settings.width, 0.01), (*middle, 0.0), _FLOOR)
    models = [ground("gravel", region), solid("floor", [], [floor]), solid("walls", walls)]
    if settings.ceiling:
        lid = box((settings.length, settings.width, 0.1), (*middle, settings.height + 0.05), _WALL)
        models.append(solid("ceiling", [lid]))
    models += _furniture(settings, plan, corner)
    return world(f"indoor_{settings.seed}", models)


_Piece = tuple[tuple[float, float, float], tuple[float, float, float]]


def _pieces(wall: Wall, s: IndoorSettings) -> list[_Piece]:
    """Return the boxes (size, centre) of a wall: between its doors, and above each of them."""
    (x0, y0), (x1, y1), doors = wall
    along_x = y0 == y1
    length = (x1 - x0) if along_x else (y1 - y0)
    spans: list[tuple[float, float, float, float]] = []  # start, end, lowest, highest
    begin = -0.5 * s.wall
    for at in sorted(doors):
        spans.append((begin, at - 0.5 * s.door, 0.0, s.height))
        spans.append((at - 0.5 * s.door, at + 0.5 * s.door, s.lintel, s.height))
        begin = at + 0.5 * s.door
    spans.append((begin, length + 0.5 * s.wall, 0.0, s.height))
    pieces: list[_Piece] = []
    for a, b, low, high in spans:
        if b - a < _SHORTEST or high - low < _SHORTEST:
            continue
        along, middle, z = b - a, 0.5 * (a + b), 0.5 * (low + high)
        size = (along, s.wall, high - low) if along_x else (s.wall, along, high - low)
        pieces.append((size, (x0 + middle, y0, z) if along_x else (x0, y0 + middle, z)))
    return pieces


def _furniture(settings: IndoorSettings, plan: Plan, corner: tuple[float, float]) -> list[SdfModel]:
    kit = Kit("all", np.random.default_rng((settings.seed, 61)))
    models: list[SdfModel] = []
    for number, (x0, y0, x1, y1) in enumerate(plan.rooms):
        if number in plan.halls:
            continue
        inner = (x0 + settings.wall, y0 + settings.wall, x1 - settings.wall, y1 - settings.wall)
        places = Places(kit.rng, inner, clear=None)
        for x, y in plan.doors:
            places.occupy(x, y, _DOOR_SPACE)
        for _ in range(round(settings.furniture * (x1 - x0) * (y1 - y0) / 8.0)):
            kind, radius, shapes = _piece_of_furniture(kit, settings)
            place = places.take(radius, 0.3)
            if place is not None:
                x, y = corner[0] + place[0], corner[1] + place[1]
                moved = [_move(shape, x, y) for shape in shapes]
                models.append(solid(f"{kind}_{len(models)}", moved))
    return models


def _piece_of_furniture(kit: Kit, settings: IndoorSettings) -> tuple[str, float, list[Visual]]:
    """Return kind, radius on the ground, m, and shapes around the origin."""
    which = int(kit.rng.integers(4))
    colour, wood = kit.any_colour(), kit.brown()
    if which == 0:
        radius = kit.uniform(0.4, 0.7)
        top = Visual(Cylinder(radius, 0.05), Pose((0.0, 0.0, 0.73)), wood)
        return "table", radius, [top, box((0.1, 0.1, 0.7), (0.0, 0.0, 0.35), wood)]
    if which == 1:
        wide, deep = kit.uniform(1.0, 1.6), kit.uniform(0.6, 0.8)
        legs = [
            box((0.06, 0.06, 0.7), (sx * (0.5 * wide - 0.05), sy * (0.5 * deep - 0.05), 0.35), wood)
            for sx in (-1, 1)
            for sy in (-1, 1)
        ]
        return "desk", 0.5 * math.hypot(wide, deep), [box((wide, deep, 0.05), (0.0, 0.0, 0.725), wood), *legs]
    if which == 2:
        high = min(kit.uniform(1.2, 2.2), settings.height - 0.2)
        wide = kit.uniform(0.8, 1.4)
        return "shelf", 0.5 * math.hypot(wide, 0.35), [box((wide, 0.35, high), (0.0, 0.0, 0.5 * high), colour)]
    side = kit.uniform(0.3, 0.7)
    return "box", 0.5 * math.hypot(side, side), [box((side, side, side), (0.0, 0.0, 0.5 * side), colour)]


def _move(shape: Visual, x: float, y: float) -> Visual:
    a, b, c = shape.pose.position
    return Visual(shape.geometry, Pose((round(a + x, 4), round(b + y, 4), c)), shape.colour, shape.texture)
