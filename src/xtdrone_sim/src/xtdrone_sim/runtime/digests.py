"""The digest file: what every participant has published and where every vehicle is, condensed, second by second.

JSON lines with ``name`` (who says it), ``time`` (simulated microseconds) and ``topics``: topic to messages, bytes and
checksum since the start, see ``xtdrone_control.lockstep.protocol.Digest``. Two flights are the same if the lines of the
same name and time are. The simulator's own lines have the topic ``truth``: the state of all vehicles at every tick.
"""

from __future__ import annotations

import contextlib
import json
import logging
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TextIO

from xtdrone_control.lockstep.protocol import DIGEST_PERIOD_US, Digest

TRUTH = "truth"


class DigestFile:
    """Writes the digest file; every line is in the file when it was written. A full disk ends it, not the flight."""

    def __init__(
        self, path: Path, name: str, own: Mapping[str, Digest], warn: Callable[[str], None] | None = None
    ) -> None:
        """Open the file.

        Args:
            path: the file; one that is there is overwritten.
            name: the simulator's node name.
            own: what the simulator publishes itself, kept up to date by the owner.
            warn: where a word goes on a file that can no longer be written; the logger of this module if none is given.

        Raises:
            OSError: it cannot be written.
        """
        self._path = path
        self._file: TextIO | None = path.open("w", encoding="utf-8", buffering=1)
        self._warn = warn or logging.getLogger(__name__).warning
        self._name = name
        self._own = own
        self._truth = Digest()
        self._period = -1

    def write(self, name: str, time_us: int, topics: Mapping[str, Sequence[int]]) -> None:
        """Write what a participant says at simulated time ``time_us``, microseconds."""
        if self._file is None:
            return
        try:
            self._file.write(json.dumps({"name": name, "time": time_us, "topics": topics}) + "\n")
        except OSError as error:
            self._warn(f"digest file {self._path}: {error.strerror or error}; no more is written")
            file, self._file = self._file, None
            with contextlib.suppress(OSError):  # it tries to write what is left
                file.close()

    def tick(self, time_us: int, truth: bytes) -> None:
        """Take in the vehicles' states at a tick, and write the simulator's own line when a second has begun.

        Args:
            time_us: simulated time, microseconds.
            truth: all vehicles' true states.
        """
        self._truth.add(time_us, memoryview(truth))
        period = time_us // DIGEST_PERIOD_US
        if period != self._period:
            self._period = period
            self._write_own(time_us)

    def close(self, time_us: int) -> None:
        """Write the simulator's last line, and close the file."""
        self._write_own(time_us)
        if self._file is not None:
            self._file.close()

    def _write_own(self, time_us: int) -> None:
        topics = {topic: digest.state() for topic, digest in self._own.items()}
        self.write(self._name, time_us, {**topics, TRUTH: self._truth.state()})
