"""Prepare a search: the world with its people, the region, and a plan for each vehicle.

All files are written to the results folder, which so documents the search.
"""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import yaml
from numpy.typing import NDArray
from shapely.geometry import Point, Polygon

from xtdrone_autopilot.navigator import plan as mission
from xtdrone_autopilot.plans import qgc_plan
from xtdrone_common.cameras.pinhole import Pinhole
from xtdrone_common.files import load_yaml, read_text
from xtdrone_common.fleet import Vehicle, parse_fleet, spawn_grid
from xtdrone_common.geodesy.projection import Datum
from xtdrone_common.settings import setting
from xtdrone_coordination.search.planning.plans import SearchOptions, VehiclePlan, plan_search, write_plans
from xtdrone_coordination.search.planning.region import parse_region, read_region, region_data
from xtdrone_interaction.command_options import OptionError, repository, seed_setting, vehicles_setting
from xtdrone_interaction.missions.demo import DemoSettings
from xtdrone_interaction.recording.topics import natural_order
from xtdrone_sim.vehicles.vehicle_model import load_vehicle
from xtdrone_worlds.worlds import people_meshes, scenery
from xtdrone_worlds.worlds.catalogue import load_world
from xtdrone_worlds.worlds.sdf import SdfWorld, load_world_file, write_world

CAMERA = "cgo3_camera"  # the detector's camera
WORLD, REGION, PIECES, PLANS = "search.world", "region.yaml", "pieces.yaml", "plans"  # in the results folder
ROWS = 3  # vehicles side by side on the spawn grid
_MARGIN = 5.0  # m of scenery around the region's bounds
_EDGE = 3.0  # m, minimum distance of people from the region's edge


@dataclass(frozen=True, kw_only=True)
class SearchSettings(DemoSettings):
    """Settings of a cooperative search.

    Attributes:
        region: YAML file with the region, or empty for the shipped one.
        plans: Folder with the user's .plan files, or empty to generate them for the region.
        world: Name or file, or empty to generate one from the seed.
    """

    # The staggered heights of 12 vehicles stay within the range for which the detector was trained, 6 to 25 m.
    n: int = vehicles_setting(6, low=1, high=12)
    type: str = setting("typhoon_h480", metavar="TYPE", text="vehicle type")
    region: str = ""
    plans: str = ""
    persons: int = setting(1, low=0, high=20, metavar="K", text="persons in the region")
    walking: bool = setting(True, option="--standing", text="standing persons (default: walking)")
    height: float = setting(
        12.0,
        low=6.0,
        high=25.0,
        unit="m",
        metavar="M",
        text="height of the lowest vehicle; the others are staggered above it",
    )
    on_find: str = setting(
        "hold", choices=("hold", "return", "continue"), text="behaviour of the other vehicles after a find"
    )
    follow_time: float = setting(
        60.0, low=0.0, high=3600.0, unit="s", metavar="S", text="time for which a found person is followed"
    )
    time_limit: float = setting(
        900.0, low=30.0, high=7200.0, unit="s", metavar="S", text="simulated time after which all vehicles return"
    )
    camera_rate: float = setting(2.0, low=0.5, high=10.0, unit="Hz", metavar="HZ", text="picture rate of each camera")
    film: bool = setting(True, text="no views.mp4")
    seed: int = seed_setting("seed of the world, of the person's position, and of all noise")


@dataclass(frozen=True)
class Prepared:
    """The files of a search, and their content for its map and report.

    Attributes:
        names: the vehicles.
        persons: the actors of the world.
        region: m, map frame.
        pieces: of the region, one per vehicle; none if the user's plans are flown.
        ways: planned path of each vehicle, (k, 2) m, map frame.
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
    """Write world, region and plans to the results folder, which is created only if all of them are usable.

    Raises:
        OptionError: a vehicle has no camera, or a plan is missing.
        ValueError: a region, world or plan is unusable, or the height is too great to detect a person.
    """
    fleet = parse_fleet(f"{settings.type}:{settings.n}")
    region = read_region(settings.region or shipped_region())
    world = _world(settings, region)
    own = [_own_plan(Path(settings.plans), vehicle.name) for vehicle in fleet] if settings.plans else []
    options = SearchOptions(height=settings.height, picture_rate=settings.camera_rate)
    plans = {} if own else _plans(fleet, settings.type, region, options)
    folder = settings.out / PLANS
    folder.mkdir(parents=True, exist_ok=True)
    _write_yaml(settings.out / REGION, region_data(region))
    (settings.out / WORLD).write_text(write_world(world), encoding="utf-8")
    for file in own:
        shutil.copyfile(file, folder / file.name)
    if plans:
        write_plans(folder, plans, options, world.datum)
        _write_yaml(settings.out / PIECES, {name: region_data(plan.piece) for name, plan in plans.items()})
    return read_prepared(settings.out)


def _plans(
    fleet: tuple[Vehicle, ...], vehicle_type: str, region: Polygon, options: SearchOptions
) -> dict[str, VehiclePlan]:
    homes = {vehicle.name: (x, y) for vehicle, (x, y, _) in zip(fleet, spawn_grid(fleet, ROWS), strict=True)}
    return plan_search(region, homes, camera_of(vehicle_type), options)


def _own_plan(folder: Path, name: str) -> Path:
    """Return the user's plan file of a vehicle.

    Raises:
        OptionError: the file does not exist.
        PlanError: it is not a plan.
    """
    file = folder / f"{name}{qgc_plan.SUFFIX}"
    if not file.is_file():
        raise OptionError(f"plans: {str(file)!r} does not exist; each vehicle needs its own")
    qgc_plan.read(file)
    return file


def is_search(folder: Path) -> bool:
    """Return whether a folder contains the files of a search, written by :func:`prepare`."""
    return all((folder / name).exists() for name in (WORLD, REGION, PLANS))


def read_prepared(folder: Path) -> Prepared:
    """Read the files written by :func:`prepare` from a results folder.

    Raises:
        ValueError: a file is unusable.
    """
    world = load_world_file(str(folder / WORLD))
    datum = world.datum
    plans = {file.stem: file for file in (folder / PLANS).glob(f"*{qgc_plan.SUFFIX}")}
    names = tuple(sorted(plans, key=natural_order))
    pieces = _read_pieces(folder / PIECES)
    return Prepared(
        names=names,
        persons=tuple(actor.name for actor in world.actors),
        region=read_region(folder / REGION),
        pieces=tuple(pieces[name] for name in names if name in pieces),
        ways={name: _way_of(plans[name], datum) for name in names},
        world_file=folder / WORLD,
        region_file=folder / REGION,
        plans_folder=folder / PLANS,
    )


def _write_yaml(file: Path, data: Mapping[str, object]) -> None:
    file.write_text(yaml.safe_dump(data, default_flow_style=None, sort_keys=False), encoding="utf-8")


def _read_pieces(file: Path) -> dict[str, Polygon]:
    """Return the vehicles' pieces; none if the user's plans were flown.

    Raises:
        ValueError: the file is unusable.
    """
    if not file.is_file():
        return {}
    try:
        return {name: parse_region(data) for name, data in load_yaml(read_text(file)).items()}
    except (AttributeError, ValueError) as error:
        raise ValueError(f"{file}: no pieces of a region: {error}") from error


def shipped_region() -> Path:
    """Return the file of the default region."""
    return repository() / "src" / "xtdrone_coordination" / "config" / "search" / "region.yaml"


def _world(settings: SearchSettings, region: Polygon) -> SdfWorld:
    """Return the user's world, or one generated from the seed with all people in the region."""
    if settings.world:
        return load_world(settings.world)
    return generate_world(region, settings.seed, settings.persons, walking=settings.walking)


def generate_world(region: Polygon, seed: int, persons: int, *, walking: bool = True) -> SdfWorld:
    """Generate a world with scenery in and around the region, and all people inside the region.

    Raises:
        ValueError: the region is too small for the number of people.
    """
    low_x, low_y, high_x, high_y = region.bounds
    bounds = (low_x - _MARGIN, low_y - _MARGIN, high_x + _MARGIN, high_y + _MARGIN)
    inner = region.buffer(-_EDGE)
    return scenery.outdoor(
        seed,
        region=bounds,
        persons=persons,
        walking=walking,
        skins=people_meshes.names(),
        within=lambda x, y: inner.contains(Point(x, y)),
    )


def camera_of(vehicle_type: str) -> Pinhole:
    """Return the intrinsics of the vehicle's camera.

    Raises:
        OptionError: the vehicle has no camera.
    """
    mounts = {mount.name: mount for mount in load_vehicle(vehicle_type).cameras}
    if CAMERA not in mounts:
        raise OptionError(f"vehicle type: {vehicle_type!r} has no camera {CAMERA}, which a search needs")
    return mounts[CAMERA].pinhole


def _way_of(file: Path, datum: Datum) -> NDArray[np.float64]:
    """Return the positions of a plan's waypoints, (k, 2) m, map frame.

    Raises:
        PlanError: the file is not a plan.
    """
    items = [item for item in qgc_plan.read(file).mission if item.command == mission.WAYPOINT]
    places = [datum.local(item.x, item.y) for item in items]
    return np.array(places, float).reshape(-1, 2)
