"""Compilation of the inner loops: ``@kernel`` is numba's njit with a cache on disk that can be trusted.

numba keys its cache on the file of the function itself, so a change in a function that it calls from another file
goes unnoticed. Here the cache lies in a folder named after the contents of every source file that holds kernels, and
of what those import from the packages that hold kernels: any change there starts a new, empty one.
"""

from __future__ import annotations

import ast
import hashlib
import os
import threading
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numba
from numba import config as _config_module
from numba import njit
from numba.core import event

_config: Any = _config_module  # its options are set at run time
_PACKAGE = Path(__file__).resolve().parent


def _modules(package: Path) -> dict[str, Path]:
    """Return the source files of a package and its sub-packages by their dotted module names."""
    modules = {}
    for path in package.rglob("*.py"):
        parts = path.relative_to(package.parent).with_suffix("").parts
        modules[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return modules


def _imported(name: str, is_package: bool, source: bytes) -> set[str]:
    """Return the dotted names that a module imports from, modules and what may be modules."""
    names: set[str] = set()
    parents = name.split(".") if is_package else name.split(".")[:-1]
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            relative = parents[: len(parents) + 1 - node.level] if node.level else []
            base = ".".join([*relative, *([node.module] if node.module else [])])
            names |= {base, *(f"{base}.{alias.name}" for alias in node.names)}
    return names


def sources(packages: Iterable[Path]) -> list[Path]:
    """Return, sorted, the files of ``packages`` (folders) that hold kernels, and their imports, recursively."""
    modules = {name: path for package in packages for name, path in _modules(package).items()}
    contents = {name: path.read_bytes() for name, path in modules.items()}
    waiting = [name for name, source in contents.items() if b"@kernel" in source]
    found = set(waiting)
    while waiting:
        name = waiting.pop()
        is_package = modules[name].name == "__init__.py"
        new = (_imported(name, is_package, contents[name]) & modules.keys()) - found
        found |= new
        waiting += new
    return sorted(modules[name] for name in found)


def cache_folder(*packages: Path) -> Path:
    """Return the kernel cache's folder for the present contents of ``packages``, see ``sources``."""
    digest = hashlib.sha256(numba.__version__.encode())
    for path in sources(packages):
        digest.update(path.name.encode() + b"\0" + path.read_bytes())
    base = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache"))
    return base / "xtdrone" / f"kernels-{digest.hexdigest()[:16]}"


def _usable(folder: Path) -> bool:
    """Return whether kernels can be kept in a folder, which is made if it is not there."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        return False
    return os.access(folder, os.W_OK | os.X_OK)


class Announcer(event.Listener):  # type: ignore[misc]  # numba has no types
    """Tells which kernels are compiled, as against read from the cache.

    Compiling the whole set takes minutes on a slow machine, in which the program that needs it does nothing else.
    """

    def __init__(self, begins: Callable[[str], None], ends: Callable[[str, float], None]) -> None:
        """Tell nothing yet.

        Args:
            begins: called with the kernel's name. Kernels that one needs are compiled with it and not told of.
            ends: called with its name and the wall time that it took, s.
        """
        self._begins = begins
        self._ends = ends
        self._thread = threading.local()  # each thread has kernels of its own under way

    def on_start(self, event: Any) -> None:
        """Tell of a kernel that is no other one's part."""
        began = self._thread.__dict__.setdefault("began", [])
        began.append(time.monotonic())
        if len(began) == 1:
            self._begins(_name(event))

    def on_end(self, event: Any) -> None:
        """Tell that it is done."""
        began = self._thread.__dict__["began"].pop()
        if not self._thread.__dict__["began"]:
            self._ends(_name(event), time.monotonic() - began)

    def register(self) -> None:
        """Begin to tell, for as long as the process lives."""
        event.register("numba:compile", self)


def _name(compiled: Any) -> str:
    function = compiled.data["dispatcher"].py_func
    return f"{function.__module__.rpartition('.')[2]}.{function.__name__}"


def cache_words() -> str:
    """Say where kernels are kept, or that they cannot be."""
    folder = cache_folder(_PACKAGE)
    if _usable(folder):
        return f"once for this version, kept in {folder.parent}"
    return f"at every start, for {folder.parent} cannot be written"


def compiler(*packages: Path) -> Callable[[Callable[..., Any]], Any]:
    """Return a decorator that compiles kernels and caches them under the contents of ``packages``.

    ``packages`` names every folder whose functions the kernels call. Division by zero gives inf or NaN as in numpy;
    the arithmetic is never reordered, so results are the same in every run.
    """
    folder = str(cache_folder(*packages))
    # numba's own choice where the folder cannot be written is beside the sources, where a change goes unnoticed
    cached = _usable(Path(folder))

    def compile_kernel(function: Callable[..., Any]) -> Any:
        previous = _config.CACHE_DIR
        _config.CACHE_DIR = folder
        try:
            return njit(function, cache=cached, error_model="numpy", fastmath=False)
        finally:
            _config.CACHE_DIR = previous

    return compile_kernel


kernel = compiler(_PACKAGE)
