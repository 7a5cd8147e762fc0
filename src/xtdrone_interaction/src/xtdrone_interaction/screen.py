"""Where commands write that must go on when nobody reads any more."""

from __future__ import annotations

import os
import sys

from rich.console import Console


class PatientConsole(Console):
    """A console that falls silent when its reader has gone (``| head``), where rich's own ends the program."""

    def on_broken_pipe(self) -> None:
        """Say nothing more, and let what is running run."""
        self.quiet = True
        sink = os.open(os.devnull, os.O_WRONLY)
        os.dup2(sink, sys.stdout.fileno())
        os.close(sink)
