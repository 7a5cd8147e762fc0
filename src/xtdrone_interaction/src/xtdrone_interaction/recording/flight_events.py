"""The file of a flight's events, one line of JSON each: written while it flies, read for its report."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, TextIO

EVENTS_FILE = "events.jsonl"
"""Its name, beside the flight's bag."""


class EventsFile:
    """A text file that survives a full disk: from the first error on, writing does nothing."""

    def __init__(self, path: Path, warn: Callable[[str], None]) -> None:
        """Open ``path`` for writing, discarding its previous content.

        Args:
            path: of the file.
            warn: called once with the reason when writing fails.

        Raises:
            OSError: the file cannot be opened.
        """
        self._path = path
        self._file: TextIO | None = path.open("w", encoding="utf-8")
        self._warn = warn

    def write(self, text: str) -> None:
        """Append ``text`` and flush it."""
        if self._file is None:
            return
        try:
            self._file.write(text)
            self._file.flush()
        except OSError as error:
            self._warn(f"events file {self._path}: {error.strerror or error}; no more is written")
            self.close()

    def flush(self) -> None:
        """Do nothing; :meth:`write` flushes."""

    def close(self) -> None:
        """Close the file."""
        file, self._file = self._file, None
        if file is not None:
            with contextlib.suppress(OSError):  # closing writes what is still buffered
                file.close()


def parse_event(text: str) -> Any:
    """Return an event from its JSON, a phase under its current name.

    Raises:
        ValueError: it is not JSON.
    """
    event = json.loads(text)
    if isinstance(event, dict) and event.get("phase") == "take-off":  # as older recordings spell it
        event["phase"] = "takeoff"
    return event


def read_events(path: Path) -> list[dict[str, Any]]:
    """Return the events in a file, none if the file does not exist.

    Raises:
        ValueError: a line is not JSON.
    """
    if not path.is_file():
        return []
    lines = path.read_text(encoding="utf-8").splitlines()
    return [parse_event(line) for line in lines if line.endswith("}")]  # the last line may be cut off
