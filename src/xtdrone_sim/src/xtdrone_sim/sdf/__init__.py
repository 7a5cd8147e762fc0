"""Worlds from SDF files: a documented subset of what Gazebo Classic reads (see docs/worlds.md)."""

from .types import Light, SdfActor, SdfError, SdfLink, SdfModel, SdfWorld, Trajectory, Waypoint

__all__ = ["Light", "SdfActor", "SdfError", "SdfLink", "SdfModel", "SdfWorld", "Trajectory", "Waypoint"]
