"""Results that ``analyse`` or a demo has written beside a recording: figures and pictures."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

REPORT = "report.json"
PICTURES = ".png"
MOST_PICTURE = 4 << 20
"""Bytes of a picture that a page gets."""
_MOST_REPORT = 8 << 20  # bytes
_MOST_FIGURES = 500
_MOST_PICTURES = 40


@dataclass(frozen=True)
class Results:
    """Results of one recording.

    Attributes:
        folder: that holds them.
        pictures: paths, by name.
        figures: name, as ``vehicles.iris_0.way``, and value, a number, a truth value or a text.
        trouble: why there are no figures; empty otherwise.
    """

    folder: Path
    pictures: tuple[Path, ...]
    figures: tuple[tuple[str, Any], ...]
    trouble: str = ""


def results_folder(recording: Path) -> Path | None:
    """Return the folder with a recording's results: that of ``analyse``, else its own; None without a report."""
    folders = (recording.with_name(f"{recording.stem}-analysis"), recording.parent)
    return next((folder for folder in folders if (folder / REPORT).is_file()), None)


def read_results(recording: Path) -> Results | None:
    """Return a recording's results; None without any."""
    folder = results_folder(recording)
    if folder is None:
        return None
    pictures = sorted(path for path in folder.glob(f"*{PICTURES}") if path.is_file() and not path.is_symlink())
    try:
        figures = _figures(folder / REPORT)
    except (OSError, ValueError, RecursionError) as error:
        return Results(folder, tuple(pictures[:_MOST_PICTURES]), (), f"{REPORT} cannot be read: {error}")
    return Results(folder, tuple(pictures[:_MOST_PICTURES]), figures)


def _figures(report: Path) -> tuple[tuple[str, Any], ...]:
    size = report.stat().st_size
    if size > _MOST_REPORT:
        raise ValueError(f"{size} bytes are not allowed, at most {_MOST_REPORT}")
    content = json.loads(report.read_text(encoding="utf-8"))
    if not isinstance(content, dict):
        raise ValueError("no object")
    return tuple(entry for entry, _ in zip(_leaves(content, ""), range(_MOST_FIGURES), strict=False))


def _leaves(tree: Mapping[str, Any], prefix: str) -> Iterator[tuple[str, Any]]:
    """Yield single values, outermost ones first; lists, which are series and tables, are left out."""
    for name, value in tree.items():
        if isinstance(value, (bool, int, float, str)):
            yield f"{prefix}{name}", value
    for name, value in tree.items():
        if isinstance(value, dict):
            yield from _leaves(value, f"{prefix}{name}.")
