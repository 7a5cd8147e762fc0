"""The station's recorder: rosbag with a profile of ``./xtdrone record``, started and stopped by a page.

It ends with the station, also with one that is killed, and closes its file: no page could stop it afterwards.
"""

from __future__ import annotations

import os
import shutil
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from xtdrone_interaction.bags.record_by_profile import read_profile, rosbag_arguments
from xtdrone_interaction.command_options import OptionError
from xtdrone_interaction.launching.process_tree import ProcessTree

PROFILES = ("light", "full", "cameras", "slam")
_STOP_LIMIT = 30.0  # s of wall time for rosbag to write what it has


@dataclass(frozen=True)
class _Running:
    tree: ProcessTree
    profile: str
    name: str
    began: float  # s of the monotonic clock


class RecorderProcess:
    """At most one rosbag, a plain subscriber out of the lockstep."""

    def __init__(self, folder: Path, master: str) -> None:
        """Create a recorder that is not recording.

        Args:
            folder: of the files.
            master: URI of the ROS master.
        """
        self._folder = folder
        self._master = master
        self._running: _Running | None = None

    def start(self, profile: str, instance: int = 0) -> None:
        """Begin to record. Call it in the main thread: the recorder ends with the thread that has started it.

        Args:
            profile: one of ``PROFILES``.
            instance: of the simulation on its machine: two may record into one folder.

        Raises:
            OptionError: one is running already, the profile is not known, or rosbag is missing.
        """
        if self.state()["recording"]:
            raise OptionError("record: a recording is already running; stop it first")
        if profile not in PROFILES:
            raise OptionError(f"profile: {str(profile)[:60]!r} is not allowed, one of {', '.join(PROFILES)}")
        program = shutil.which("rosbag")
        if program is None:
            raise OptionError("record: rosbag is not installed; './xtdrone setup' installs it")
        self._folder.mkdir(parents=True, exist_ok=True)
        suffix = f"-{instance}" if instance else ""
        name = f"{time.strftime('%Y%m%d-%H%M%S')}-{profile}{suffix}"
        arguments = rosbag_arguments(read_profile(profile), str(self._folder / name))
        environment = {**os.environ, "ROS_MASTER_URI": self._master}
        tree = ProcessTree([program, *arguments], environment, Path(os.devnull))
        self._running = _Running(tree, profile, name, time.monotonic())

    def stop(self) -> str:
        """End the recording and return the files' name, once rosbag has closed them.

        Raises:
            OptionError: none is running.
        """
        running = self._running
        if running is None:
            raise OptionError("record: no recording is running")
        running.tree.stop(_STOP_LIMIT)
        self._running = None
        return running.name

    def state(self) -> dict[str, Any]:
        """Return whether a recording runs, its profile, name, size (bytes) and duration (s of wall time)."""
        running = self._running
        if running is None or running.tree.status is not None:
            return {"recording": False}
        files = [*self._folder.glob(f"{running.name}*.bag*")]
        return {
            "recording": True,
            "profile": running.profile,
            "name": running.name,
            "bytes": sum(file.stat().st_size for file in files if file.exists()),
            "seconds": time.monotonic() - running.began,
        }
