"""Worlds by name or file, SDF or YAML."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from xtdrone_common.files import read_bytes
from xtdrone_common.geodesy.projection import Datum
from xtdrone_worlds.data_files import data_path
from xtdrone_worlds.descriptions import ModelError, available, read_description
from xtdrone_worlds.worlds.sdf.models.yaml_models import read_models
from xtdrone_worlds.worlds.sdf.world_reader import parse_model, parse_world
from xtdrone_worlds.worlds.sdf.world_records import SdfError, SdfModel, SdfWorld
from xtdrone_worlds.worlds.sdf.xml_elements import LARGEST, Element

WORLDS = data_path("worlds")

MODELS = "models"
"""Field of a YAML file with the list of the world's models."""

_FIELDS = ("datum", "gravity", "wind", "magnetic_field", "ground", MODELS)
_ENDINGS = (".world", ".sdf")


def world_names() -> list[str]:
    """Return the names of the package's worlds."""
    return sorted({*available("worlds"), *(path.stem for path in WORLDS.glob("*.world"))})


def world_path(name: str, beside: Path | None = None) -> Path | None:
    """Return the SDF file of a world; None for a YAML file.

    Args:
        name: name of a world of the package, or a path.
        beside: base folder of relative paths; None for the working directory.
    """
    if name.endswith(_ENDINGS):
        return (beside or Path()).joinpath(Path(name).expanduser()).absolute()
    path = WORLDS / f"{name}.world"
    return path if os.path.isfile(path) else None  # false for a name that the file system rejects, too


def world_file(name: str) -> Path:
    """Return the absolute path of a world's file, SDF or YAML; see ``load_world_file``.

    Raises:
        ModelError: unknown name.
    """
    path = world_path(name)
    if path is None and name.endswith((".yaml", ".yml")):
        path = Path(name).expanduser().absolute()
    if path is None:
        _check_known(name)
        path = data_path(f"config/worlds/{name}.yaml")
    return path


def _check_known(name: str) -> None:
    if name not in world_names():
        raise ModelError(f"worlds: {name!r} is not known; there are {', '.join(world_names())}")


def load_world_file(name: str) -> SdfWorld:
    """Load a world.

    Args:
        name: name of a file in ``worlds`` or ``config/worlds``, or a path ending in .world, .sdf, .yaml or .yml.

    Raises:
        ModelError: unknown name, or invalid file.
    """
    return _load(name, None, ())


def read_world(text: str | bytes, path: Path) -> SdfWorld:
    """Parse an SDF world.

    Args:
        text: content of the file.
        path: path of the file, for messages and relative paths.

    Raises:
        SdfError: invalid content; the message names file, line, element, value and what is allowed.
    """
    return _read(text, path.absolute(), ())


def read_model(text: str | bytes, name: str) -> SdfModel:
    """Parse an SDF with one model, which may only name files of installed models and ROS packages.

    Args:
        text: content, in a request.
        name: name of the request in messages.

    Raises:
        SdfError: invalid content; the message names line, element, value and what is allowed.
    """
    return parse_model(text, WORLDS / name)


def _load(name: str, beside: Path | None, extending: tuple[Path, ...]) -> SdfWorld:
    path = world_path(name, beside)
    if path is not None:
        return _read(_text(path), path, extending)
    if name.endswith((".yaml", ".yml")):
        name = str((beside or Path()).joinpath(Path(name).expanduser()))
    else:
        _check_known(name)
    return _from_yaml(name)


def _read(text: str | bytes, path: Path, extending: tuple[Path, ...]) -> SdfWorld:
    def extended(element: Element | None) -> SdfWorld:
        if element is None:
            return _from_yaml("empty")
        if path in extending:
            raise element.error(f"{element.string()!r} includes this file again")
        try:
            return _load(element.string(), path.parent, (*extending, path))
        except SdfError:
            raise
        except ModelError as error:
            raise element.error(str(error)) from error

    return parse_world(text, path, extended)


def _text(path: Path) -> bytes:
    try:
        return read_bytes(path, LARGEST)
    except OSError as error:
        names = ", ".join(world_names())
        raise SdfError(f"worlds: {path}: {error.strerror or error}; by name there are {names}") from error


def _from_yaml(name: str) -> SdfWorld:
    description = read_description("worlds", name)
    for field in description:
        if field not in _FIELDS:
            raise ModelError(f"world {name!r}: field {str(field)[:60]!r} is not known; there are {', '.join(_FIELDS)}")
    world = _surroundings(description, name)
    if MODELS not in description:
        return world
    return replace(world, models=read_models(description[MODELS], Path(name).absolute()), joints=())


def _surroundings(description: Mapping[str, Any], name: str) -> SdfWorld:
    try:
        datum, field, ground = (description[key] for key in ("datum", "magnetic_field", "ground"))
        declination, inclination = math.radians(field["declination"]), math.radians(field["inclination"])
        horizontal = field["strength"] * math.cos(inclination)
        x, y, z = (float(value) for value in description["wind"])
        world = SdfWorld(
            Path(name).stem,
            Datum(*(float(datum[key]) for key in ("latitude", "longitude", "altitude"))),
            float(description["gravity"]),
            (x, y, z),
            (
                horizontal * math.sin(declination),
                horizontal * math.cos(declination),
                -field["strength"] * math.sin(inclination),
            ),
            float(field["declination"]),
            float(ground["friction"]),
            float(ground["restitution"]),
        )
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise ModelError(f"world {name!r}: field {str(error)[:200]} is missing or of the wrong kind") from error
    _check_values(name, world)
    return world


def _check_values(name: str, world: SdfWorld) -> None:
    """Check the ranges, which are those of SDF worlds; see ``world_reader``.

    Raises:
        ModelError: a value is outside its range.
    """
    field = math.hypot(*world.magnetic_field)
    for what, value, low, high in (
        ("datum: latitude", world.datum.latitude, -90.0, 90.0),
        ("datum: longitude", world.datum.longitude, -180.0, 180.0),
        ("datum: altitude", world.datum.altitude, -1000.0, 20000.0),
        ("gravity", world.gravity, 1e-9, 100.0),
        ("magnetic_field: strength", field, 0.01, 20.0),
        ("magnetic_field: declination", world.declination, -180.0, 180.0),
        ("ground: friction", world.friction, 0.0, 10.0),
        ("ground: restitution", world.restitution, 0.0, 1.0),
        *(("wind", value, -100.0, 100.0) for value in world.wind),
    ):
        if not low <= value <= high:
            raise ModelError(f"world {name!r}: {what}: {value:g} is not allowed, {low:g} to {high:g}")
