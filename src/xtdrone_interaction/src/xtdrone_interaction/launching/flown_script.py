"""A script that flies vehicles of a supervised launch: its process, its output, and its end."""

from __future__ import annotations

import os
import queue
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from typing import IO

from xtdrone_interaction.launching.supervised_launch import DemoError, Launch, Watch, check_progress, escape

_LIMIT = 60.0  # s of wall time without progress
_LOG_LINE = "[INFO] "  # of ROS; the script's own output and warnings are shown
_END_LIMIT = 10.0  # s for the script to end after a signal


def fly_script(command: Sequence[Path | str], launch: Launch, watch: Watch) -> int:
    """Run a script beside the launch, show its output, and return its exit status.

    Args:
        command: the script's file and its arguments.
        launch: of the simulation.
        watch: of the launch.

    Raises:
        DemoError: the launch has ended, or nothing has advanced for a long time.
    """
    _wait_for_master(watch)
    script = Script(command, launch)
    begun = False
    try:
        while True:
            status = script.status
            for line in script.take():
                if not line.startswith(_LOG_LINE):
                    watch.display.note(f"  {escape(line)}")
            if status is not None:
                return status
            if not watch.running():
                watch.show_ended_nodes()
                raise DemoError("the simulation has ended before the script")
            watch.poll(starting=not begun)
            if not begun and watch.startup.runs:
                begun = True
                watch.display.note(f"flying; {launch.control_words}")
            if not begun:
                check_progress(watch, _LIMIT, "the flight did not begin: no progress")
    finally:
        script.end()


def _wait_for_master(watch: Watch) -> None:
    """Wait until the ROS master answers: the script looks for the simulator there.

    Raises:
        DemoError: it does not.
    """
    while not any(message["kind"] == "master" for message in watch.poll(starting=True)):
        if not watch.running():
            raise DemoError("roslaunch ended before it started a node")
        check_progress(watch, _LIMIT, "the flight did not begin: no progress")


class Script:
    """The script's process and its output."""

    def __init__(self, command: Sequence[Path | str], launch: Launch) -> None:
        """Start it as a node of the launch's ROS master."""
        environment = {**launch.environment(), "PYTHONUNBUFFERED": "1"}
        self._process = subprocess.Popen(
            [sys.executable, *map(str, command)],
            env=environment,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            errors="replace",
            cwd=os.getcwd(),
        )
        self._lines: queue.SimpleQueue[str] = queue.SimpleQueue()
        assert self._process.stdout is not None
        self._reader = threading.Thread(target=self._read, args=(self._process.stdout,), daemon=True)
        self._reader.start()

    @property
    def status(self) -> int | None:
        """The exit status once all output has been read; None before that."""
        return None if self._reader.is_alive() else self._process.wait()

    def take(self) -> list[str]:
        """Return the new lines of its output."""
        lines = []
        while not self._lines.empty():
            lines.append(self._lines.get())
        return lines

    def end(self) -> None:
        """Interrupt it if it runs, and wait for its end."""
        end = time.monotonic() + _END_LIMIT
        for stop in (self._process.terminate, self._process.kill):
            if self._process.poll() is None:
                stop()
                try:
                    self._process.wait(max(0.1, end - time.monotonic()))
                except subprocess.TimeoutExpired:
                    continue

    def _read(self, output: IO[str]) -> None:
        for line in output:
            self._lines.put(line.rstrip("\n"))
