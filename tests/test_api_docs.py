"""docs/api/*.md hold the public API as the docstrings describe it; as a program, write the pages."""

from __future__ import annotations

import inspect
import re
import textwrap
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

import xtdrone_lockstep as lockstep
from xtdrone_common.fleet import Vehicle, fleet_text, parse_fleet, read_fleet_file, spawn_grid
from xtdrone_coordination.array_follower import ArrayFollower
from xtdrone_coordination.follower import Follower, FollowerOptions
from xtdrone_coordination.laws.consensus import Peer
from xtdrone_coordination.leader import Assignment, Leader, LeaderOptions, assign
from xtdrone_coordination.network import NetworkOptions
from xtdrone_sim.simulation import Simulation
from xtdrone_swarm.swarm import Swarm

FOLDER = Path(__file__).parents[1] / "docs" / "api"
_LOCKSTEP = tuple(getattr(lockstep, name) for name in lockstep.__all__ if callable(getattr(lockstep, name)))
PAGES: dict[str, tuple[str, tuple[Any, ...]]] = {
    "coordination": (
        "Leader and follower",
        (Follower, FollowerOptions, Peer, ArrayFollower, Leader, LeaderOptions, Assignment, assign),
    ),
    "swarm": ("Swarm in one process", (Swarm, NetworkOptions)),
    "lockstep": ("Lockstep", _LOCKSTEP),
    "simulation": (
        "Simulation without ROS",
        (Simulation, Vehicle, parse_fleet, read_fleet_file, fleet_text, spawn_grid),
    ),
}
_SECTION = re.compile(r"^(Args|Attributes|Returns|Raises|Yields):\n((?:(?: +.*)?(?:\n|$))+)", re.MULTILINE)
_ITEM = re.compile(r"^(\*{0,2}\w[\w, ]*): (.*(?:\n +.*)*)", re.MULTILINE)
_ROLE = re.compile(r":(?:class|meth|func|mod|attr):`~?([^`]*)`")


def page(name: str) -> str:
    """Return the text of a page."""
    title, entries = PAGES[name]
    parts = [f"# {title}", "Written from the docstrings by `python tests/test_api_docs.py`."]
    for entry in entries:
        parts += _described(entry)
    return "\n\n".join(parts) + "\n"


def _described(entry: Any) -> Iterator[str]:
    yield f"## `{entry.__name__}`"
    yield f"```python\nfrom {entry.__module__} import {entry.__name__}\n\n{_signature(entry, entry.__name__)}\n```"
    yield from _paragraphs(entry)
    if not inspect.isclass(entry):
        return
    constructor = vars(entry).get("__init__")
    if constructor is not None and constructor.__doc__:
        yield from _paragraphs(constructor)
    for name, member in _members(entry):
        if isinstance(member, property):
            yield f"### `{entry.__name__}.{name}`"
            yield from _paragraphs(member)
        else:
            yield f"### `{_signature(member, f'{entry.__name__}.{name}')}`"
            yield from _paragraphs(member)


def _members(cls: type) -> Iterator[tuple[str, Any]]:
    """Yield the public methods and properties that the class itself defines, in order of the source."""
    for name, member in vars(cls).items():
        plain = member.__func__ if isinstance(member, classmethod | staticmethod) else member
        if not name.startswith("_") and (isinstance(plain, property) or inspect.isfunction(plain)) and plain.__doc__:
            yield name, plain


def _signature(entry: Any, name: str) -> str:
    try:
        signature = inspect.signature(entry)
    except ValueError:
        return name
    kept = [p.replace(annotation=p.empty) for p in signature.parameters.values() if p.name not in ("self", "cls")]
    shown = signature.replace(parameters=kept, return_annotation=signature.empty)
    return name + re.sub(r"<factory>|<object object at [^>]*>", "...", str(shown))


def _paragraphs(entry: Any) -> Iterator[str]:
    """Yield a docstring as Markdown: its sections become lists."""
    text = _ROLE.sub(r"`\1`", inspect.cleandoc(entry.__doc__ or "")).replace("``", "`")
    end = 0
    for match in _SECTION.finditer(text):
        yield from filter(None, [_plain(text[end : match.start()])])
        yield f"{match[1]}:"
        body = textwrap.dedent(match[2]).strip()
        items = _ITEM.findall(body)
        yield "\n".join(f"- `{name}`: {' '.join(words.split())}" for name, words in items) if items else body
        end = match.end()
    yield from filter(None, [_plain(text[end:])])


def _plain(text: str) -> str:
    """Return paragraphs, with indented examples as code."""
    return re.sub(r"::\n\n((?: {4}.*(?:\n|$)|\n)+)", lambda match: f":\n\n{_code(match[1])}\n\n", text).strip()


def _code(text: str) -> str:
    return f"```python\n{textwrap.dedent(text).strip()}\n```"


@pytest.mark.parametrize("name", PAGES)
def test_the_page_is_current(name: str) -> None:
    assert (FOLDER / f"{name}.md").read_text(encoding="utf-8") == page(name)


def test_a_page_shows_signatures_sections_and_examples() -> None:
    text = page("coordination")
    assert "### `Leader.assignment(current, target)`" in text
    assert "- `current`: positions of the followers relative to the leader, shape (N-1, 3), m ENU." in text
    assert _plain("Use it so::\n\n    a = 1\n\nThen stop.") == "Use it so:\n\n```python\na = 1\n```\n\nThen stop."


if __name__ == "__main__":
    for page_name in PAGES:
        (FOLDER / f"{page_name}.md").write_text(page(page_name), encoding="utf-8")
