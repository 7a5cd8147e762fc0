"""Models of a world in YAML, of one shape each: static, or, with a mass, subject to gravity and pushes."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from xtdrone_common.poses import Pose
from xtdrone_common.rotation import from_euler
from xtdrone_worlds.shapes.visual import Box, Collision, Cylinder, Geometry, Mesh, Sphere, Visual
from xtdrone_worlds.worlds.sdf.geometries.heightmaps import read_heightmap
from xtdrone_worlds.worlds.sdf.geometries.mesh_files import MeshPart, check_wavefront, read_mesh
from xtdrone_worlds.worlds.sdf.geometries.visuals_and_collisions import box_of, look_of, triple
from xtdrone_worlds.worlds.sdf.models.model_uris import resolve
from xtdrone_worlds.worlds.sdf.models.rigid_links import MOST_SHAPES
from xtdrone_worlds.worlds.sdf.world_records import SdfError, SdfLink, SdfModel
from xtdrone_worlds.worlds.sdf.xml_elements import Element, File
from xtdrone_worlds.worlds.urdf import Inertial

SHAPES = ("box", "cylinder", "sphere", "mesh", "heightmap")
MOST_MODELS = 10_000

_FIELDS = ("name", "pose", "mass", "colour", "texture", *SHAPES, "scale", "size", "texture_size")
_FAR = 1e5  # m
_HEAVIEST = 1e6  # kg


def read_models(given: object, file: Path) -> tuple[SdfModel, ...]:
    """Read the list ``models`` of a YAML file.

    Args:
        given: list of mappings, see docs/worlds.md.
        file: the file, for messages and for relative paths.

    Raises:
        SdfError: an unknown field or a value that is not allowed; the message names file, model and field.
    """
    if not isinstance(given, list) or len(given) > MOST_MODELS:
        raise SdfError(f"{file}: models: {_short(given)} is not allowed, a list of at most {MOST_MODELS} mappings")
    models: list[SdfModel] = []
    names = {"ground_plane"}
    for number, entry in enumerate(given):
        model = _Entry(entry, number, file).model()
        if model.name in names:
            raise SdfError(f"{file}: models: two models are called {model.name!r}")
        names.add(model.name)
        models.append(model)
    return tuple(models)


def _short(value: object) -> str:
    return repr(value)[:60]


class _Entry:
    """One model of the list."""

    def __init__(self, given: object, number: int, file: Path) -> None:
        self._file, self._place = file, f"models[{number}]"
        if not isinstance(given, Mapping):
            raise self._error("", given, f"a mapping with {', '.join(_FIELDS)}")
        self._given: Mapping[str, Any] = given
        for field in given:
            if field not in _FIELDS:
                raise SdfError(f"{file}: {self._place}: {_short(field)} is not known; there are {', '.join(_FIELDS)}")

    def _error(self, field: str, value: object, allowed: str) -> SdfError:
        place = f"{self._place} {field}".rstrip()
        return SdfError(f"{self._file}: {place}: {_short(value)} is not allowed, {allowed}")

    def _numbers(self, field: str, counts: tuple[int, ...], low: float, high: float, what: str) -> tuple[float, ...]:
        value = self._given[field]
        values = list(value) if isinstance(value, list) else [value]
        numbers = all(type(one) in (int, float) and low <= one <= high for one in values)
        if not numbers or len(values) not in counts:
            raise self._error(field, value, f"{what}, {low:g} to {high:g}")
        return tuple(map(float, values))

    def model(self) -> SdfModel:
        """Return the model."""
        name = self._given.get("name")
        if not isinstance(name, str) or not name.strip() or "::" in name:
            raise self._error("name", name, "text that is not empty, without ::")
        self._place = f"models {name!r}"
        forms = [field for field in SHAPES if field in self._given]
        if len(forms) != 1:
            found = " and ".join(forms) or "no shape"
            raise SdfError(f"{self._file}: {self._place}: has {found}, one of {', '.join(SHAPES)} is needed")
        self._check_fields(forms[0])
        visuals, collisions = self._shapes(forms[0])
        inertial = self._inertial(collisions)
        link = SdfLink("link", visuals=visuals, collisions=collisions, inertial=inertial)
        return SdfModel(name, self._pose(), inertial is None, (link,))

    def _check_fields(self, form: str) -> None:
        """Check that no field belongs to another shape."""
        owners = {"scale": "mesh", "size": "heightmap", "texture_size": "heightmap"}
        for field, owner in owners.items():
            if field in self._given and owner != form:
                raise self._error(field, self._given[field], f"it belongs to {owner}")
        if form == "heightmap" and "mass" in self._given:
            raise self._error("mass", self._given["mass"], "a heightmap is static")

    def _pose(self) -> Pose:
        if "pose" not in self._given:
            return Pose()
        values = self._numbers("pose", (3, 6), -_FAR, _FAR, "x, y, z, m, and optionally roll, pitch, yaw, rad")
        roll, pitch, yaw = values[3:] or (0.0, 0.0, 0.0)
        return Pose((values[0], values[1], values[2]), from_euler(roll, pitch, yaw))

    def _shapes(self, form: str) -> tuple[tuple[Visual, ...], tuple[Collision, ...]]:
        if form == "mesh":
            parts, solid = self._mesh()
        elif form == "heightmap":
            parts, solid = self._terrain()
        else:
            primitive = self._primitive(form)
            parts, solid = [(primitive, None)], [primitive]  # no colour and texture of its own
        look = self._look()
        visuals = [Visual(geometry, Pose(), *(look or look_of(part))) for geometry, part in parts]
        return tuple(visuals), tuple(Collision(geometry) for geometry in solid)

    def _primitive(self, form: str) -> Geometry:
        if form == "box":
            return Box(triple(self._numbers("box", (3,), 1e-4, _FAR, "three sides, m")))
        if form == "sphere":
            return Sphere(self._numbers("sphere", (1,), 1e-4, _FAR, "a radius, m")[0])
        radius, length = self._numbers("cylinder", (2,), 1e-4, _FAR, "radius and length, m")
        return Cylinder(radius, length)

    def _mesh(self) -> tuple[list[tuple[Geometry, MeshPart | None]], list[Geometry]]:
        path = self._path("mesh")
        factors = (1.0, 1.0, 1.0)
        if "scale" in self._given:
            values = self._numbers("scale", (1, 3), 1e-6, 1e6, "one factor or three")
            factors = triple(values * 3 if len(values) == 1 else values)
        try:
            if path.suffix.lower() == ".obj":
                check_wavefront(path)
                return [(Mesh(path, factors), None)], [Mesh(path, factors)]
            parts = read_mesh(path)
        except SdfError as error:
            raise SdfError(f"{self._file}: {self._place} mesh: {error}") from error
        return [(Mesh(part.path, factors), part) for part in parts], [Mesh(part.path, factors) for part in parts]

    def _terrain(self) -> tuple[list[tuple[Geometry, MeshPart | None]], list[Geometry]]:
        if "size" not in self._given:
            raise SdfError(f"{self._file}: {self._place}: size is missing, sides and height of the terrain, m")
        size = triple(self._numbers("size", (3,), 1e-3, _FAR, "two sides and the height, m"))
        side = self._numbers("texture_size", (1,), 0.01, _FAR, "m")[0] if "texture_size" in self._given else 10.0
        path = self._path("heightmap")
        try:
            whole, *tiles = read_heightmap(path, size, texture=side)
        except SdfError as error:
            raise SdfError(f"{self._file}: {self._place} heightmap: {error}") from error
        return [(Mesh(whole), None)], [Mesh(tile) for tile in tiles]

    def _look(self) -> tuple[tuple[float, float, float, float], Path | None] | None:
        """Return the colour and the texture that the entry gives; None without either."""
        texture = self._path("texture") if "texture" in self._given else None
        if "colour" in self._given:
            values = self._numbers("colour", (3, 4), 0.0, 1.0, "red, green, blue and optionally opacity")
            red, green, blue, opacity = (*values, 1.0)[:4]
            return (red, green, blue, opacity), texture
        return None if texture is None else ((1.0, 1.0, 1.0, 1.0), texture)

    def _path(self, field: str) -> Path:
        value = self._given[field]
        if not isinstance(value, str) or not value:
            raise self._error(field, value, "a file: model://, package://, file:// or a path")
        try:
            return resolve(Element(field, {}, 0, File(self._file), text=value))
        except SdfError as error:
            reason = str(error).removeprefix(f"{self._file}: line 0: <{field}>: ")
            raise SdfError(f"{self._file}: {self._place} {field}: {reason}") from error

    def _inertial(self, collisions: tuple[Collision, ...]) -> Inertial | None:
        """Return mass and inertia of the solid shape, for a mesh those of its bounding box; None for a static model."""
        if self._given.get("mass") is None:
            return None
        (mass,) = self._numbers("mass", (1,), 1e-3, _HEAVIEST, "kg")
        if len(collisions) > MOST_SHAPES:
            raise self._error(
                "mass", mass, f"a mesh of {len(collisions)} materials is static, one of at most {MOST_SHAPES} can move"
            )
        shape = collisions[0].geometry
        if isinstance(shape, Sphere):
            moment = 0.4 * mass * shape.radius**2
            return Inertial(mass, Pose(), (moment, moment, moment, 0.0, 0.0, 0.0))
        if isinstance(shape, Cylinder):
            across = mass * (3.0 * shape.radius**2 + shape.length**2) / 12.0
            return Inertial(mass, Pose(), (across, across, 0.5 * mass * shape.radius**2, 0.0, 0.0, 0.0))
        boxes = [box_of(collision.geometry, Pose()) for collision in collisions]
        low = [min(float(box[0][k]) for box in boxes) for k in range(3)]
        high = [max(float(box[1][k]) for box in boxes) for k in range(3)]
        x, y, z = (max(b - a, 1e-3) for a, b in zip(low, high, strict=True))
        middle = triple(tuple(0.5 * (a + b) for a, b in zip(low, high, strict=True)))
        ixx, iyy, izz = (mass * (b * b + c * c) / 12.0 for b, c in ((y, z), (x, z), (x, y)))
        return Inertial(mass, Pose(middle), (ixx, iyy, izz, 0.0, 0.0, 0.0))
