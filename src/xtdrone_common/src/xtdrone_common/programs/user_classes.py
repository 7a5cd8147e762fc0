"""Import of Python files and modules given by the user: classes of followers and leaders, effects."""

from __future__ import annotations

import importlib
import importlib.util
import inspect
import sys
from pathlib import Path
from types import ModuleType
from typing import TypeVar

from xtdrone_common.programs.node_command_line import ArgumentError


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


_Base = TypeVar("_Base")


def load_class(text: str, base: type[_Base], what: str = "~class") -> type[_Base]:
    """Return the subclass of ``base`` named by ``text``.

    Args:
        text: ``file.py``, ``file.py:Class`` or ``module:Class``; without a class, the only one defined there.
        base: Follower or Leader.
        what: name of the setting, for messages.

    Raises:
        ArgumentError: the import fails, or there is no such subclass.
    """
    place, _, name = text.partition(":")
    try:
        module = import_user_module(place)
    except (Exception, SystemExit) as error:  # raised by the user's code
        raise ArgumentError(f"{what}: {place} cannot be imported: {type(error).__name__}: {error}") from error
    found = {
        key: value
        for key, value in vars(module).items()
        if inspect.isclass(value) and issubclass(value, base) and value.__module__ == module.__name__
    }
    known = found
    if name:
        found = {key: value for key, value in found.items() if key == name}
    if len(found) != 1:
        wanted = f"class {name}" if name else "one class"
        there = f"; it has {', '.join(sorted(known))}" if known else ""
        raise ArgumentError(f"{what}: {place} must define {wanted} that inherits {base.__name__}{there}")
    return next(iter(found.values()))


def overrides(cls: type, base: type) -> bool:
    """Return whether ``cls`` overrides a method or a public attribute of ``base``."""
    own = {name for kind in cls.__mro__ if kind not in base.__mro__ for name in vars(kind)}
    return any(not name.startswith("_") or inspect.isfunction(getattr(base, name)) for name in own & set(dir(base)))


def nothing_overridden(cls: type, base: type) -> str:
    """Return a warning if a user's class overrides nothing of its base class, else an empty text."""
    base = next(kind for kind in cls.__mro__ if kind.__module__.partition(".")[0] == base.__module__.partition(".")[0])
    if cls is base or overrides(cls, base):
        return ""
    return f"class {cls.__name__} overrides nothing of {base.__name__}: is a method's name misspelt?"
