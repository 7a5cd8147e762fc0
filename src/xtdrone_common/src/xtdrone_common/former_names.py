"""Former names of modules: ``import xtdrone_control.lockstep`` gives ``xtdrone_lockstep``, the same module object."""

from __future__ import annotations

import importlib
import importlib.abc
import importlib.machinery
import sys
from collections.abc import Mapping, Sequence
from types import ModuleType


class _Redirection(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    """Finds and loads the modules below one package that have moved.

    Args:
        package: Name of the package that held them.
        moved: New full name of each module or folder, by its former name below the package.
    """

    def __init__(self, package: str, moved: Mapping[str, str]) -> None:
        self.moved = {f"{package}.{former}": name for former, name in moved.items()}
        self._specs: dict[str, importlib.machinery.ModuleSpec | None] = {}

    def find_spec(
        self, fullname: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> importlib.machinery.ModuleSpec | None:
        """Return a spec of this loader for a module that has moved, None for any other."""
        return importlib.machinery.ModuleSpec(fullname, self) if self._new_name(fullname) else None

    def create_module(self, spec: importlib.machinery.ModuleSpec) -> ModuleType:
        """Import the module under its new name and return it."""
        name = self._new_name(spec.name)
        assert name is not None, "find_spec() returns specs of moved modules only"
        module = importlib.import_module(name)
        self._specs[spec.name] = module.__spec__
        return module

    def exec_module(self, module: ModuleType) -> None:
        """Give the module its own spec back: the import system has replaced it by that of the former name."""
        assert module.__spec__ is not None
        module.__spec__ = self._specs.pop(module.__spec__.name)

    def _new_name(self, former: str) -> str | None:
        head, rest = former, ""
        while head not in self.moved:
            head, dot, tail = head.rpartition(".")
            if not dot:
                return None
            rest = f".{tail}{rest}"
        return self.moved[head] + rest


def redirect(package: str, moved: Mapping[str, str]) -> None:
    """Let modules that have moved out of a package be imported by their former names, too.

    Args:
        package: Name of the package that held them, its ``__name__``.
        moved: New full name of each module or folder, by its former name below the package.
    """
    # In front: a folder of caches that a former version has left would be found as a package without modules.
    sys.meta_path.insert(0, _Redirection(package, moved))
