"""Common frame of the benchmark programs: one table format on the terminal, and the same rows as JSON."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from xtdrone_common.files import write_whole

Row = dict[str, Any]


@dataclass(frozen=True)
class Column:
    """A column of a program's table.

    Attributes:
        heading: printed above it.
        text: format string with the row's keys, as ``{real_time_factor:.1f}x``.
    """

    heading: str
    text: str

    @property
    def width(self) -> int:
        """Characters; enough for the heading and for the usual figures."""
        return max(10, len(self.heading) + 1)


def run(
    parser: argparse.ArgumentParser,
    cases: Callable[[argparse.Namespace], Iterable[Row]],
    columns: Sequence[Column],
    failures: tuple[type[Exception], ...] = (),
) -> int:
    """Measure case by case, print a line for each, and write the rows to the file of ``--json``.

    Args:
        parser: with the program's own options; ``--json`` is added.
        cases: measures the cases that the options select, one after the other; raises ``ValueError`` for a value that
            is not allowed.
        columns: of the table.
        failures: exceptions of a measurement that failed.

    Returns:
        Exit status: 0, 1 if a measurement failed, 130 after Ctrl-C. A value that is not allowed ends with status 2.
    """
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures to this file")
    arguments = parser.parse_args()
    rows: list[Row] = []
    try:
        for row in cases(arguments):
            if not rows:
                print("".join(column.heading.rjust(column.width) for column in columns))
            rows.append(row)
            cells = (column.text.format(**row).rjust(column.width) for column in columns)
            print("".join(cells), flush=True)
    except failures as error:
        print(f"ERROR: {error}", file=sys.stderr)
        return 1
    except ValueError as error:
        parser.error(str(error))
    except KeyboardInterrupt:
        return 130
    if arguments.json:
        write_whole(arguments.json, json.dumps(rows, indent=1) + "\n")
    return 0
