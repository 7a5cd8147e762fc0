"""The direction of dependencies between packages and rooms, as docs/design.md states it."""

from __future__ import annotations

import ast
import functools
import re
from collections.abc import Iterator
from pathlib import Path
from xml.etree import ElementTree

import pytest

ROOT = Path(__file__).parents[1]
_GROUND = {"xtdrone_common"}
_GRAPH = _GROUND | {"xtdrone_lockstep", "xtdrone_control"}
ALLOWED = {
    "xtdrone_common": set(),
    "xtdrone_lockstep": _GROUND,
    "xtdrone_autopilot": _GROUND,
    "xtdrone_worlds": _GROUND,
    "xtdrone_mavros": _GROUND | {"xtdrone_lockstep", "xtdrone_autopilot"},
    "xtdrone_control": _GROUND | {"xtdrone_lockstep"},
    "xtdrone_sim": _GROUND | {"xtdrone_lockstep", "xtdrone_autopilot", "xtdrone_worlds"},
    "xtdrone_coordination": _GRAPH | {"xtdrone_autopilot"},  # plans of QGroundControl, checked as PX4 does
    "xtdrone_perception": _GRAPH,
    "xtdrone_planning": _GRAPH,
    "xtdrone_swarm": _GRAPH
    | {"xtdrone_autopilot", "xtdrone_mavros", "xtdrone_worlds", "xtdrone_sim", "xtdrone_coordination"},
}
ALLOWED["xtdrone_interaction"] = set(ALLOWED) | {"xtdrone_rviz"}
"""The packages that each package may import."""
TOP_LEVEL = {"benchmarks", "validation", "training"}
"""Folders of programs that measure or check the packages: no package imports them."""
RINGS: dict[str, set[str]] = {
    # As in PX4, whose modules read each other's topics.
    "xtdrone_autopilot": {
        "autopilot", "commander", "estimator", "events", "flight_tasks", "logger", "navigator", "parameters",
        "vehicle_view",
    },
    "xtdrone_mavros": {"lib", "uas"},
    "xtdrone_sim": {
        "air", "autopilots", "effects", "physics", "sensors", "simulation", "steps_in_free_flight", "topics",
    },
    "xtdrone_interaction": {
        "bags", "command_options", "console", "launching", "metrics", "pictures", "recording", "report",
    },
}  # fmt: skip
"""Rooms between which imports go in both directions, or that lie between such rooms; no other may."""


def _name(path: Path, root: Path) -> str:
    parts = path.relative_to(root).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


@functools.cache
def modules() -> dict[str, Path]:
    """Return every module of the packages, by its dotted name."""
    roots = [ROOT / "src" / package / "src" for package in ALLOWED]
    return {_name(path, root): path for root in roots for path in root.rglob("*.py")}


def _targets(name: str, path: Path) -> Iterator[str]:
    """Yield the dotted names that a file imports, lazy and type-only imports included."""
    parents = name.split(".") if path.name == "__init__.py" else name.split(".")[:-1]
    for node in ast.walk(ast.parse(path.read_bytes())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            relative = parents[: len(parents) + 1 - node.level] if node.level else []
            base = ".".join([*relative, *filter(None, [node.module])])
            for alias in node.names:
                full = f"{base}.{alias.name}"
                yield full if full in modules() else base


@functools.cache
def imports() -> dict[str, set[str]]:
    """Return, for every module, the modules of the packages that it imports."""
    return {name: {t for t in _targets(name, path) if t in modules()} - {name} for name, path in modules().items()}


def _circle() -> list[str]:
    """Return the modules of one import cycle, in order, or nothing."""
    done: set[str] = set()

    def visit(name: str, way: list[str]) -> list[str]:
        if name in way:
            return [*way[way.index(name) :], name]
        if name in done:
            return []
        for other in sorted(imports()[name]):
            if found := visit(other, [*way, name]):
                return found
        done.add(name)
        return []

    return next((found for name in sorted(imports()) if (found := visit(name, []))), [])


@pytest.mark.parametrize("package", ALLOWED)
def test_packages_import_only_those_below(package):
    allowed = ALLOWED[package] | {package}
    wrong = {
        f"{name} imports {other}"
        for name, others in imports().items()
        if name.split(".")[0] == package
        for other in others
        if other.split(".")[0] not in allowed
    }
    assert not wrong


@pytest.mark.parametrize("package", ALLOWED)
def test_nothing_installed_imports_a_top_level_program(package):
    source = ROOT / "src" / package
    files = [path for folder in ("src", "nodes", "examples") for path in (source / folder).rglob("*.py")]
    wrong = {path.name for path in files for target in _targets(path.stem, path) if target.split(".")[0] in TOP_LEVEL}
    assert not wrong


@pytest.mark.parametrize("package", ALLOWED)
def test_package_xml_names_every_package_that_is_imported(package):
    used = {
        other.split(".")[0] for name, others in imports().items() if name.split(".")[0] == package for other in others
    }
    tree = ElementTree.parse(ROOT / "src" / package / "package.xml")
    named = {element.text for tag in ("depend", "exec_depend") for element in tree.iter(tag)}
    assert used - {package} <= named
    assert {name for name in named if name in ALLOWED} <= ALLOWED[package]


def rooms(package: str) -> dict[str, set[str]]:
    """Return, for every room of a package (a folder or module at its top), the rooms that it imports."""
    found: dict[str, set[str]] = {}
    for name, others in imports().items():
        if name.startswith(f"{package}."):
            room = name.split(".")[1]
            found.setdefault(room, set()).update(
                other.split(".")[1] for other in others if other.startswith(f"{package}.")
            )
            found[room].discard(room)
    return found


def ring(graph: dict[str, set[str]]) -> list[str]:
    """Return the members of a graph that import each other in a circle, those that lie between circles included."""
    left = dict(graph)
    while ends := [name for name in left if not left[name] & left.keys() or not any(name in left[n] for n in left)]:
        for name in ends:
            del left[name]
    return sorted(left)


@pytest.mark.parametrize("package", ALLOWED)
def test_rooms_of_a_package_import_in_one_direction(package):
    assert set(ring(rooms(package))) == RINGS.get(package, set())


def test_no_import_cycle():
    assert " -> ".join(_circle()) == ""


def test_no_interval_is_measured_by_a_clock_that_may_jump():
    """A correction of the system's clock would otherwise be seen as hours of flight."""
    jumping = re.compile(r"\btime\.time\(\)|datetime\.now\(\) -|WallTime::now|CLOCK_REALTIME|system_clock|Date\.now")
    folders = [ROOT / name for name in ("src", "benchmarks", "validation")]
    files = [path for folder in folders for kind in ("py", "cpp", "h", "js") for path in folder.rglob(f"*.{kind}")]
    found = [path for path in files if "vendor" not in path.parts and jumping.search(path.read_text(encoding="utf-8"))]
    assert len(files) > 1000
    assert found == []
