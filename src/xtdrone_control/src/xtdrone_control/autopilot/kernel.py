"""Compilation of the inner loops: ``@kernel`` is numba's njit with a cache on disk that can be trusted.

numba keys its cache on the file of the function itself, so a change in a function that it calls from another file
goes unnoticed. Here the cache lies in a folder named after the contents of every source file that holds kernels, and
of what those import from the packages that hold kernels: any change there starts a new, empty one.
"""

from __future__ import annotations

import ast
import hashlib
import os
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numba
from numba import config as _config_module
from numba import njit

_config: Any = _config_module  # its options are set at run time
_PACKAGE = Path(__file__).resolve().parent


def _imported(source: bytes) -> set[str]:
    """Return the last parts of all names that a module imports."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.ImportFrom):
            names |= {(node.module or "").rpartition(".")[2], *(alias.name for alias in node.names)}
    return names


def sources(packages: Iterable[Path]) -> list[Path]:
    """Return, sorted, the files of ``packages`` (folders) that hold kernels, and what they import, in turn too."""
    contents = {path: path.read_bytes() for package in packages for path in package.glob("*.py")}
    waiting = [path for path, source in contents.items() if b"@kernel" in source]
    found = set(waiting)
    while waiting:
        names = _imported(contents[waiting.pop()])
        new = [path for path in contents if path.stem in names and path not in found]
        found.update(new)
        waiting += new
    return sorted(found)


def cache_folder(*packages: Path) -> Path:
    """Return the kernel cache's folder for the present contents of ``packages``, see ``sources``."""
    digest = hashlib.sha256(numba.__version__.encode())
    for path in sources(packages):
        digest.update(path.name.encode() + b"\0" + path.read_bytes())
    base = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache"))
    return base / "xtdrone" / f"kernels-{digest.hexdigest()[:16]}"


def compiler(*packages: Path) -> Callable[[Callable[..., Any]], Any]:
    """Return a decorator that compiles kernels and caches them under the contents of ``packages``.

    ``packages`` names every folder whose functions the kernels call. Division by zero gives inf or NaN as in numpy;
    the arithmetic is never reordered, so results are the same in every run.
    """
    folder = str(cache_folder(*packages))

    def compile_kernel(function: Callable[..., Any]) -> Any:
        previous = _config.CACHE_DIR
        _config.CACHE_DIR = folder
        try:
            return njit(function, cache=True, error_model="numpy", fastmath=False)
        finally:
            _config.CACHE_DIR = previous

    return compile_kernel


kernel = compiler(_PACKAGE)
