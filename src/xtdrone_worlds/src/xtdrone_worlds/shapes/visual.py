"""Visual and collision shapes of links, scenery and people.

The readers of SDF, URDF and people produce them; renderer and physics use them. Metres, quaternions (w, x, y, z).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from xtdrone_common.poses import Pose
from xtdrone_common.rotation import Vector

Colour = tuple[float, float, float, float]


@dataclass(frozen=True)
class Box:
    """A box around its origin; ``size`` along x, y, z."""

    size: Vector


@dataclass(frozen=True)
class Cylinder:
    """A cylinder around its origin, its axis along z."""

    radius: float
    length: float


@dataclass(frozen=True)
class Sphere:
    """A sphere around its origin."""

    radius: float


@dataclass(frozen=True)
class Mesh:
    """A triangle mesh from a Wavefront file (.obj), scaled."""

    path: Path
    scale: Vector = (1.0, 1.0, 1.0)


Geometry = Box | Cylinder | Sphere | Mesh


@dataclass(frozen=True)
class Visual:
    """A coloured or textured shape.

    Attributes:
        geometry: geometric shape.
        pose: pose in the link's frame.
        colour: red, green, blue, opacity, 0..1; multiplied with the texture, if any.
        texture: image file (PNG or JPEG); None for plain colour.
    """

    geometry: Geometry
    pose: Pose = field(default_factory=Pose)
    colour: Colour = (0.7, 0.7, 0.7, 1.0)
    texture: Path | None = None


@dataclass(frozen=True)
class Collision:
    """A collision shape; ``pose`` in the link's frame."""

    geometry: Geometry
    pose: Pose = field(default_factory=Pose)
