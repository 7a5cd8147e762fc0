"""Worlds in SDF files: the subset of Gazebo Classic's format in docs/worlds.md."""

from xtdrone_worlds.worlds.sdf.world_files import load_world_file, read_model, read_world, world_file, world_names
from xtdrone_worlds.worlds.sdf.world_records import (
    DEFAULT_INERTIAL,
    Light,
    SdfActor,
    SdfError,
    SdfJoint,
    SdfLink,
    SdfModel,
    SdfWorld,
    Trajectory,
    Waypoint,
)
from xtdrone_worlds.worlds.sdf.world_writer import write_world

__all__ = [
    "DEFAULT_INERTIAL",
    "Light",
    "SdfActor",
    "SdfError",
    "SdfJoint",
    "SdfLink",
    "SdfModel",
    "SdfWorld",
    "Trajectory",
    "Waypoint",
    "load_world_file",
    "read_model",
    "read_world",
    "world_file",
    "world_names",
    "write_world",
]
