"""The code does not grow unnoticed: lines of each package and of all of them, and the number of small modules."""

from __future__ import annotations

import importlib.util
from types import ModuleType

import pytest
from conftest import REPOSITORY

# Highest numbers of code lines, without blanks, docstrings and comments. Who needs more lines raises a limit in the
# same commit and says why in its body.
PACKAGES = {
    "benchmarks": 4_000,
    "scripts": 400,
    "training": 2_600,
    "validation": 2_500,
    "xtdrone_common": 3_000,
    "xtdrone_lockstep": 4_200,
    "xtdrone_autopilot": 15_000,
    "xtdrone_mavros": 7_200,
    "xtdrone_control": 2_500,
    "xtdrone_worlds": 5_500,
    "xtdrone_sim": 13_500,
    "xtdrone_coordination": 5_800,
    "xtdrone_interaction": 27_000,
    "xtdrone_perception": 5_000,
    "xtdrone_planning": 7_800,
    "xtdrone_swarm": 3_600,
}
ALL = 103_900
SMALL_MODULES = 60


@pytest.fixture(scope="module")
def counter() -> ModuleType:
    spec = importlib.util.spec_from_file_location("count_code_lines", REPOSITORY / "scripts/count_code_lines.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def modules(counter: ModuleType) -> dict[str, int]:
    found: dict[str, int] = counter.count_modules(REPOSITORY)
    return found


def test_packages_stay_within_their_limits(counter: ModuleType, modules: dict[str, int]) -> None:
    lines = counter.sum_by_package(modules)
    grown = {name: count for name, count in lines.items() if count > PACKAGES.get(name, 300)}
    assert grown == {}, "lines of code above the limit"
    assert sum(modules.values()) <= ALL


def test_small_modules_are_few(counter: ModuleType, modules: dict[str, int]) -> None:
    small = counter.find_small_modules(modules)
    assert len(small) <= SMALL_MODULES, "\n".join(small)


def test_only_code_counts(counter: ModuleType) -> None:
    source = (
        '"""Docstring."""\n\n# comment\nvalue = (\n    1,\n)\n\n\ndef f():\n    """Return\n    1."""\n    return 1\n'
    )
    assert counter.count_code_lines(source) == 5


def test_a_module_belongs_to_its_package_and_room(counter: ModuleType) -> None:
    assert counter.package_of("src/xtdrone_sim/src/xtdrone_sim/rays/cast.py") == "xtdrone_sim"
    assert counter.package_of("benchmarks/goals.py") == "benchmarks"
    assert counter.room_of("src/xtdrone_sim/src/xtdrone_sim/rays/cast.py") == "xtdrone_sim/rays"
    assert counter.room_of("src/xtdrone_sim/src/xtdrone_sim/kernel.py") == "xtdrone_sim/flat"
    assert counter.room_of("src/xtdrone_sim/nodes/sim_node.py") is None
