"""Terminal output of commands: a console that survives a closed pipe, and one-line errors."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable

from rich.console import Console


class PatientConsole(Console):
    """A console that goes silent when its reader closes the pipe (``| head``), where rich's own exits."""

    def on_broken_pipe(self) -> None:
        """Stop printing, and let the command continue."""
        self.quiet = True
        sink = os.open(os.devnull, os.O_WRONLY)
        os.dup2(sink, sys.stdout.fileno())
        os.close(sink)


def run_reported(action: Callable[[], int]) -> int:
    """Run a demo or a report; print an error on one line.

    Returns:
        Its exit status; 2 for an invalid value, 1 for another error.
    """
    from xtdrone_common.fleet import FleetError
    from xtdrone_coordination.patterns import PatternError
    from xtdrone_interaction.command_options import OptionError
    from xtdrone_interaction.launching.supervised_launch import DemoError

    try:
        return action()
    except (OptionError, PatternError, FleetError) as error:
        print(f"xtdrone: {error}", file=sys.stderr)
        return 2
    except DemoError as error:
        print(f"xtdrone: {error}", file=sys.stderr)
        return 1
    except OSError as error:
        print(f"xtdrone: {error.filename or 'system'}: {error.strerror or error}", file=sys.stderr)
        return 1
