"""What a search needs before it flies: the world with its people, the region, and a plan for each vehicle."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import yaml
from numpy.typing import NDArray
from shapely.geometry import Point, Polygon

from xtdrone_control import qgc_plan
from xtdrone_control.autopilot import plan as mission
from xtdrone_control.fleet import parse_fleet, spawn_grid
from xtdrone_control.pinhole import Pinhole
from xtdrone_coordination.search.plans import Datum, SearchOptions, plan_search, write_plans
from xtdrone_coordination.search.region import read_region, region_data
from xtdrone_interaction.options import OptionError, repository
from xtdrone_sim import people, scenery
from xtdrone_sim.sdf import SdfWorld, load_world_file, write_world
from xtdrone_sim.vehicle_model import load_vehicle

if TYPE_CHECKING:
    from xtdrone_interaction.search_demo import SearchSettings

CAMERA = "cgo3_camera"  # whose pictures the detector gets
ROWS = 3  # vehicles side by side on the spawn grid
_MARGIN = 5.0  # m of scenery around the region's bounds
_EDGE = 3.0  # m that people keep from the region's edge


@dataclass(frozen=True)
class Prepared:
    """The files of a search, and what its map and report need of them.

    Attributes:
        names: the vehicles.
        persons: the actors of the world.
        region: m, map.
        pieces: of the region, one a vehicle; none where the user's own plans are flown.
        ways: planned way of each vehicle, (k, 2) m, map.
        world_file, region_file, plans_folder: absolute paths.
    """

    names: tuple[str, ...]
    persons: tuple[str, ...]
    region: Polygon
    pieces: tuple[Polygon, ...]
    ways: dict[str, NDArray[np.float64]]
    world_file: Path
    region_file: Path
    plans_folder: Path


def prepare(settings: SearchSettings) -> Prepared:
    """Write world, region and plans into the results' folder.

    Raises:
        OptionError: a vehicle without the camera, a plan that is missing.
        ValueError: a region, world or plan that cannot be used.
    """
    fleet = parse_fleet(f"{settings.type}:{settings.n}")
    names = tuple(vehicle.name for vehicle in fleet)
    region = read_region(settings.region or shipped_region())
    region_file = settings.out / "region.yaml"
    region_file.write_text(yaml.safe_dump(region_data(region), default_flow_style=None), encoding="utf-8")
    world, world_file = _world(settings, region)
    datum = Datum(world.datum.latitude, world.datum.longitude, world.datum.altitude)
    if settings.plans:
        pieces: tuple[Polygon, ...] = ()
        folder = Path(settings.plans)
        ways = {name: _way_of(folder / f"{name}{qgc_plan.SUFFIX}", datum) for name in names}
    else:
        options = SearchOptions(height=settings.height, picture_rate=settings.camera_rate)
        places = spawn_grid(fleet, ROWS)
        homes = {name: (x, y) for name, (x, y, _) in zip(names, places, strict=True)}
        plans = plan_search(region, homes, camera_of(settings.type), options)
        folder = settings.out / "plans"
        write_plans(folder, plans, options, datum)
        pieces = tuple(plans[name].piece for name in names)
        ways = {name: np.array([[point.x, point.y] for point in plans[name].path]) for name in names}
    return Prepared(
        names=names,
        persons=tuple(actor.name for actor in world.actors),
        region=region,
        pieces=pieces,
        ways=ways,
        world_file=world_file,
        region_file=region_file,
        plans_folder=folder,
    )


def shipped_region() -> Path:
    """Return the file of the region that is searched by default."""
    return repository() / "src" / "xtdrone_coordination" / "config" / "search" / "region.yaml"


def _world(settings: SearchSettings, region: Polygon) -> tuple[SdfWorld, Path]:
    """Return the user's world, or one made from the seed, whose people are in the region, and its file."""
    if settings.world:
        world = load_world_file(settings.world)
    else:
        world = made_world(region, settings.seed, settings.persons, walking=settings.walking)
    file = settings.out / "search.world"
    file.write_text(write_world(world), encoding="utf-8")
    return world, file


def made_world(region: Polygon, seed: int, persons: int, *, walking: bool = True) -> SdfWorld:
    """Return a world with scenery in and around the region, whose people are all in it.

    Raises:
        ValueError: so many people do not fit into the region.
    """
    low_x, low_y, high_x, high_y = region.bounds
    bounds = (low_x - _MARGIN, low_y - _MARGIN, high_x + _MARGIN, high_y + _MARGIN)
    inner = region.buffer(-_EDGE)
    return scenery.outdoor(
        seed,
        region=bounds,
        persons=persons,
        walking=walking,
        skins=people.names(),
        within=lambda x, y: inner.contains(Point(x, y)),
    )


def camera_of(vehicle_type: str) -> Pinhole:
    """Return the camera's picture.

    Raises:
        OptionError: the vehicle has none.
    """
    mounts = {mount.name: mount for mount in load_vehicle(vehicle_type).cameras}
    if CAMERA not in mounts:
        raise OptionError(f"vehicle type: {vehicle_type!r} has no camera {CAMERA}, which a search needs")
    return mounts[CAMERA].pinhole


def _way_of(file: Path, datum: Datum) -> NDArray[np.float64]:
    """Return the places of a plan's waypoints, (k, 2) m, map.

    Raises:
        OptionError: there is no such file.
        PlanError: it is no plan.
    """
    if not file.is_file():
        raise OptionError(f"plans: {str(file)!r} does not exist; each vehicle needs its own")
    items = [item for item in qgc_plan.read(file).mission if item.command == mission.WAYPOINT]
    places = [datum.local(item.x, item.y) for item in items]
    return np.array(places, float).reshape(-1, 2)
