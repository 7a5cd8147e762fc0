"""``xtdrone gcs``: a ground station on the command line, over MAVLink as any other.

Exit status: 0 when all was done, 1 when some vehicle has not done it, 2 for a value or file that is not allowed, 130
after Ctrl-C.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence

from xtdrone_interaction import cli

from . import flight_command, list_command, log_command, parameter_command, plan_command, status_command
from .arguments import Runner, UsageError, common
from .peers import GcsError


class _Commands:
    """The commands of a parser; see ``Adder``."""

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
    for module in (status_command, flight_command, plan_command, list_command, parameter_command, log_command):
        module.add_to(commands)


def main(argv: Sequence[str]) -> int:
    """Run ``xtdrone gcs`` with the arguments after "gcs"; return the exit status."""
    return cli.main(["gcs", *argv])


def run(arguments: argparse.Namespace) -> int:
    """Run a command and return the exit status."""
    try:
        status = int(arguments.run(arguments))
        print(end="", flush=True)
        return status
    except (UsageError, GcsError) as error:
        for line in str(error).splitlines():
            print(f"xtdrone gcs: {line}", file=sys.stderr)
        return 2 if isinstance(error, UsageError) else 1
    except BrokenPipeError:  # whoever reads has enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except KeyboardInterrupt:
        return 130
