"""Which sources the kernel cache hangs on."""

from __future__ import annotations

from pathlib import Path

import pytest

from xtdrone_control.autopilot import kernel


@pytest.fixture
def package(tmp_path):
    """A package: kernels that use a helper of another module and its constants, and a module without kernels."""
    (tmp_path / "loops.py").write_text("from .helper import half\n\n@kernel\ndef f(x):\n    return half(x)\n")
    (tmp_path / "helper.py").write_text("from . import constants\n\ndef half(x):\n    return constants.HALF * x\n")
    (tmp_path / "constants.py").write_text("HALF = 0.5\n")
    (tmp_path / "logic.py").write_text("from .loops import f\n")
    return tmp_path


def test_a_change_in_what_kernels_use_starts_a_new_cache(package):
    assert [path.name for path in kernel.sources([package])] == ["constants.py", "helper.py", "loops.py"]
    for name in ("loops.py", "helper.py", "constants.py"):
        before = kernel.cache_folder(package)
        (package / name).write_text((package / name).read_text() + "# changed\n")
        assert kernel.cache_folder(package) != before


def test_a_change_elsewhere_does_not(package):
    before = kernel.cache_folder(package)
    (package / "logic.py").write_text("from .loops import f  # changed\n")
    assert kernel.cache_folder(package) == before


def test_every_kernel_of_the_autopilot_counts():
    folder = Path(kernel.__file__).parent
    found = {path.name for path in kernel.sources([folder])}
    assert {"estimator.py", "rotation.py", "geo.py", "state.py", "parameters.py"} <= found
    assert "commander.py" not in found
