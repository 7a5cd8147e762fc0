"""The sources on which the kernel cache depends, and kernels that can create arrays."""

from __future__ import annotations

import ast
from contextlib import nullcontext
from pathlib import Path

import numpy as np
import pytest
from numba.core import event
from numba.core.errors import NumbaError

from xtdrone_common import kernel_cache


@pytest.fixture
def package(tmp_path):
    """A package: kernels that use a helper of another module and its constants, and a module without kernels."""
    (tmp_path / "loops.py").write_text("from .helper import half\n\n@kernel\ndef f(x):\n    return half(x)\n")
    (tmp_path / "helper.py").write_text("from . import constants\n\ndef half(x):\n    return constants.HALF * x\n")
    (tmp_path / "constants.py").write_text("HALF = 0.5\n")
    (tmp_path / "logic.py").write_text("from .loops import f\n")
    return tmp_path


def test_a_change_in_what_kernels_use_starts_a_new_cache(package):
    assert [path.name for path in kernel_cache.sources([package])] == ["constants.py", "helper.py", "loops.py"]
    for name in ("loops.py", "helper.py", "constants.py"):
        before = kernel_cache.cache_folder(package)
        (package / name).write_text((package / name).read_text() + "# changed\n")
        assert kernel_cache.cache_folder(package) != before


def test_a_change_elsewhere_does_not(package):
    before = kernel_cache.cache_folder(package)
    (package / "logic.py").write_text("from .loops import f  # changed\n")
    assert kernel_cache.cache_folder(package) == before


def parsed_imports(name, is_package, source):
    parents = name.split(".") if is_package else name.split(".")[:-1]
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            relative = parents[: len(parents) + 1 - node.level] if node.level else []
            base = ".".join([*relative, *([node.module] if node.module else [])])
            yield from (base, *(f"{base}.{alias.name}" for alias in node.names))


def test_no_import_of_a_package_with_kernels_is_missed():
    for path in Path(kernel_cache.__file__).parents[4].glob("xtdrone_*/src/**/*.py"):
        given = ("a.b.c", path.name == "__init__.py", path.read_bytes())
        assert set(parsed_imports(*given)) <= kernel_cache.imported(*given), path


def test_every_kernel_of_the_autopilot_counts():
    common = Path(kernel_cache.__file__).parent
    autopilot = common.parents[2] / "xtdrone_autopilot" / "src" / "xtdrone_autopilot"
    found = {path.name for path in kernel_cache.sources([common, autopilot])}
    assert {"ekf.py", "rotation.py", "projection.py", "state.py", "parameters.py"} <= found
    assert "commander.py" not in found


def half(x):
    return 0.5 * x


@pytest.mark.parametrize(("place", "times"), [("", 1), ("/proc/nowhere", 2)])
def test_compilation_is_announced_and_cached_where_possible(tmp_path, monkeypatch, place, times):
    monkeypatch.setenv("XDG_CACHE_HOME", place or str(tmp_path))
    told = []
    announcer = kernel_cache.Announcer(told.append, lambda name, seconds: told.append((name, seconds >= 0.0)))
    with event.install_listener("numba:compile", announcer):
        for _ in range(2):
            assert kernel_cache.compiler(tmp_path)(half)(3.0) == 1.5
    assert told == ["test_kernel_cache.half", ("test_kernel_cache.half", True)] * times
    assert ("cannot be written" in kernel_cache.cache_words()) == bool(place)


def ones(n):
    return np.ones(n)


@pytest.mark.parametrize("allocates", [True, False])
def test_only_kernels_with_reference_counts_create_arrays(tmp_path, monkeypatch, allocates):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    compiled = kernel_cache.compiler(tmp_path, allocates=allocates)(ones)
    with nullcontext() if allocates else pytest.raises(NumbaError):
        assert compiled(3).tolist() == [1.0, 1.0, 1.0]
