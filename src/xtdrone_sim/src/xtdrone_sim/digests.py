"""The digest file: what every participant has published and where every vehicle is, condensed, second by second.

JSON lines with ``name`` (who says it), ``time`` (simulated microseconds) and ``topics``: topic to messages, bytes and
checksum since the start, see ``xtdrone_control.lockstep.protocol.Digest``. Two flights are the same if the lines of the
same name and time are. The simulator's own lines have the topic ``truth``: the state of all vehicles at every tick.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TextIO

from xtdrone_control.lockstep.protocol import DIGEST_PERIOD_US, Digest

from .world import World

TRUTH = "truth"


class DigestFile:
    """Writes the digest file; every line is in the file when it was written."""

    def __init__(self, path: Path, name: str, own: Mapping[str, Digest]) -> None:
        """Open the file.

        Args:
            path: the file; one that is there is overwritten.
            name: the simulator's node name.
            own: what the simulator publishes itself, kept up to date by the owner.

        Raises:
            OSError: it cannot be written.
        """
        self._file: TextIO = path.open("w", encoding="utf-8", buffering=1)
        self._name = name
        self._own = own
        self._truth = Digest()
        self._period = -1

    def write(self, name: str, time_us: int, topics: Mapping[str, Sequence[int]]) -> None:
        """Write what a participant says at simulated time ``time_us``, microseconds."""
        self._file.write(json.dumps({"name": name, "time": time_us, "topics": topics}) + "\n")

    def tick(self, time_us: int, world: World) -> None:
        """Take in the vehicles' states at a tick, and write the simulator's own line when a second has begun."""
        self._truth.add(time_us, memoryview(world.plant.tobytes()))
        period = time_us // DIGEST_PERIOD_US
        if period != self._period:
            self._period = period
            self._write_own(time_us)

    def close(self, time_us: int) -> None:
        """Write the simulator's last line, and close the file."""
        self._write_own(time_us)
        self._file.close()

    def _write_own(self, time_us: int) -> None:
        topics = {topic: digest.state() for topic, digest in self._own.items()}
        self.write(self._name, time_us, {**topics, TRUTH: self._truth.state()})
