"""``xtdrone gcs``: a ground station on the command line.

Exit status: 0 for success, 1 if a vehicle has failed, 2 for an invalid argument or file, 130 after Ctrl-C.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence

from xtdrone_interaction import cli
from xtdrone_interaction.gcs.vehicle_addresses import GcsError

from . import flight, logs, parameters, plans, status_table
from .arguments import Commands, UsageError, make_vehicle_options


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the commands."""
    parser.description = "A ground station, over MAVLink."
    commands = Commands(parser, make_vehicle_options())
    for add_to in (
        status_table.add_to,
        flight.add_to,
        plans.add_to,
        plans.add_lists_to,
        parameters.add_to,
        logs.add_to,
    ):
        add_to(commands)


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
