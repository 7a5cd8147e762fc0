"""Configurations of rviz for a fleet: one vehicle, the formation, the search.

``python -m xtdrone_interaction.rviz.view_configurations`` writes the shipped ones, ``xtdrone_rviz/config/*.rviz``.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from xtdrone_common.fleet import parse_fleet
from xtdrone_coordination.patterns import Patterns
from xtdrone_interaction.command_options import OptionError, repository

Config = dict[str, Any]
Array = NDArray[np.float64]
Point = tuple[float, float, float]

MARKERS_TOPIC = "/xtdrone/markers"
SHIPPED = {"vehicle": "iris:1", "formation": "iris:9", "search": "typhoon_h480:6"}
"""Fleets of the shipped views by name."""

FOR_MARKERS: dict[str, dict[str, float]] = {"vehicle": {"scale": 0.3}, "search": {"scale": 6.0, "spot": 2.0}}
"""Parameters of the markers node for close and distant views."""

_REGION_MIDDLE = (60.0, 0.0, 0.0)
"""Approximate centre of the default search region, m, map."""
_REGION_DISTANCE = 115.0  # m, for a view of the whole region
_SEARCH_PITCH, _SEARCH_YAW = 0.75, 4.4  # rad
_FORMATION_PITCH, _FORMATION_YAW = 0.42, 3.55  # rad
_NEAREST = 20.0  # m
_ASIDE = 10.0  # m around the flown area, to include finds
_LARGEST = 50.0  # limit of the markers' scale and spots

_PATTERNS = ("origin", "cube", "pyramid", "triangle")
_FARTHEST = 1.8  # distance of a fixed camera on the formation, relative to that of one that follows the leader
_FIELD = math.pi / 4.0  # rad, vertical field of view of rviz
_MARGIN = 1.0  # m around a visible vehicle

_BACKGROUND = "232; 236; 242"
_GRID = "112; 120; 134"


def shipped_folder() -> Path:
    """Return the folder of the shipped .rviz files."""
    return repository() / "src" / "xtdrone_rviz" / "config"


def make_view(name: str, vehicles: Sequence[str], flown: Array | None = None) -> str:
    """Generate the text of an .rviz file.

    Args:
        name: one of SHIPPED.
        vehicles: names, such as ``iris_0``; the first one is the focus, or the leader.
        flown: positions that the search view must include, shape (k, 3), m, map; None: the default search region. The
            formation's camera is fixed if it can show all of them from nearby, otherwise it follows the leader.

    Raises:
        OptionError: unknown view.
    """
    if name not in _VIEWS:
        raise OptionError(f"view: {name!r} is unknown; there are: {', '.join(_VIEWS)}")
    return _text(_VIEWS[name](list(vehicles), flown))


def marker_parameters(name: str, flown: Array | None = None) -> dict[str, float]:
    """Return the parameters of the markers node for a view; see ``make_view``."""
    found = dict(FOR_MARKERS.get(name, {}))
    if name == "search":
        farther = _search_camera(flown)[1] / _REGION_DISTANCE
        found = {key: min(value * farther, _LARGEST) for key, value in found.items()}
    return found


def _vehicle(vehicles: list[str], _: Array | None) -> Config:
    hidden = {"slots": False, "topology": False}
    return _config(vehicles, _grid(100, 2.0), hidden, _orbit(f"{vehicles[0]}/base_link", 2.8, 0.35, 3.9))


def _formation(vehicles: list[str], flown: Array | None) -> Config:
    slots = _slots(len(vehicles))
    middle = 0.5 * (slots.min(axis=0) + slots.max(axis=0))
    focus = (0.0, 0.0, round(float(middle[2]), 2))
    distance = _distance(slots - focus, _FORMATION_PITCH, _FORMATION_YAW)
    target = f"{vehicles[0]}/base_link"
    if flown is not None:
        low, high = flown.min(axis=0), flown.max(axis=0)
        x, y, z = np.round(0.5 * (low + high), 2).tolist()
        corners = np.array(list(itertools.product(*zip(low, high, strict=True))))
        farther = _distance(corners - (x, y, z), _FORMATION_PITCH, _FORMATION_YAW)
        if farther <= _FARTHEST * distance:
            target, focus, distance = "map", (x, y, z), farther
    return _config(vehicles, _grid(60, 2.0), {}, _orbit(target, distance, _FORMATION_PITCH, _FORMATION_YAW, focus))


def _slots(count: int) -> Array:
    """Return all slots of the usual patterns and the leader, shape (k, 3), m from the leader."""
    places = [np.zeros((1, 3))]
    if count > 1:
        patterns = Patterns(count)
        places += [patterns.offsets(name) for name in _PATTERNS]
    return np.concatenate(places)


def _distance(places: Array, pitch: float, yaw: float) -> float:
    """Return the distance, m, from the focus to a camera that sees some positions in a 16:9 picture.

    Args:
        places: positions, shape (k, 3), m from the focus.
        pitch, yaw: direction of the camera from the focus, rad.
    """
    away = np.array([math.cos(yaw) * math.cos(pitch), math.sin(yaw) * math.cos(pitch), math.sin(pitch)])
    right = np.array([-math.sin(yaw), math.cos(yaw), 0.0])
    up = np.cross(away, right)
    high = math.tan(0.5 * _FIELD)
    wide = high * 16.0 / 9.0
    aside = np.maximum((np.abs(places @ right) + _MARGIN) / wide, (np.abs(places @ up) + _MARGIN) / high)
    return float((places @ away + aside).max())


def _search_camera(flown: Array | None) -> tuple[Point, float]:
    """Return focus, m, map, and distance, m, of the camera of the search."""
    if flown is None:
        return _REGION_MIDDLE, _REGION_DISTANCE
    low, high = flown.min(axis=0) - _ASIDE, flown.max(axis=0) + _ASIDE
    x, y, _ = np.round(0.5 * (low + high), 2).tolist()
    corners = np.array(list(itertools.product(*zip(low, high, strict=True))))
    distance = _distance(corners - (x, y, 0.0), _SEARCH_PITCH, _SEARCH_YAW)
    return (x, y, 0.0), max(round(distance, 1), _NEAREST)


def _search(vehicles: list[str], flown: Array | None) -> Config:
    hidden = {"slots": False, "topology": False, "avoidance": False}
    focus, distance = _search_camera(flown)
    return _config(vehicles, _grid(60, 5.0), hidden, _orbit("map", distance, _SEARCH_PITCH, _SEARCH_YAW, focus))


_VIEWS: dict[str, Callable[[list[str], Array | None], Config]] = {
    "vehicle": _vehicle,
    "formation": _formation,
    "search": _search,
}


def _config(vehicles: Sequence[str], grid: Config, namespaces: Config, view: Config) -> Config:
    displays = [grid, _markers(namespaces), *(_robot(vehicle) for vehicle in vehicles)]
    return {
        "Panels": [
            {"Class": "rviz/Displays", "Name": "Displays"},
            {"Class": "rviz/Views", "Name": "Views"},
        ],
        "Visualization Manager": {
            "Class": "",
            "Displays": displays,
            "Enabled": True,
            "Global Options": {
                "Background Color": _BACKGROUND,
                "Default Light": True,
                "Fixed Frame": "map",
                "Frame Rate": 30,
            },
            "Name": "root",
            "Tools": [{"Class": "rviz/MoveCamera"}, {"Class": "rviz/Select"}, {"Class": "rviz/Measure"}],
            "Value": True,
            "Views": {"Current": view, "Saved": None},
        },
        "Window Geometry": {"Width": 1400, "Height": 900},
    }


def _grid(cells: int, size: float) -> Config:
    return {
        "Class": "rviz/Grid",
        "Name": "Ground",
        "Enabled": True,
        "Plane": "XY",
        "Plane Cell Count": cells,
        "Cell Size": size,
        "Color": _GRID,
        "Alpha": 0.7,
        "Line Style": {"Value": "Lines"},
        "Reference Frame": "map",
        "Value": True,
    }


def _markers(namespaces: Config) -> Config:
    # The queue counts single markers and has to hold a whole array.
    return {
        "Class": "rviz/MarkerArray",
        "Name": "Swarm",
        "Enabled": True,
        "Marker Topic": MARKERS_TOPIC,
        "Namespaces": namespaces,
        "Queue Size": 10_000,
        "Value": True,
    }


def _robot(vehicle: str) -> Config:
    return {
        "Class": "rviz/RobotModel",
        "Name": vehicle,
        "Enabled": True,
        "Robot Description": f"/{vehicle}/robot_description",
        "TF Prefix": vehicle,
        "Update Interval": 0,
        "Visual Enabled": True,
        "Collision Enabled": False,
        "Alpha": 1,
        "Value": True,
    }


def _orbit(target: str, distance: float, pitch: float, yaw: float, focus: Point = (0.0, 0.0, 0.0)) -> Config:
    return {
        "Class": "rviz/Orbit",
        "Name": "Current View",
        "Distance": round(distance, 2),
        "Focal Point": dict(zip("XYZ", focus, strict=True)),
        "Near Clip Distance": 0.05,
        "Pitch": pitch,
        "Target Frame": target,
        "Value": "Orbit (rviz)",
        "Yaw": yaw,
    }


def _text(config: Config) -> str:
    return yaml.safe_dump(config, sort_keys=False, width=120)


def main() -> None:
    """Write the shipped files."""
    for name, fleet in SHIPPED.items():
        vehicles = [vehicle.name for vehicle in parse_fleet(fleet)]
        (shipped_folder() / f"{name}.rviz").write_text(make_view(name, vehicles), encoding="utf-8")


if __name__ == "__main__":
    main()
