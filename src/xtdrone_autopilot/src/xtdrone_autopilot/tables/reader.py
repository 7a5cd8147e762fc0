"""Reader of the CSV files in this folder, whose first line names the columns."""

from __future__ import annotations

import csv
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

Converter = Callable[[str], Any]

_FOLDER = Path(__file__).parent


class TableError(ValueError):
    """An invalid table; the message names the file, the line, the value and what is allowed."""


def number(text: str) -> int | float:
    """Return an integer, or a float for a text with a decimal point or an exponent.

    Raises:
        ValueError: the text is not a number.
    """
    return float(text) if "." in text or "e" in text else int(text)


def one_of(*allowed: str) -> Converter:
    """Return a converter that accepts only the texts ``allowed``."""

    def convert(text: str) -> str:
        if text not in allowed:
            raise ValueError(text)
        return text

    convert.__name__ = " or ".join(allowed)
    return convert


def read_table(name: str, columns: Mapping[str, Converter], folder: Path = _FOLDER) -> list[list[Any]]:
    """Return the rows of a table.

    Args:
        name: Name of the table, that of its file without ``.csv``.
        columns: Names of the columns in the file's order, with the converters of their texts, which raise ValueError.
        folder: Folder of the file.

    Raises:
        TableError: other columns, or a value that a converter rejects.
        OSError: the file cannot be read.
    """
    path = folder / f"{name}.csv"
    converters = list(columns.values())
    rows: list[list[Any]] = []
    with path.open(newline="", encoding="utf-8") as file:
        lines = csv.reader(file, strict=True)
        if (head := next(lines, [])) != list(columns):
            raise TableError(f"{path}, line 1: {','.join(head)} is not allowed, {','.join(columns)}")
        for line in lines:
            if len(line) != len(converters):
                raise TableError(f"{path}, line {lines.line_num}: {len(line)} values, {len(converters)} are allowed")
            try:
                rows.append([convert(text) for convert, text in zip(converters, line)])  # noqa: B905 - checked above
            except ValueError as error:
                raise TableError(f"{path}, line {lines.line_num}: {_reason(columns, line)}") from error
    return rows


def _reason(columns: Mapping[str, Converter], line: list[str]) -> str:
    """Return the first value of a line that its converter rejects, and what is allowed."""
    for (name, convert), text in zip(columns.items(), line, strict=True):
        try:
            convert(text)
        except ValueError:
            return f"{name}: {text!r} is not allowed, {convert.__name__}"
    return "a value changes between two conversions"
