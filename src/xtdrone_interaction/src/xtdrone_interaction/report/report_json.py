"""The file report.json: plain data, and the versions that they depend on."""

from __future__ import annotations

import importlib.metadata
import json
import math
import platform
from pathlib import Path
from typing import Any

from xtdrone_common.files import write_whole

_PACKAGES = ("numpy", "scipy", "numba", "pybullet", "pymavlink", "rosbags", "matplotlib")


def versions() -> dict[str, str]:
    """Return the versions of Python and of the packages that influence a flight's metrics."""
    found = {"python": platform.python_version()}
    for package in _PACKAGES:
        try:
            found[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            found[package] = "not installed"
    return found


def write_report(report: object, path: str | Path) -> None:
    """Write plain data as JSON; numbers that are not finite become null.

    Raises:
        OSError: it cannot be written; a file of that name is then as it was.
    """
    write_whole(Path(path), json.dumps(_finite(report), indent=2, allow_nan=False) + "\n")


def _finite(report: Any) -> Any:
    if isinstance(report, dict):
        return {key: _finite(value) for key, value in report.items()}
    if isinstance(report, list | tuple):
        return [_finite(value) for value in report]
    return None if isinstance(report, float) and not math.isfinite(report) else report
