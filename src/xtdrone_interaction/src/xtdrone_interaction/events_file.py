"""The file of a flight's events, a line of JSON each: its disk may fill up while the flight goes on."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from pathlib import Path
from typing import TextIO


class EventsFile:
    """A text file that is written until the disk takes no more, which raises nothing."""

    def __init__(self, path: Path, warn: Callable[[str], None]) -> None:
        """Open ``path`` for writing; what it had is gone.

        Args:
            path: of the file.
            warn: called once if nothing more can be written, with the reason.

        Raises:
            OSError: it cannot be opened.
        """
        self._path = path
        self._file: TextIO | None = path.open("w", encoding="utf-8")
        self._warn = warn

    def write(self, text: str) -> None:
        """Add ``text``, which is on the disk when this returns."""
        if self._file is None:
            return
        try:
            self._file.write(text)
            self._file.flush()
        except OSError as error:
            self._warn(f"events file {self._path}: {error.strerror or error}; no more is written")
            self.close()

    def flush(self) -> None:
        """Do nothing: ``write`` has done it."""

    def close(self) -> None:
        """Close the file."""
        file, self._file = self._file, None
        if file is not None:
            with contextlib.suppress(OSError):  # it tries to write what is left
                file.close()
