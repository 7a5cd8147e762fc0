"""Shapes of vehicles, models and people for the page: primitives by their sizes, meshes and textures by number.

A page names a mesh or texture by the number that a description gave it; paths stay here.
"""

from __future__ import annotations

import base64
import io
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from xtdrone_common.poses import Pose, compose
from xtdrone_interaction.web.server.methods import CallError
from xtdrone_sim.vehicles.vehicle_model import VehicleModel
from xtdrone_worlds.shapes.triangles import triangles_of
from xtdrone_worlds.shapes.visual import Box, Cylinder, Geometry, Mesh, Visual

_MOST_TRIANGLES = 200_000
_TEXTURE_SIZE = 512  # px, the longer side
_ROTOR = "rotor_"


class ShapeStore:
    """Numbers meshes and textures, and gives their content."""

    def __init__(self) -> None:
        self._meshes: dict[Path, int] = {}
        self._textures: dict[Path, int] = {}

    def describe(self, visual: Visual, parent: Pose) -> dict[str, Any]:
        """Return a shape with its pose [x, y, z, w, x, y, z] in the frame in which ``parent`` is given."""
        pose = compose(parent, visual.pose)
        return {
            **self._geometry(visual.geometry),
            "pose": [*pose.position, *pose.orientation],
            "colour": list(visual.colour),
            "texture": None if visual.texture is None else _numbered(self._textures, visual.texture),
        }

    def mesh(self, number: int) -> dict[str, str]:
        """Return corners, normals and texture coordinates of a mesh's triangles, base64 of little-endian float32.

        Raises:
            CallError: there is no such mesh, or it is too large or unreadable.
        """
        triangles = triangles_of(Mesh(_of_number(self._meshes, "mesh", number)))
        if len(triangles.points) > _MOST_TRIANGLES:
            raise CallError(f"mesh: {len(triangles.points)} triangles are not allowed, {_MOST_TRIANGLES}")
        return {"points": _packed(triangles.points), "normals": _packed(triangles.normals), "uv": _packed(triangles.uv)}

    def texture(self, number: int) -> str:
        """Return a texture as a data URL.

        Raises:
            CallError: there is no such texture, or it is unreadable.
        """
        try:
            with Image.open(_of_number(self._textures, "texture", number)) as picture:
                picture.thumbnail((_TEXTURE_SIZE, _TEXTURE_SIZE))
                opaque = picture.mode in ("RGB", "L")
                content = io.BytesIO()
                picture.convert("RGB" if opaque else "RGBA").save(content, "JPEG" if opaque else "PNG")
        except OSError as error:
            raise CallError(f"texture: {error}") from error
        kind = "jpeg" if opaque else "png"
        return f"data:image/{kind};base64,{base64.b64encode(content.getvalue()).decode()}"

    def _geometry(self, shape: Geometry) -> dict[str, Any]:
        if isinstance(shape, Mesh):
            return {"kind": "mesh", "mesh": _numbered(self._meshes, shape.path), "size": list(shape.scale)}
        if isinstance(shape, Box):
            return {"kind": "box", "size": list(shape.size)}
        if isinstance(shape, Cylinder):
            return {"kind": "cylinder", "size": [shape.radius, shape.radius, shape.length]}
        return {"kind": "sphere", "size": [shape.radius] * 3}


def describe_vehicle(model: VehicleModel, store: ShapeStore) -> dict[str, Any]:
    """Return the shapes of a vehicle: those of its rigid body, and its rotors.

    Returns:
        ``body``: shapes in the body's frame, FLU; ``rotors``: position (m, FLU), radius (m) and direction (1
        counter-clockwise from above) of each.
    """
    poses = {model.urdf.root: Pose()}
    for joint in model.urdf.joints:
        poses[joint.child] = compose(poses[joint.parent], joint.pose)
    rotors = [link for link in model.urdf.links if link.name.startswith(_ROTOR)]
    body = [
        store.describe(visual, poses[link.name])
        for link in model.urdf.links
        if link not in rotors
        for visual in link.visuals
    ]
    record = model.record
    radius = _radius(visual.geometry for link in rotors for visual in link.visuals)
    count = int(record["rotor_count"])
    places, turns = record["rotor_position"][:count].tolist(), record["rotor_direction"][:count].tolist()
    return {
        "body": body,
        "rotors": [{"position": p, "radius": radius, "direction": d} for p, d in zip(places, turns, strict=True)],
    }


def _radius(shapes: Iterable[Geometry]) -> float:
    """Return the radius of rotors that are discs; a small default radius for other shapes."""
    return max((shape.radius for shape in shapes if isinstance(shape, Cylinder)), default=0.12)


def _numbered(known: dict[Path, int], path: Path) -> int:
    return known.setdefault(path, len(known))


def _of_number(known: dict[Path, int], what: str, number: object) -> Path:
    paths: Sequence[Path] = list(known)
    if not isinstance(number, int) or not 0 <= number < len(paths):
        raise CallError(f"{what}: {str(number)[:40]} is not allowed, 0 to {len(paths) - 1}")
    return paths[number]


def _packed(values: np.ndarray) -> str:
    return base64.b64encode(np.ascontiguousarray(values, "<f4").tobytes()).decode()
