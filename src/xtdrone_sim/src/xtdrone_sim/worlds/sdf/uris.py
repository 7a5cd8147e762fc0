"""Where worlds, models, meshes and textures lie, and what they are called in files."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

from xtdrone_sim.package_files import MODELS, PACKAGE
from xtdrone_sim.worlds.sdf.tree import Element

_VARIABLES = ("XTDRONE_MODELS", "GAZEBO_MODEL_PATH")


def model_folders(beside: Path) -> Iterator[Path]:
    """Return where models are looked for: beside the world's file, in the environment's folders, in the package."""
    yield beside
    yield beside / "models"
    for variable in _VARIABLES:
        for folder in os.environ.get(variable, "").split(":"):
            if folder:
                yield Path(folder).expanduser()
    yield MODELS


def resolve(element: Element) -> Path:
    """Return the existing file or folder that an element's text names.

    ``model://NAME/...`` is looked for in ``model_folders``, ``package://NAME/...`` in a ROS package; ``file://PATH``
    and a plain path are taken as they are, relative ones from the folder of the file that names them.

    Raises:
        SdfError: there is no such thing.
    """
    uri = element.string()
    beside = element.file.path.parent
    kind, _, rest = uri.rpartition("://")
    if kind == "model":
        folders = list(model_folders(beside))
        for folder in folders:
            if (folder / rest).exists():
                return (folder / rest).absolute()
        raise element.error(f"{uri!r} is in none of {', '.join(dict.fromkeys(map(str, folders)))} (XTDRONE_MODELS)")
    if kind == "package":
        path = _package(element, uri, rest)
    elif kind in {"", "file"}:
        path = (beside / rest).absolute()
    else:
        raise element.error(f"{uri!r} is not allowed, model://, package://, file:// or a path")
    if not path.exists():
        raise element.error(f"{uri!r}: {path} does not exist")
    return path


def _package(element: Element, uri: str, rest: str) -> Path:
    name, _, inner = rest.partition("/")
    if name == "xtdrone_sim":
        return PACKAGE / inner
    import rospkg  # only another package's files need it

    try:
        return Path(rospkg.RosPack().get_path(name)) / inner
    except rospkg.ResourceNotFound as error:
        raise element.error(f"{uri!r}: no ROS package {name!r} is found") from error


def uri_of(path: Path) -> str:
    """Return the name under which ``resolve`` finds a file again from anywhere."""
    path = path.absolute()
    if path.is_relative_to(PACKAGE):
        return f"package://xtdrone_sim/{path.relative_to(PACKAGE)}"
    return f"file://{path}"
