"""Files named by model://, package://, file:// and paths: search folders, and the files that a request may name."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

from xtdrone_common.files import shortened
from xtdrone_worlds.data_files import PACKAGES, data_folders, package_folder
from xtdrone_worlds.worlds.sdf.world_records import SdfError
from xtdrone_worlds.worlds.sdf.xml_elements import Element
from xtdrone_worlds.worlds.urdf import LONGEST_URI

_VARIABLES = ("XTDRONE_MODELS", "GAZEBO_MODEL_PATH")


class ForbiddenError(SdfError):
    """A file that a request must not name."""


def model_folders(folder: Path) -> Iterator[Path]:
    """Return the search path of models: the folder of the world, those of the environment, the package's."""
    yield folder
    yield folder / "models"
    for variable in _VARIABLES:
        for name in os.environ.get(variable, "").split(":"):
            if name:
                yield Path(name).expanduser()
    yield from data_folders("models")


def resolve(element: Element) -> Path:
    """Return the existing file or folder for the URI in an element.

    ``model://NAME/...`` is searched in ``model_folders``, ``package://NAME/...`` in a ROS package; ``file://PATH`` and
    a plain path may be relative to the folder of the element's file.

    Raises:
        ForbiddenError: the element is from a request and names a file outside models and ROS packages.
        SdfError: the file or folder does not exist.
    """
    uri = element.string()
    if len(uri) > LONGEST_URI:
        raise element.error(f"{shortened(uri)!r}: {len(uri)} characters are not allowed, at most {LONGEST_URI}")
    beside = element.file.path.parent
    kind, _, rest = uri.rpartition("://")
    if element.file.is_foreign and (kind not in {"model", "package"} or ".." in Path(rest).parts or rest[:1] == "/"):
        text = f"{element.file.path}: line {element.line}: <{element.tag}>: {uri!r} is not allowed in a request"
        raise ForbiddenError(f"{text}, model://NAME/... or package://NAME/... without '..'")
    if kind == "model":
        folders = list(model_folders(beside))
        for folder in folders:
            if os.path.exists(folder / rest):  # false for a name that the file system rejects, too
                return (folder / rest).absolute()
        raise element.error(f"{uri!r} is in none of {', '.join(dict.fromkeys(map(str, folders)))} (XTDRONE_MODELS)")
    if kind == "package":
        name, _, inner = rest.partition("/")
        try:
            path = package_folder(name) / inner
        except LookupError as error:
            raise element.error(f"{uri!r}: {error.args[0]}") from error
    elif kind in {"", "file"}:
        path = (beside / rest).absolute()
    else:
        raise element.error(f"{uri!r} is not allowed, model://, package://, file:// or a path")
    if not os.path.exists(path):
        raise element.error(f"{uri!r}: {path} does not exist")
    return path


def uri_of(path: Path) -> str:
    """Return a URI that ``resolve`` maps back to a file, independent of the current folder."""
    path = path.absolute()
    for name in (*PACKAGES, "xtdrone_sim"):  # whose folders link to these
        if path.is_relative_to(package_folder(name)):
            return f"package://{name}/{path.relative_to(package_folder(name))}"
    return f"file://{path}"
