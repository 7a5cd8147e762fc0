"""``xtdrone gcs``: a ground station on the command line.

Exit status: 0 for success, 1 if a vehicle has failed, 2 for an invalid argument or file, 130 after Ctrl-C.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence

from xtdrone_interaction import cli

from ..vehicle_addresses import GcsError
from . import flight, logs, parameters, plan_lists, plans, status_table
from .arguments import Runner, UsageError, common


class _Commands:
    """The sub-commands of a parser; see ``Adder``."""

    def __init__(self, parser: argparse.ArgumentParser, vehicles: argparse.ArgumentParser) -> None:
        self._commands = parser.add_subparsers(required=True, metavar="COMMAND")
        self._vehicles = vehicles

    def __call__(self, name: str, run: Runner, text: str, for_vehicles: bool = True) -> argparse.ArgumentParser:
        parents = [self._vehicles] if for_vehicles else []
        command = self._commands.add_parser(name, parents=parents, help=text, description=text)
        command.set_defaults(run=run)
        return command

    def group(self, name: str, text: str) -> _Commands:
        return _Commands(self._commands.add_parser(name, help=text, description=text), self._vehicles)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the commands."""
    parser.description = "A ground station, over MAVLink."
    commands = _Commands(parser, common())
    for module in (status_table, flight, plans, plan_lists, parameters, logs):
        module.add_to(commands)


def main(argv: Sequence[str]) -> int:
    """Run ``xtdrone gcs`` with the arguments after "gcs"; return the exit status."""
    return cli.main(["gcs", *argv])


def run(arguments: argparse.Namespace) -> int:
    """Run a command and return the exit status."""
    try:
        exit_status = int(arguments.run(arguments))
        print(end="", flush=True)
        return exit_status
    except (UsageError, GcsError) as error:
        for line in str(error).splitlines():
            print(f"xtdrone gcs: {line}", file=sys.stderr)
        return 2 if isinstance(error, UsageError) else 1
    except BrokenPipeError:  # the reader has closed the pipe
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except KeyboardInterrupt:
        return 130
