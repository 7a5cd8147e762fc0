"""Each package's README names its rooms, and docs/images/packages.svg draws the packages; as a program, write both."""

from __future__ import annotations

import ast
import re
from html import escape
from pathlib import Path

import pytest
from test_architecture import ALLOWED, ROOT, imports, modules, rooms

PICTURE = ROOT / "docs" / "images" / "packages.svg"
_BEGIN, _END = "<!-- rooms: written by `python tests/test_package_pages.py` -->", "<!-- end of rooms -->"
_BOX, _HEIGHT, _GAP, _LAYER, _MARGIN = 132, 46, 20, 96, 24  # pixels


def used(package: str) -> set[str]:
    """Return the packages that a package imports."""
    return {
        other.split(".")[0]
        for name, others in imports().items()
        if name.split(".")[0] == package
        for other in others
        if other.split(".")[0] != package
    }


def layers() -> list[list[str]]:
    """Return the packages from the ground up: each as low as its imports allow."""
    level: dict[str, int] = {}
    for _ in ALLOWED:
        for package in ALLOWED:
            level[package] = max((level.get(other, 0) + 1 for other in used(package)), default=0)
    return [[package for package in ALLOWED if level[package] == n] for n in range(max(level.values()) + 1)]


def arrows() -> list[tuple[str, str]]:
    """Return the imports between packages without those that follow from others, as (importing, imported)."""
    reach = {package: used(package) for package in ALLOWED}
    for _ in ALLOWED:
        for others in reach.values():
            others |= {far for other in others for far in reach[other]}
    return [
        (package, other)
        for package in ALLOWED
        for other in sorted(used(package))
        if not any(other in reach[between] for between in used(package) - {other})
    ]


def picture() -> str:
    """Return the drawing of the packages and their imports as SVG."""
    floors = layers()
    width = max(len(floor) for floor in floors) * (_BOX + _GAP) - _GAP + 2 * _MARGIN
    height = len(floors) * _LAYER - (_LAYER - _HEIGHT) + 2 * _MARGIN
    place = {
        package: (
            (width - len(floor) * (_BOX + _GAP) + _GAP) / 2 + column * (_BOX + _GAP),
            height - _MARGIN - _HEIGHT - row * _LAYER,
        )
        for row, floor in enumerate(floors)
        for column, package in enumerate(floor)
    }
    lines = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" font-size="14">',
        "<title>The packages: an arrow leads from a package to one that it imports</title>",
        '<marker id="tip" viewBox="0 0 8 8" refX="8" refY="4" markerWidth="8" markerHeight="8" orient="auto">'
        '<path d="M0 0 8 4 0 8z" fill="#557"/></marker>',
        f'<rect width="{width}" height="{height}" fill="white"/>',
    ]
    for package, other in arrows():
        (x1, y1), (x2, y2) = place[package], place[other]
        lines.append(
            f'<line x1="{x1 + _BOX / 2:g}" y1="{y1 + _HEIGHT:g}" x2="{x2 + _BOX / 2:g}" y2="{y2:g}" stroke="#557" '
            'marker-end="url(#tip)"/>'
        )
    for package, (x, y) in place.items():
        lines += [
            f'<rect x="{x:g}" y="{y:g}" width="{_BOX}" height="{_HEIGHT}" rx="6" fill="#e8eefc" stroke="#335"/>',
            f'<text x="{x + _BOX / 2:g}" y="{y + 28:g}" text-anchor="middle">{escape(package[8:])}</text>',
        ]
    return "\n".join([*lines, "</svg>", ""])


def _purpose(path: Path) -> str:
    """Return the first sentence of a module's docstring."""
    text = ast.get_docstring(ast.parse(path.read_bytes())) or ""
    return " ".join(text.split("\n\n")[0].split())


def room_table(package: str) -> str:
    """Return the table of a package's rooms, with what each is for, and the packages that it may import."""
    rows = [
        f"| `{room}` | {_purpose(modules()[f'{package}.{room}'])} |"
        for room in sorted(rooms(package))
        if not room.startswith("__")
    ]
    below = ", ".join(f"`{name}`" for name in ALLOWED if name in ALLOWED[package]) or "no package of this repository"
    return "\n".join(
        [_BEGIN, "", "| room | what it is for |", "|---|---|", *rows, "", f"May import: {below}.", "", _END]
    )


def page(package: str) -> str:
    """Return the README of a package with its table as the modules state it."""
    text = (ROOT / "src" / package / "README.md").read_text(encoding="utf-8")
    return re.sub(f"{re.escape(_BEGIN)}.*?{re.escape(_END)}", lambda _: room_table(package), text, flags=re.DOTALL)


@pytest.mark.parametrize("package", ALLOWED)
def test_readme_lists_every_room_with_its_purpose(package):
    assert _BEGIN in page(package)
    assert (ROOT / "src" / package / "README.md").read_text(encoding="utf-8") == page(package)
    assert not re.search(r"^\| `\w+` \|  \|$", page(package), re.MULTILINE)


def test_picture_shows_the_imports():
    assert PICTURE.read_text(encoding="utf-8") == picture()


if __name__ == "__main__":
    for name in ALLOWED:
        (ROOT / "src" / name / "README.md").write_text(page(name), encoding="utf-8")
    PICTURE.write_text(picture(), encoding="utf-8")
