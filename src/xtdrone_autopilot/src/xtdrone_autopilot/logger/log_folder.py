"""Log folder of one vehicle, with PX4's file names."""

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
    """Log file.

    Attributes:
        path: path of the file.
        time_utc: start of the log by simulated time, from the file name, s since 1970.
        size: file size, bytes.
    """

    path: Path
    time_utc: int
    size: int


def log_name(utc_s: int) -> str:
    """Return PX4's name of a log started at ``utc_s`` (s since 1970): ``<date>/<hour>_<minute>_<second>.ulg``."""
    return time.strftime("%Y-%m-%d/%H_%M_%S.ulg", time.gmtime(utc_s))


class LogFolder:
    """Logs of one vehicle: ``<root>/<date>/<hour>_<minute>_<second>.ulg``.

    Attributes:
        root: the vehicle's log folder; need not exist yet.
        current: log being written, or None.
    """

    def __init__(self, root: Path) -> None:
        """Use the folder ``root``."""
        self.root = root
        self.current: Path | None = None

    def create(self, name: str) -> tuple[Path, BinaryIO]:
        """Create and open a log file named ``name``.

        An existing file is kept; the new name then gets a suffix ``_1``, ``_2`` and so on.

        Raises:
            OSError: the file cannot be created.
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
        """Return the logs, oldest first, without symbolic links and other files."""
        found: list[LogEntry] = []
        for path in self.root.glob("*/*.ulg"):
            match = _FILE.fullmatch(path.relative_to(self.root).as_posix())
            if match is None or path.is_symlink() or path.parent.is_symlink() or not path.is_file():
                continue
            try:
                begun = calendar.timegm(time.strptime(match[1] + match[2], "%Y-%m-%d%H_%M_%S"))
                found.append(LogEntry(path, begun, path.stat().st_size))
            except (ValueError, OSError):  # invalid date, or removed in the meantime
                continue
        return sorted(found, key=lambda entry: (entry.time_utc, len(entry.path.name), entry.path.name))

    def erase(self) -> None:
        """Delete all logs except the one being written.

        Raises:
            OSError: a log cannot be deleted.
        """
        for entry in self.entries():
            if entry.path != self.current:
                entry.path.unlink(missing_ok=True)
