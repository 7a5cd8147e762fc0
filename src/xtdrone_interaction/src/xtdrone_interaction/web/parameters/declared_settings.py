"""Declarations of the nodes' parameters in the settings' classes, read from the tables generated from these.

The classes themselves would have to be imported with all their nodes' modules; docs/settings.md has the same tables,
and a test holds it to the classes.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass

_TABLE = re.compile(r"^<!-- (?P<name>\w+) -->$")
_ROW = re.compile(r"^\| `(?P<name>\w+)` \| (?P<rest>.*) \|$")
_CELL = re.compile(r"(?<!\\)\|")
_CLASSES: dict[str, tuple[str, ...]] = {
    r"simulator": ("NodeSettings", "FullSettings"),
    r"simplified_simulator": ("NodeSettings", "SimplifiedSettings"),
    r"\w+_communication": ("CommandSettings",),
    r"follower_\d+": ("NeighbourSettings", "HostedCommunication", "TurnSettings"),
    r"leader": ("NeighbourSettings", "HostedCommunication"),
    r"cameras": ("CameraSettings",),
    r"lidars": ("LidarSettings",),
    r"uwb": ("UwbSettings",),
    r"video": ("VideoSettings",),
    r"robot_tf": ("TfSettings",),
    r"yolo": ("DetectionOptions", "GroundOptions"),
    r"yolo_human_tracking": ("TrackingOptions",),
    r"planner": ("PlannerSettings", "TrajectorySettings", "TimingSettings", "SensorChoice"),
    r"safety_filter": ("SafetySettings",),
    r"radio": ("NetworkOptions",),
    r"\w+_lidar_odometry": ("LidarOdometryOptions",),
    r"\w+_loop_closure": ("LoopNodeOptions",),
    r"apriltag": ("AprilTagOptions",),
    r"search_mission": ("MissionSettings",),
    r"formation_director": ("DirectorSettings",),
    r"crossing_director": ("CrossingSettings",),
    r"landing_director": ("LandingSettings",),
    r"swarm_markers": ("MarkerSettings",),
}
"""The classes of the nodes that the launch files start, by the nodes' names."""


@dataclass(frozen=True)
class Declared:
    """A declared parameter.

    Attributes:
        default: as a user writes it.
        range: allowed values; may be empty.
        unit: may be empty.
        meaning: one phrase.
    """

    default: str
    range: str
    unit: str
    meaning: str


Tables = Mapping[str, Mapping[str, Declared]]
"""Parameters by class and name."""


def read_declared(page: str) -> Tables:
    """Return all declared parameters.

    Args:
        page: Markdown of docs/settings.md.
    """
    found: dict[str, dict[str, Declared]] = {}
    table = ""
    for line in page.splitlines():
        if heading := _TABLE.match(line):
            table = heading["name"]
        elif row := _ROW.match(line):
            cells = [cell.strip().replace("\\|", "|") for cell in _CELL.split(row["rest"])]
            if len(cells) == 4:
                found.setdefault(table, {})[row["name"]] = Declared(*cells)
    return found


def declared_for(tables: Tables, parameter: str) -> Declared | None:
    """Return the declaration of a node's private parameter; None for an undeclared one, or for an unknown node.

    Args:
        tables: all declared parameters.
        parameter: full name, such as ``/simulator/speed``.
    """
    node, _, name = parameter.rpartition("/")
    node = node.rpartition("/")[2]
    classes = next((names for pattern, names in _CLASSES.items() if re.fullmatch(pattern, node)), ())
    return next((tables[cls][name] for cls in classes if name in tables.get(cls, {})), None)
