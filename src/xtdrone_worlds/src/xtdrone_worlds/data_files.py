"""Locations of data: the packages' own files, and folders of generated files in the user's cache."""

from __future__ import annotations

import functools
import os
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path

PACKAGES = ("xtdrone_worlds",)
"""Packages with the data: folders ``config``, ``models``, ``worlds``."""


@functools.cache
def package_folder(name: str) -> Path:
    """Return the folder of a ROS package: beside the sources of this one, or on ROS_PACKAGE_PATH.

    Raises:
        LookupError: there is none.
    """
    source = Path(__file__).resolve().parents[3] / name
    if (source / "package.xml").is_file():
        return source
    import rospkg  # only other and installed packages need it

    try:
        return Path(rospkg.RosPack().get_path(name))
    except rospkg.ResourceNotFound as error:
        raise LookupError(f"no ROS package {name!r} on ROS_PACKAGE_PATH") from error


def data_folders(inner: str) -> list[Path]:
    """Return the folders ``inner``, such as ``config/robots``, of all packages that have it."""
    folders = [package_folder(name) / inner for name in PACKAGES]
    return [folder for folder in folders if folder.is_dir()]


def data_path(inner: str) -> Path:
    """Return a file or folder of the packages, such as ``config/worlds/empty.yaml``; it need not exist."""
    paths = [package_folder(name) / inner for name in PACKAGES]
    return next((path for path in paths if path.exists()), paths[0])


def cached_folder(kind: str, name: str, write: Callable[[Path], None]) -> Path:
    """Return a folder below ``$XDG_CACHE_HOME`` (else ``~/.cache``), which is created atomically.

    Args:
        kind: kind of the caller's files, the name of the folders' common parent.
        name: name of the folder; it must change with the content.
        write: writes the files into an empty folder.

    Raises:
        OSError: the cache cannot be written.
    """
    above = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "xtdrone" / kind
    folder = above / name
    if folder.is_dir():
        return folder
    above.mkdir(parents=True, exist_ok=True)
    fresh = Path(tempfile.mkdtemp(prefix=f".{name}-", dir=above))
    try:
        write(fresh)
        fresh.chmod(0o755)
        fresh.rename(folder)
    except OSError:
        shutil.rmtree(fresh, ignore_errors=True)
        if not folder.is_dir():  # else another process was faster
            raise
    except BaseException:
        shutil.rmtree(fresh, ignore_errors=True)
        raise
    return folder
