"""The digest file: checksums of all messages of participants and of the vehicles' states, once per simulated second.

JSON lines with ``name`` (the participant), ``time`` (simulated microseconds) and ``topics``: by topic, the number of
messages, of bytes, and the checksum since the start, see ``xtdrone_lockstep.protocol.Digest``. Two flights are
identical if their lines of equal name and time are. The simulator's own lines include the topic ``truth``: the state of
all vehicles at every tick.
"""

from __future__ import annotations

import contextlib
import json
import logging
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TextIO

from xtdrone_lockstep.protocol import DIGEST_PERIOD_US, Digest

TRUTH = "truth"


class DigestFile:
    """Writes the digest file, flushing every line. A write error ends the file and leaves the flight running."""

    def __init__(
        self, path: Path, name: str, own: Mapping[str, Digest], warn: Callable[[str], None] | None = None
    ) -> None:
        """Open the file.

        Args:
            path: the file; an existing one is overwritten.
            name: node name of the simulator.
            own: digests of the simulator's own topics, updated by their owner.
            warn: logs a write error; by default the logger of this module.

        Raises:
            OSError: the file cannot be opened for writing.
        """
        self._path = path
        self._file: TextIO | None = path.open("w", encoding="utf-8", buffering=1)
        self._warn = warn or logging.getLogger(__name__).warning
        self._name = name
        self._own = own
        self._truth = Digest()
        self._period = -1

    def write(self, name: str, time_us: int, topics: Mapping[str, Sequence[int]]) -> None:
        """Write the digests of a participant at simulated time ``time_us``, microseconds."""
        if self._file is None:
            return
        try:
            self._file.write(json.dumps({"name": name, "time": time_us, "topics": topics}) + "\n")
        except OSError as error:
            self._warn(f"digest file {self._path}: {error.strerror or error}; nothing more is written")
            file, self._file = self._file, None
            with contextlib.suppress(OSError):  # closing retries the failed write
                file.close()

    def tick(self, time_us: int, truth: bytes) -> None:
        """Add the states of the vehicles at a tick, and write the simulator's own line at the start of each second.

        Args:
            time_us: simulated time, microseconds.
            truth: true states of all vehicles, as bytes.
        """
        self._truth.add(time_us, memoryview(truth))
        period = time_us // DIGEST_PERIOD_US
        if period != self._period:
            self._period = period
            self._write_own(time_us)

    def close(self, time_us: int) -> None:
        """Write the simulator's last line and close the file."""
        self._write_own(time_us)
        if self._file is not None:
            self._file.close()

    def _write_own(self, time_us: int) -> None:
        topics = {topic: digest.state() for topic, digest in self._own.items()}
        self.write(self._name, time_us, {**topics, TRUTH: self._truth.state()})
