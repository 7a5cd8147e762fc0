"""A search as missions: a region shared out among vehicles, a path for each, and QGroundControl's .plan files of them.

Vehicles fly at heights of their own, so that their ways may cross. Missions are in latitude and longitude; the way to
the map's metres and back is the autopilots' own projection.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from shapely.geometry import Polygon

from xtdrone_control.autopilot.navigator import plan
from xtdrone_control.autopilot.navigator.plan import FRAME_MISSION, Items, PlanItem
from xtdrone_control.fleet import FleetError, parse_fleet, spawn_grid
from xtdrone_control.geodesy import geo
from xtdrone_control.pinhole import Pinhole
from xtdrone_control.plans import qgc_plan
from xtdrone_control.settings import check_range

from .coverage import CoverageOptions, Footprint, Point, Waypoint, cover, footprint, length, turns
from .region import RegionError, divide, read_region

NAN = math.nan
_MOUNT_BY_MAVLINK = 2.0  # MAV_MOUNT_MODE_MAVLINK_TARGETING
_GROUND_SPEED = 1.0


@dataclass(frozen=True)
class Datum:
    """Where the map frame's origin is: degrees, degrees, m AMSL."""

    latitude: float = 47.397742
    longitude: float = 8.545594
    altitude: float = 488.0

    def __post_init__(self) -> None:
        """Check it.

        Raises:
            ValueError: out of range.
        """
        check_range("latitude", self.latitude, -90.0, 90.0, "deg")
        check_range("longitude", self.longitude, -180.0, 180.0, "deg")
        check_range("altitude", self.altitude, -1000.0, 10000.0, "m")

    def place(self, x: float, y: float) -> tuple[float, float]:
        """Return latitude and longitude, degrees, of a place in the map, m ENU."""
        return geo.reproject(y, x, self.latitude, self.longitude)

    def local(self, latitude: float, longitude: float) -> Point:
        """Return the place in the map, m ENU, of latitude and longitude, degrees."""
        north, east = geo.project(latitude, longitude, self.latitude, self.longitude)
        return east, north


LEAST_STEP = 0.5  # m between the heights of two vehicles, whose ways may cross
_HEIGHT_GRID = 0.25  # m


@dataclass(frozen=True)
class SearchOptions:
    """How a search is flown.

    Attributes:
        height: of the lowest vehicle, m over the ground, 5 to 100.
        height_step: from one vehicle to the next, m, 0.5 to 10; less, where people would be too small from the highest.
        speed: m/s over ground, 0.5 to 15.
        gimbal_pitch: of the camera, deg, negative down, -90 to -5; also while a candidate is looked at.
        person_pixels: height in the picture from which on people count as seen, px, 1 to 200.
        picture_margin: share of the picture at each edge that does not count, 0 to 0.4.
        reach: how far ahead of the vehicle the ground counts as seen, m, 1 to 1000.
        overlap: share of the footprint's width that neighbouring lanes both see, 0 to 0.8.
        pictures: how many pictures show every place, 1 to 50.
        picture_rate: pictures a second that a detector looks at, 0.1 to 60 Hz.
        turn_time: s that a turn costs, 0 to 60.
    """

    height: float = 12.0
    height_step: float = 1.0
    speed: float = 5.0
    gimbal_pitch: float = -60.0
    person_pixels: float = 12.0
    picture_margin: float = 0.05
    reach: float = 30.0
    overlap: float = 0.2
    pictures: float = 4.0
    picture_rate: float = 2.0
    turn_time: float = 3.0

    def __post_init__(self) -> None:
        """Check them.

        Raises:
            ValueError: one is out of range.
        """
        check_range("height", self.height, 5.0, 100.0, "m")
        check_range("height_step", self.height_step, LEAST_STEP, 10.0, "m")
        check_range("speed", self.speed, 0.5, 15.0, "m/s")
        check_range("gimbal_pitch", self.gimbal_pitch, -90.0, -5.0, "deg")
        check_range("person_pixels", self.person_pixels, 1.0, 200.0, "px")
        check_range("picture_margin", self.picture_margin, 0.0, 0.4)
        check_range("reach", self.reach, 1.0, 1000.0, "m")
        check_range("overlap", self.overlap, 0.0, 0.8)
        check_range("pictures", self.pictures, 1.0, 50.0)
        check_range("picture_rate", self.picture_rate, 0.1, 60.0, "Hz")
        check_range("turn_time", self.turn_time, 0.0, 60.0, "s")

    @property
    def coverage(self) -> CoverageOptions:
        """How lanes are laid."""
        depth = min(max(self.pictures * self.speed / self.picture_rate, 1.0), 100.0)
        return CoverageOptions(self.overlap, depth, self.speed, self.turn_time)

    def heights(self, camera: Pinhole, count: int) -> NDArray[np.float64]:
        """Return the heights of ``count`` vehicles, m, lowest first.

        Raises:
            ValueError: nobody would be seen from one of them, however little they are apart.
        """
        lowest = self.footprint(camera, self.height)
        highest = self.height + (count - 1) * self.height_step
        if not self._sees(camera, highest, 0.0):
            depth = min(self.coverage.depth, 0.5 * (lowest.far - lowest.near))
            lower = np.arange(self.height, highest, _HEIGHT_GRID)
            highest = max(float(height) for height in lower if self._sees(camera, float(height), depth))
        if highest - self.height < (count - 1) * LEAST_STEP:
            raise ValueError(
                f"height: {count} vehicles that are at least {LEAST_STEP:g} m above each other, the lowest at "
                f"{self.height:g} m, are not allowed: from above {highest:g} m a person is too small; fly lower or "
                "with fewer vehicles"
            )
        return np.linspace(self.height, highest, count)

    def _sees(self, camera: Pinhole, height: float, depth: float) -> bool:
        """Return whether people are seen from a height, on a band of ``depth`` m or more."""
        try:
            seen = self.footprint(camera, height)
        except ValueError:
            return False
        return seen.far - seen.near >= depth

    def footprint(self, camera: Pinhole, height: float) -> Footprint:
        """Return the ground that a camera shows from a height.

        Raises:
            ValueError: nobody would be seen.
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
    """What one vehicle searches.

    Attributes:
        piece: the part of the region, m ENU.
        height: m over the ground at home.
        home: where it starts and lands, m ENU.
        path: waypoints, m ENU.
        seen: the camera's footprint from that height.
    """

    piece: Polygon
    height: float
    home: Point
    path: tuple[Waypoint, ...]
    seen: Footprint


def plan_search(
    region: Polygon, homes: Mapping[str, Point], camera: Pinhole, options: SearchOptions | None = None
) -> dict[str, VehiclePlan]:
    """Return the plan of each vehicle.

    Args:
        region: what to search, see ``region.make_region``.
        homes: where each vehicle starts, m ENU, by name. The first flies lowest.
        camera: of all vehicles.
        options: see :class:`SearchOptions`.

    Raises:
        RegionError: the region cannot be divided among so many.
        ValueError: from one of the heights nobody would be seen; the message says why.
    """
    chosen = options or SearchOptions()
    names = list(homes)
    pieces = divide(region, len(names))
    centres = [(piece.centroid.x, piece.centroid.y) for piece in pieces]
    far = np.array([[math.dist(centre, homes[name]) for centre in centres] for name in names])
    _, of = linear_sum_assignment(far**2)  # squares: no vehicle shall have a much longer way than the others
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
    """Return what a .plan file of a vehicle holds."""
    home = (*datum.place(*vehicle.home), datum.altitude)
    return qgc_plan.Plan(mission_items(vehicle, options, datum), home=home, hover_speed=options.speed)


def write_plans(
    folder: str | Path, plans: Mapping[str, VehiclePlan], options: SearchOptions, datum: Datum
) -> dict[str, Path]:
    """Write ``<vehicle>.plan`` files into a folder, which is made if need be; return them by vehicle.

    Raises:
        OSError: they cannot be written there.
    """
    Path(folder).mkdir(parents=True, exist_ok=True)
    files = {name: Path(folder) / f"{name}{qgc_plan.SUFFIX}" for name in plans}
    for name, vehicle in plans.items():
        qgc_plan.write(files[name], to_plan(vehicle, options, datum))
    return files


# the program


def main(arguments: Sequence[str] | None = None) -> int:
    """Plan a search from the command line; return the exit status."""
    parser = argparse.ArgumentParser(
        prog="plan_search.py",
        description="Divide a region among vehicles and write a QGroundControl plan file for each.",
    )
    defaults, datum = SearchOptions(), Datum()
    parser.add_argument("region", help="YAML file {region: [[x, y], ...], holes: [...]}, m ENU in the map frame")
    parser.add_argument("--vehicles", default="typhoon_h480:6", help="fleet, as typhoon_h480:6 (the default)")
    parser.add_argument("--rows", type=int, default=3, help="vehicles side by side on the spawn grid (3)")
    parser.add_argument("--out", default="plans", help="folder for the plan files (plans)")
    for name, three, default, what in (
        ("--datum", ("LAT", "LON", "ALT"), vars(datum).values(), "the map's origin: deg, deg, m over sea level"),
        ("--camera", ("WIDTH", "HEIGHT", "FOV"), (640, 360, 2.0), "picture, px, and horizontal field of view, rad"),
    ):
        help_text = f"{what} ({' '.join(f'{value:g}' for value in default)})"
        parser.add_argument(name, type=float, nargs=3, metavar=three, default=tuple(default), help=help_text)
    for name, value in vars(defaults).items():
        parser.add_argument(f"--{name.replace('_', '-')}", type=float, default=value, help=f"({value:g})")
    given = parser.parse_args(arguments)
    try:
        options = replace(defaults, **{name: getattr(given, name) for name in vars(defaults)})
        fleet = parse_fleet(given.vehicles)
        places = spawn_grid(fleet, given.rows)
        homes = {vehicle.name: (x, y) for vehicle, (x, y, _) in zip(fleet, places, strict=True)}
        width, height, fov = given.camera
        camera = Pinhole.of_view(int(width), int(height), fov)
        plans = plan_search(read_region(given.region), homes, camera, options)
        files = write_plans(given.out, plans, options, Datum(*given.datum))
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
