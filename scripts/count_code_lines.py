#!/usr/bin/env python3
"""Count the lines of Python code outside tests: ``python scripts/count_code_lines.py [FOLDER] [-v]``.

Blank lines, docstrings and comments do not count. The command prints packages, with ``-v`` also their rooms (folders of
a package's library) and the small modules. ``tests/test_code_size.py`` limits the figures.
"""

from __future__ import annotations

import argparse
import ast
import io
import subprocess
import tokenize
from collections import Counter
from collections.abc import Mapping
from pathlib import Path, PurePosixPath

SMALL = 40
"""Library modules with fewer lines of code are small."""
_ONE_PER_PLUGIN = ("mavros/plugins", "mavros/extras")  # rooms with a module per MAVROS plugin, of any size
_LAYOUT = frozenset(
    {tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.ENDMARKER}
)


def count_code_lines(source: str) -> int:
    """Return the number of lines of a module that hold code."""
    documented: set[int] = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str):
            documented.update(range(node.lineno, (node.end_lineno or node.lineno) + 1))
    lines: set[int] = set()
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type not in _LAYOUT:
            lines.update(range(token.start[0], token.end[0] + 1))
    return len(lines - documented)


def count_modules(root: Path) -> dict[str, int]:
    """Return the lines of code of every tracked module below a folder that is no test, by its path there."""
    files = subprocess.run(["git", "ls-files", "*.py"], cwd=root, check=True, capture_output=True, text=True).stdout
    return {
        name: count_code_lines((root / name).read_text(encoding="utf-8"))
        for name in files.split()
        if "tests" not in PurePosixPath(name).parts[:-1] and name != "conftest.py" and (root / name).is_file()
    }


def package_of(name: str) -> str:
    """Return the package of a module: the folder below ``src``, or the top-level folder."""
    parts = PurePosixPath(name).parts
    return parts[1] if parts[0] == "src" else parts[0]


def room_of(name: str) -> str | None:
    """Return the room of a library module, None for a node, a script and a set-up file."""
    parts = PurePosixPath(name).parts
    if parts[0] != "src" or len(parts) < 5 or parts[2] != "src":
        return None
    return f"{parts[1]}/{parts[4] if len(parts) > 5 else 'flat'}"


def sum_by_package(modules: Mapping[str, int]) -> Counter[str]:
    """Return the lines of code of each package."""
    packages: Counter[str] = Counter()
    for name, lines in modules.items():
        packages[package_of(name)] += lines
    return packages


def find_small_modules(modules: Mapping[str, int]) -> dict[str, int]:
    """Return the library modules with fewer than SMALL lines of code, without those that only name a package."""
    return {
        name: lines
        for name, lines in sorted(modules.items())
        if lines < SMALL
        and PurePosixPath(name).parts[2:3] == ("src",)
        and not name.endswith("__init__.py")
        and not any(room in name for room in _ONE_PER_PLUGIN)
    }


def main() -> None:
    """Print the figures of a folder."""
    parser = argparse.ArgumentParser(description="Count the lines of Python code outside tests.")
    parser.add_argument("folder", type=Path, nargs="?", default=Path("."), metavar="FOLDER")
    parser.add_argument("-v", "--verbose", action="store_true", help="list rooms and small modules, too")
    arguments = parser.parse_args()
    modules = count_modules(arguments.folder)
    files = Counter(map(package_of, modules))
    small = find_small_modules(modules)
    print(f"{'all':28}{sum(modules.values()):7}{len(modules):6} files")
    for package, lines in sum_by_package(modules).most_common():
        print(f"{package:28}{lines:7}{files[package]:6}")
    print(f"{len(small)} library modules under {SMALL} lines of code")
    if arguments.verbose:
        rooms: Counter[str] = Counter()
        for name, lines in modules.items():
            if room := room_of(name):
                rooms[room] += lines
        for room, lines in sorted(rooms.items()):
            print(f"  {room:44}{lines:6}")
        for name, lines in small.items():
            print(f"{lines:4} {name}")


if __name__ == "__main__":
    main()
