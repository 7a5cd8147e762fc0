"""Where one vehicle's logs lie: files named as PX4 names them, and their list."""

from __future__ import annotations

import calendar
import re
import time
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

_FILE = re.compile(r"(\d{4}-\d\d-\d\d)/(\d\d_\d\d_\d\d)(_\d+)?\.ulg")


@dataclass(frozen=True)
class LogEntry:
    """A log.

    Attributes:
        path: the file.
        time_utc: when it was begun, in seconds since 1970, by simulated time; as its name says.
        size: bytes.
    """

    path: Path
    time_utc: int
    size: int


def log_name(utc_s: int) -> str:
    """Return PX4's name of a log begun at ``utc_s`` (seconds since 1970): date, and time of day."""
    return time.strftime("%Y-%m-%d/%H_%M_%S.ulg", time.gmtime(utc_s))


class LogFolder:
    """The logs of one vehicle: ``<root>/<date>/<hour>_<minute>_<second>.ulg``.

    Attributes:
        root: the vehicle's folder; it need not exist yet.
        current: the log that is being written, None when none is.
    """

    def __init__(self, root: Path) -> None:
        """Look at ``root``."""
        self.root = root
        self.current: Path | None = None

    def create(self, name: str) -> tuple[Path, BinaryIO]:
        """Make a new file for ``name``, a log's name, and return it opened.

        A file that is there stays: the new one's name gets a number, ``_1`` and so on.

        Raises:
            OSError: it cannot be made.
        """
        wanted = self.root / name
        wanted.parent.mkdir(parents=True, exist_ok=True)
        number = 0
        while True:
            path = wanted if not number else wanted.with_stem(f"{wanted.stem}_{number}")
            try:
                return path, path.open("xb")
            except FileExistsError:
                number += 1

    def entries(self) -> list[LogEntry]:
        """Return the logs, the oldest first; links and other files are not among them."""
        found: list[LogEntry] = []
        for path in self.root.glob("*/*.ulg"):
            match = _FILE.fullmatch(path.relative_to(self.root).as_posix())
            if match is None or path.is_symlink() or path.parent.is_symlink() or not path.is_file():
                continue
            try:
                begun = calendar.timegm(time.strptime(match[1] + match[2], "%Y-%m-%d%H_%M_%S"))
                found.append(LogEntry(path, begun, path.stat().st_size))
            except (ValueError, OSError):  # no such day, or somebody has just removed it
                continue
        return sorted(found, key=lambda entry: (entry.time_utc, len(entry.path.name), entry.path.name))

    def erase(self) -> None:
        """Remove all logs but the one that is being written.

        Raises:
            OSError: one cannot be removed.
        """
        for entry in self.entries():
            if entry.path != self.current:
                entry.path.unlink(missing_ok=True)
