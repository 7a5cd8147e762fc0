"""Parameter files: one vehicle's changed parameters, in QGroundControl's ``.params`` format.

A line is ``vehicle-id <tab> component-id <tab> name <tab> value <tab> type``, ``#`` begins a comment. QGroundControl
loads these files, and this module loads what QGroundControl has saved.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Iterable
from pathlib import Path

from xtdrone_control.bounded_file import ContentError, read_text

_COLUMNS = 5
_log = logging.getLogger(__name__)

Row = tuple[str, int | float, int]  # name, value, MAV_PARAM_TYPE


def _row(line: str) -> Row:
    """Return a line's name, value and type.

    Raises:
        ValueError: it is no line of a parameter file.
    """
    columns = line.split("\t")
    if len(columns) != _COLUMNS:
        raise ValueError(f"{len(columns)} columns, {_COLUMNS} are needed")
    _vehicle, _component, name, value, kind = columns
    return name, float(value), int(kind)


def read(path: Path) -> list[Row]:
    """Return the rows of ``path``; what cannot be read is warned of and left out. No file: no rows."""
    try:
        text = read_text(path)
    except FileNotFoundError:
        return []
    except (OSError, ContentError) as error:
        _log.warning("parameter file %s cannot be read, defaults hold: %s", path, error)
        return []
    rows = []
    for number, line in enumerate(text.splitlines(), 1):
        if not line.strip() or line.startswith("#"):
            continue
        try:
            rows.append(_row(line))
        except ValueError as error:
            _log.warning("parameter file %s, line %d is skipped: %s", path, number, error)
    return rows


def write(path: Path, rows: Iterable[Row], system_id: int, component_id: int) -> None:
    """Replace ``path`` by a file of ``rows``; at no time is there half a file.

    Raises:
        OSError: it cannot be written.
    """
    lines = [
        f"# Parameters of vehicle {system_id} that differ from its defaults\n",
        "# Vehicle-Id Component-Id Name Value Type\n",
    ]
    lines += [f"{system_id}\t{component_id}\t{name}\t{value!r}\t{kind}\n" for name, value, kind in rows]
    path.parent.mkdir(parents=True, exist_ok=True)
    draft = path.with_name(path.name + ".new")
    draft.write_text("".join(lines), "utf-8")
    os.replace(draft, path)
