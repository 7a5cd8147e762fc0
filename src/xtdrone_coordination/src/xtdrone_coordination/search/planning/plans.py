"""Search missions: divide a region among vehicles, plan a coverage path for each, write QGroundControl .plan files.

Every vehicle flies at its own height, so that paths may cross. Missions are in latitude and longitude; the conversion
from and to the map frame is the autopilot's own projection.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from shapely.geometry import Polygon

from xtdrone_autopilot.navigator import plan
from xtdrone_autopilot.navigator.plan import FRAME_MISSION, Items, PlanItem
from xtdrone_autopilot.plans import qgc_plan
from xtdrone_common.cameras.pinhole import Pinhole
from xtdrone_common.fleet import FleetError, parse_fleet, spawn_grid
from xtdrone_common.geodesy.projection import Datum
from xtdrone_common.settings import Settings, setting

from .coverage_path import CoverageOptions, ImageFootprint, Point, Waypoint, cover, footprint, length, turns
from .region import RegionError, divide, read_region

NAN = math.nan
_MOUNT_BY_MAVLINK = 2.0  # MAV_MOUNT_MODE_MAVLINK_TARGETING
_GROUND_SPEED = 1.0


@dataclass(frozen=True)
class DatumSettings(Settings, Datum):
    """Origin of the map frame."""

    latitude: float = setting(47.397742, low=-90.0, high=90.0, unit="deg", text="latitude of the origin")
    longitude: float = setting(8.545594, low=-180.0, high=180.0, unit="deg", text="longitude of the origin")
    altitude: float = setting(488.0, low=-1000.0, high=10000.0, unit="m", text="altitude of the origin, AMSL")


MIN_STEP = 0.5  # m between the heights of two vehicles, whose paths may cross
_HEIGHT_GRID = 0.25  # m


@dataclass(frozen=True)
class SearchOptions(Settings):
    """Parameters of a planned search."""

    height: float = setting(12.0, low=5.0, high=100.0, unit="m", text="height of the lowest vehicle over the ground")
    height_step: float = setting(
        1.0,
        low=MIN_STEP,
        high=10.0,
        unit="m",
        text="height difference of consecutive vehicles; reduced if people would be too small from the highest",
    )
    speed: float = setting(5.0, low=0.5, high=15.0, unit="m/s", text="speed over ground")
    gimbal_pitch: float = setting(-60.0, low=-90.0, high=-5.0, unit="deg", text="camera pitch, negative down")
    person_pixels: float = setting(
        12.0, low=1.0, high=200.0, unit="px", text="people at least this high in the image count as seen"
    )
    picture_margin: float = setting(0.05, low=0.0, high=0.4, text="fraction of the image ignored at each edge")
    reach: float = setting(
        30.0, low=1.0, high=1000.0, unit="m", text="the ground counts as seen up to this far ahead of the vehicle"
    )
    overlap: float = setting(
        0.2, low=0.0, high=0.8, text="fraction of the footprint's width seen from both neighbouring lanes"
    )
    pictures: float = setting(4.0, low=1.0, high=50.0, text="number of images that show every place")
    picture_rate: float = setting(2.0, low=0.1, high=60.0, unit="Hz", text="images the detector processes per second")
    turn_time: float = setting(3.0, low=0.0, high=60.0, unit="s", text="time lost in a turn")

    @property
    def coverage(self) -> CoverageOptions:
        """Spacing and cost of the lanes."""
        depth = min(max(self.pictures * self.speed / self.picture_rate, 1.0), 100.0)
        return CoverageOptions(self.overlap, depth, self.speed, self.turn_time)

    def heights(self, camera: Pinhole, count: int) -> NDArray[np.float64]:
        """Return the heights of ``count`` vehicles, m, lowest first.

        Raises:
            ValueError: people would be too small from the highest, even at the minimum height step.
        """
        lowest = self.footprint(camera, self.height)
        highest = self.height + (count - 1) * self.height_step
        if not self._sees(camera, highest, 0.0):
            depth = min(self.coverage.depth, 0.5 * (lowest.far - lowest.near))
            lower = np.arange(self.height, highest, _HEIGHT_GRID)
            highest = max(float(height) for height in lower if self._sees(camera, float(height), depth))
        if highest - self.height < (count - 1) * MIN_STEP:
            raise ValueError(
                f"height: {count} vehicles that are at least {MIN_STEP:g} m above each other, the lowest at "
                f"{self.height:g} m, are not allowed: from above {highest:g} m a person is too small; fly lower or "
                "with fewer vehicles"
            )
        return np.linspace(self.height, highest, count)

    def _sees(self, camera: Pinhole, height: float, depth: float) -> bool:
        """Return whether people are large enough from a height, on a band at least ``depth`` m deep."""
        try:
            seen = self.footprint(camera, height)
        except ValueError:
            return False
        return seen.far - seen.near >= depth

    def footprint(self, camera: Pinhole, height: float) -> ImageFootprint:
        """Return the footprint of a camera at a height.

        Raises:
            ValueError: people would be too small.
        """
        return footprint(
            camera,
            height,
            self.gimbal_pitch,
            pixels=self.person_pixels,
            margin=self.picture_margin,
            reach=self.reach,
        )


@dataclass(frozen=True)
class VehiclePlan:
    """Plan of one vehicle.

    Attributes:
        piece: its part of the region, m ENU.
        height: m over the ground at home.
        home: takeoff and landing place, m ENU.
        path: waypoints, m ENU.
        seen: camera footprint at that height.
    """

    piece: Polygon
    height: float
    home: Point
    path: tuple[Waypoint, ...]
    seen: ImageFootprint


def plan_search(
    region: Polygon, homes: Mapping[str, Point], camera: Pinhole, options: SearchOptions | None = None
) -> dict[str, VehiclePlan]:
    """Return the plan of each vehicle.

    Args:
        region: Region to search, see ``region.make_region``.
        homes: home position of each vehicle, m ENU, by name. The first flies lowest.
        camera: intrinsics, the same for all vehicles.
        options: see :class:`SearchOptions`.

    Raises:
        RegionError: the region cannot be divided into that many pieces.
        ValueError: people would be too small from one of the heights.
    """
    chosen = options or SearchOptions()
    names = list(homes)
    pieces = divide(region, len(names))
    centres = [(piece.centroid.x, piece.centroid.y) for piece in pieces]
    far = np.array([[math.dist(centre, homes[name]) for centre in centres] for name in names])
    _, of = linear_sum_assignment(far**2)  # squares, so that no flight to a piece is much longer than the others
    heights = chosen.heights(camera, len(names)).tolist()
    plans = {}
    for i, (name, height) in enumerate(zip(names, heights, strict=True)):
        seen = chosen.footprint(camera, height)
        piece = pieces[of[i]]
        path = cover(piece, seen, chosen.coverage, homes[name])
        plans[name] = VehiclePlan(piece, height, homes[name], tuple(path), seen)
    return plans


# missions


def waypoint_item(waypoint: Waypoint, height: float, datum: Datum) -> PlanItem:
    """Return the mission item of a waypoint, ``height`` m over home."""
    yaw = (90.0 - math.degrees(waypoint.heading)) % 360.0
    x, y = datum.place(waypoint.x, waypoint.y)
    return PlanItem(plan.WAYPOINT, qgc_plan.FRAME_RELATIVE, (0.0, 0.0, 0.0, yaw), x, y, height)


def mission_items(vehicle: VehiclePlan, options: SearchOptions, datum: Datum) -> Items:
    """Return a vehicle's mission: take off, point the camera, set the speed, fly the path, return."""
    home = datum.place(*vehicle.home)
    first = [
        PlanItem(plan.TAKEOFF, qgc_plan.FRAME_RELATIVE, (0.0, 0.0, 0.0, NAN), *home, vehicle.height),
        _command(plan.MOUNT_CONTROL, options.gimbal_pitch, 0.0, 0.0, 0.0, last=_MOUNT_BY_MAVLINK),
        _command(plan.CHANGE_SPEED, _GROUND_SPEED, options.speed, -1.0, 0.0),
    ]
    path = [waypoint_item(waypoint, vehicle.height, datum) for waypoint in vehicle.path]
    return (*first, *path, _command(plan.RETURN, 0.0, 0.0, 0.0, 0.0))


def _command(command: int, *params: float, last: float = 0.0) -> PlanItem:
    one, two, three, four = params
    return PlanItem(command, FRAME_MISSION, (one, two, three, four), 0.0, 0.0, last)


def to_plan(vehicle: VehiclePlan, options: SearchOptions, datum: Datum) -> qgc_plan.Plan:
    """Return the content of a vehicle's .plan file."""
    home = (*datum.place(*vehicle.home), datum.altitude)
    return qgc_plan.Plan(mission_items(vehicle, options, datum), home=home, hover_speed=options.speed)


def write_plans(
    folder: str | Path, plans: Mapping[str, VehiclePlan], options: SearchOptions, datum: Datum
) -> dict[str, Path]:
    """Write ``<vehicle>.plan`` files into a folder, creating it if necessary; return their paths by vehicle.

    Raises:
        OSError: a file cannot be written.
    """
    Path(folder).mkdir(parents=True, exist_ok=True)
    files = {name: Path(folder) / f"{name}{qgc_plan.SUFFIX}" for name in plans}
    for name, vehicle in plans.items():
        qgc_plan.write(files[name], to_plan(vehicle, options, datum))
    return files


# command line


def main(arguments: Sequence[str] | None = None) -> int:
    """Run ``plan_search.py``; return the exit status."""
    parser = argparse.ArgumentParser(
        prog="plan_search.py",
        description="Divide a region among vehicles and write a QGroundControl plan file for each.",
    )
    datum = DatumSettings()
    parser.add_argument("region", help="YAML file {region: [[x, y], ...], holes: [...]}, m ENU in the map frame")
    parser.add_argument("--vehicles", default="typhoon_h480:6", help="fleet, as typhoon_h480:6 (the default)")
    parser.add_argument("--rows", type=int, default=3, help="vehicles per row of the spawn grid (3)")
    parser.add_argument("--out", default="plans", help="folder for the plan files (plans)")
    for name, three, default, what in (
        ("--datum", ("LAT", "LON", "ALT"), vars(datum).values(), "map origin: deg, deg, m above sea level"),
        ("--camera", ("WIDTH", "HEIGHT", "FOV"), (640, 360, 2.0), "image, px, and horizontal field of view, rad"),
    ):
        help_text = f"{what} ({' '.join(f'{value:g}' for value in default)})"
        parser.add_argument(name, type=float, nargs=3, metavar=three, default=tuple(default), help=help_text)
    SearchOptions.add_arguments(parser)
    given = parser.parse_args(arguments)
    try:
        options = SearchOptions.from_arguments(given)
        fleet = parse_fleet(given.vehicles)
        places = spawn_grid(fleet, given.rows)
        homes = {vehicle.name: (x, y) for vehicle, (x, y, _) in zip(fleet, places, strict=True)}
        width, height, fov = given.camera
        camera = Pinhole.of_view(int(width), int(height), fov)
        plans = plan_search(read_region(given.region), homes, camera, options)
        files = write_plans(given.out, plans, options, DatumSettings(*given.datum))
    except (RegionError, FleetError, ValueError, OSError) as error:
        print(error, file=sys.stderr)
        return 2
    for name, vehicle in plans.items():
        way = length(vehicle.path, vehicle.home)
        print(
            f"{files[name]}: {vehicle.piece.area:.0f} m^2 at {vehicle.height:g} m, {len(vehicle.path) // 2} lanes, "
            f"{turns(vehicle.path)} turns, {way:.0f} m, about {way / options.speed:.0f} s"
        )
    return 0
