"""Compilation of the inner loops: numba's njit with a reliable cache on disk. Each package's ``kernel.py`` uses it.

numba's cache depends only on the file of the compiled function, so it misses changes to callees in other files.
Here the name of the cache folder is a hash of all source files that contain kernels and of the modules that they import
from the same packages. Any change to these starts a new, empty cache.
"""

from __future__ import annotations

import functools
import hashlib
import os
import re
import threading
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numba
from numba import config as _config_module
from numba import njit
from numba.core import event

_config: Any = _config_module  # numba sets its options at run time
_PACKAGE = Path(__file__).resolve().parent


def _modules(package: Path) -> dict[str, Path]:
    """Return dotted module name to source file of a package and its sub-packages."""
    modules = {}
    for path in package.rglob("*.py"):
        parts = path.relative_to(package.parent).with_suffix("").parts
        modules[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return modules


# Import statements, with the dots and the name of a module to import from; parsing takes fifty times as long. Text of
# this form elsewhere, in a docstring say, costs nothing but a needless dependency.
_IMPORT = re.compile(
    rb"^[ \t]*(?:from[ \t]+(\.*)([\w.]*)[ \t]+import[ \t]+(\([^)]*\)|[^\n#;]*)|import[ \t]+([^\n#;]*))", re.MULTILINE
)
_COMMENT = re.compile(rb"#[^\n]*")


def imported(name: str, is_package: bool, source: bytes) -> set[str]:
    """Return the dotted names of imported modules, and of imported attributes, which may be modules.

    Args:
        name: dotted name of the importing module.
        is_package: whether it is the ``__init__`` of a package.
        source: its text, formatted as ruff does.
    """
    names: set[str] = set()
    parents = name.split(".") if is_package else name.split(".")[:-1]
    for dots, module, attributes, modules in _IMPORT.findall(source):
        if modules:
            names |= _words(modules)
            continue
        relative = parents[: len(parents) + 1 - len(dots)] if dots else []
        base = ".".join([*relative, *([module.decode()] if module else [])])
        names |= {base, *(f"{base}.{attribute}" for attribute in _words(_COMMENT.sub(b"", attributes.strip(b"()"))))}
    return names


def _words(text: bytes) -> set[str]:
    """Return the first word of each part of a list separated by commas."""
    return {words[0].decode() for part in text.split(b",") if (words := part.split())}


def sources(packages: Iterable[Path]) -> list[Path]:
    """Return the sorted files in ``packages`` (folders) that contain kernels, with their imports, recursively."""
    modules = {name: path for package in packages for name, path in _modules(package).items()}
    contents = {name: path.read_bytes() for name, path in modules.items()}
    waiting = [name for name, source in contents.items() if b"@kernel" in source]
    found = set(waiting)
    while waiting:
        name = waiting.pop()
        is_package = modules[name].name == "__init__.py"
        new = (imported(name, is_package, contents[name]) & modules.keys()) - found
        found |= new
        waiting += new
    return sorted(modules[name] for name in found)


def cache_folder(*packages: Path) -> Path:
    """Return the folder of the kernel cache for the present contents of ``packages``, see ``sources``."""
    digest = hashlib.sha256(numba.__version__.encode())
    for path in sources(packages):
        digest.update(path.name.encode() + b"\0" + path.read_bytes())
    base = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache"))
    return base / "xtdrone" / f"kernels-{digest.hexdigest()[:16]}"


_cache_folder_of_this_run = functools.cache(cache_folder)
"""Return ``cache_folder(packages)``, remembered for a package's decorators: files are read once per process.
"""


def _usable(folder: Path) -> bool:
    """Create a folder if it is missing; return whether kernels can be written to it."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        return False
    return os.access(folder, os.W_OK | os.X_OK)


class Announcer(event.Listener):  # type: ignore[misc]  # numba has no types
    """Reports kernels that are compiled rather than loaded from the cache.

    Compiling all of them takes minutes on a slow machine and blocks the program.
    """

    def __init__(self, begins: Callable[[str], None], ends: Callable[[str, float], None]) -> None:
        """Store the callbacks; ``register`` starts the reports.

        Args:
            begins: called with the name of a kernel at the start of its compilation. Callees compiled with it are not
                reported.
            ends: called with its name and the wall time of its compilation, s.
        """
        self._begins = begins
        self._ends = ends
        self._thread = threading.local()  # threads compile independently

    def on_start(self, event: Any) -> None:
        """Report the start, unless the kernel is compiled as a callee of another."""
        began = self._thread.__dict__.setdefault("began", [])
        began.append(time.monotonic())
        if len(began) == 1:
            self._begins(_name(event))

    def on_end(self, event: Any) -> None:
        """Report the end of such a compilation."""
        began = self._thread.__dict__["began"].pop()
        if not self._thread.__dict__["began"]:
            self._ends(_name(event), time.monotonic() - began)

    def register(self) -> None:
        """Start reporting, until the process ends."""
        event.register("numba:compile", self)


def _name(compiled: Any) -> str:
    function = compiled.data["dispatcher"].py_func
    return f"{function.__module__.rpartition('.')[2]}.{function.__name__}"


def cache_words() -> str:
    """Return a phrase on how often kernels are compiled and where they are cached, for a log line."""
    folder = cache_folder(_PACKAGE)
    if _usable(folder):
        return f"once for this version, cached in {folder.parent}"
    return f"at every start, as {folder.parent} cannot be written"


def compiler(*packages: Path, nogil: bool = False, allocates: bool = True) -> Callable[[Callable[..., Any]], Any]:
    """Return a decorator that compiles kernels and caches them under the contents of ``packages``.

    ``packages`` must contain every folder with functions that the kernels call. With ``nogil`` a call from Python lets
    other threads run. Kernels that neither create nor return arrays need no reference counts, which took a sixth of
    the time of a simulation step: compile them without ``allocates``. Division by zero gives inf or NaN as in numpy.
    Floating-point operations are not reordered, so that results are the same in every run.
    """
    folder = str(_cache_folder_of_this_run(*packages))
    options: dict[str, Any] = {"error_model": "numpy", "fastmath": False, "nogil": nogil, "_nrt": allocates}
    # without write access do not cache: numba would cache beside the sources and miss changes to callees
    cached = _usable(Path(folder))

    def compile_kernel(function: Callable[..., Any]) -> Any:
        previous = _config.CACHE_DIR
        _config.CACHE_DIR = folder
        try:
            return njit(function, cache=cached, **options)
        finally:
            _config.CACHE_DIR = previous

    return compile_kernel
