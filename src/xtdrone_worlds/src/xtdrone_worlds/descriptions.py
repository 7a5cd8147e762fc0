"""YAML descriptions of vehicles and worlds: search path, names, and inheritance."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from xtdrone_common.files import ContentError, load_yaml, read_text
from xtdrone_worlds.data_files import data_folders

VEHICLES_VARIABLE = "XTDRONE_VEHICLES"  # environment: folders with user-defined vehicles, separated by colons

_NOT_SIMULATED = {
    "rover": "a ground vehicle",
    "rover_with_lidar_stereo": "a ground vehicle with lidar and stereo cameras",
    "catvehicle": "a ground vehicle",
    "plane": "a fixed-wing aircraft",
    "plane_gimbal": "a fixed-wing aircraft",
    "standard_vtol": "a VTOL aircraft",
    "tiltrotor": "a VTOL aircraft",
    "tailsitter": "a VTOL aircraft",
}
"""XTDrone's vehicles that do not exist here, with the reason."""


class ModelError(ValueError):
    """A vehicle or world description that cannot be used."""


def folders(kind: str) -> list[Path]:
    """Return the search path of a kind of descriptions (vehicles, worlds).

    Raises:
        ModelError: a folder listed in the environment does not exist.
    """
    own = os.environ.get(VEHICLES_VARIABLE, "") if kind == "vehicles" else ""
    folders = [Path(part).expanduser() for part in own.split(":") if part]
    for folder in folders:
        if not folder.is_dir():
            raise ModelError(f"environment variable {VEHICLES_VARIABLE}: {str(folder)!r} is not a folder")
    return [*folders, *data_folders(f"config/{kind}")]


def available(kind: str) -> list[str]:
    """Return the names of all descriptions of a kind (vehicles, worlds)."""
    return sorted({path.stem for folder in folders(kind) for path in folder.glob("*.yaml")})


def find(kind: str, name: str, above: tuple[Path, ...] = ()) -> Path:
    """Return the file of a description: ``name`` itself if it is a path.

    Args:
        kind: vehicles, worlds.
        name: name of the description.
        above: files that extend it, which are excluded: a user's ``iris.yaml`` extends the package's ``iris``.

    Raises:
        ModelError: unknown description.
    """
    if name.endswith((".yaml", ".yml")):
        return Path(name)
    paths = [path for folder in folders(kind) if (path := folder / f"{name}.yaml").is_file()]
    for path in paths:
        if path not in above:
            return path
    if paths:
        raise ModelError(f"{above[-1]}: extends: {name!r} is not allowed, it refers back to {paths[-1]}")
    known = _NOT_SIMULATED.get(name) if kind == "vehicles" else None
    reason = f", {known} is not simulated" if known else ""
    raise ModelError(f"{kind}: {name!r} is not known{reason}; there are {', '.join(available(kind))}")


def read_description(kind: str, name: str) -> dict[str, Any]:
    """Return the YAML of a description of a kind (vehicles, worlds): ``<name>.yaml``, or the file ``name``.

    With ``extends: NAME`` it inherits all values of another description (a file name is relative to its folder) and
    lists only the differences.

    Raises:
        ModelError: unknown description, not a YAML mapping, or a description that extends itself.
    """
    return _read(kind, find(kind, name), ())


def _read(kind: str, path: Path, above: tuple[Path, ...]) -> dict[str, Any]:
    try:
        description = load_yaml(read_text(path))
    except OSError as error:
        names = ", ".join(available(kind))
        raise ModelError(f"{kind}: {path}: {error.strerror or error}; by name there are {names}") from error
    except ContentError as error:
        raise ModelError(f"{path}: not a YAML file: {error}") from error
    if not isinstance(description, dict):
        raise ModelError(f"{path}: a mapping is needed, got {type(description).__name__}")
    base = description.pop("extends", None)
    if base is None:
        return description
    above = (*above, path)
    below = find(kind, str(base), above)
    below = below if below.is_absolute() else path.parent / below
    if below in above:
        raise ModelError(f"{path}: extends: {base!r} is not allowed, it refers back to {below}")
    return _merge(_read(kind, below, above), description)


def _merge(base: dict[str, Any], changes: dict[str, Any]) -> dict[str, Any]:
    """Return ``base`` with the values of ``changes``; mappings are merged recursively."""
    merged = dict(base)
    for key, value in changes.items():
        both = isinstance(value, dict) and isinstance(base.get(key), dict)
        merged[key] = _merge(base[key], value) if both else value
    return merged
