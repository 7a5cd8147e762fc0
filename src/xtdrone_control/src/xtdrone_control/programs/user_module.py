"""Import of a Python file or module given by the user: classes of followers and leaders, effects."""

from __future__ import annotations

import importlib
import importlib.util
import sys
from pathlib import Path
from types import ModuleType


def import_user_module(place: str) -> ModuleType:
    """Return the module at ``place``; a file is run on every call and registered under its stem.

    Args:
        place: path of a file that ends in ``.py`` (``~`` is the home folder), or a module's dotted name.

    Raises:
        Exception: raised by the import system or by the user's code, SystemExit included.
    """
    if not place.endswith(".py"):
        return importlib.import_module(place)
    spec = importlib.util.spec_from_file_location(Path(place).stem, Path(place).expanduser())
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module
