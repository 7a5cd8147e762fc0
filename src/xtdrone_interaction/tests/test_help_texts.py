"""scripts/help.txt holds the help of each command, so that it needs no set-up; as a program, update the file."""

from __future__ import annotations

import os
from pathlib import Path
from unittest import mock

from xtdrone_interaction.cli import parsers, read_commands

PAGE = Path(__file__).resolve().parents[3] / "scripts" / "help.txt"
_WIDTH = 80  # columns


def current() -> str:
    """Return the help of every command and sub-command, each below a line "== xtdrone NAME"."""
    with mock.patch.dict(os.environ, COLUMNS=str(_WIDTH)):
        return "\n".join(
            f"== {path}\n{parser.format_help()}"
            for command in read_commands().values()
            if command.module
            for path, parser in parsers(command)
        )


def test_the_help_of_each_command_is_stored() -> None:
    assert PAGE.read_text(encoding="utf-8") == current(), f"run: ./xtdrone shell python {__file__}"


if __name__ == "__main__":
    PAGE.write_text(current(), encoding="utf-8")
