"""roslaunch as a program runs it: its own master, its logs in a folder, signals that wait for the clean-up."""

from __future__ import annotations

import os
import re
import shutil
import signal
import sys
from collections.abc import Mapping
from pathlib import Path
from types import FrameType, TracebackType
from typing import Any

from xtdrone_interaction import options
from xtdrone_interaction.processes import end_descendants

PATIENCE = 25.0  # s that roslaunch gets to stop its nodes
NODE_PATIENCE = 8.0  # s that a node gets to stop
_COLOURS = re.compile(r"\x1b\[[0-9;]*m")
_CAUSE = re.compile(r"\b(ERROR|FATAL)\b|(Error|Exception)\b|has died|cannot launch|Invalid <")


class LaunchError(RuntimeError):
    """A launch that failed; the message says which and where its log is."""


class Stopped(BaseException):
    """SIGINT, SIGTERM or SIGHUP came.

    Attributes:
        number: the signal.
    """

    def __init__(self, number: int) -> None:
        """Keep the signal's number."""
        super().__init__(signal.Signals(number).name)
        self.number = number


class StopRequest:
    """Takes SIGINT, SIGTERM and SIGHUP and remembers the first, so that none cuts a clean-up short.

    A context manager: when it ends, no process that was started inside is left.

    Attributes:
        number: of that signal, 0 while none has come.
    """

    def __init__(self, *, end_processes: bool = True) -> None:
        """Nothing has come yet.

        Args:
            end_processes: whether to end, when this ends, what was started inside; else its starter does.
        """
        self.number = 0
        self._end_processes = end_processes
        self._previous: dict[int, Any] = {}

    def check(self) -> None:
        """Raise :class:`Stopped` if a signal has come."""
        if self.number:
            raise Stopped(self.number)

    def __enter__(self) -> StopRequest:
        """Take the signals."""
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            self._previous[number] = signal.signal(number, self._note)
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        """End what is left and give the signals back."""
        if self._end_processes:
            end_descendants()
        for number, handler in self._previous.items():
            signal.signal(number, handler)

    def _note(self, number: int, _: FrameType | None) -> None:
        self.number = self.number or number


def launch_command(launch_file: str, arguments: Mapping[str, object], port: int) -> list[str]:
    """Return the command that runs a file of launch/ with a master of its own on TCP ``port``.

    Raises:
        LaunchError: there is no roslaunch.
    """
    return [
        roslaunch_program(), "--sigint-timeout", str(NODE_PATIENCE), "-p", str(port),
        str(options.repository() / "launch" / launch_file),
        *(f"{name}:={value}" for name, value in arguments.items()),
    ]  # fmt: skip


def roslaunch_program() -> str:
    """Return the path of roslaunch.

    Raises:
        LaunchError: there is none.
    """
    program = shutil.which("roslaunch")
    if program is None:
        raise LaunchError("roslaunch: not found; source the workspace's devel/setup.bash first")
    return program


def launch_environment(port: int, logs: Path) -> dict[str, str]:
    """Return the environment of a launch with its own master on this machine's ``port``, logs in ``logs``."""
    environment = {k: v for k, v in os.environ.items() if k != "ROS_HOSTNAME"}
    # nodes start by /usr/bin/env python3 where the workspace was not built: it must be this Python
    path = f"{Path(sys.executable).parent}{os.pathsep}{environment.get('PATH', '')}"
    local = {"ROS_MASTER_URI": f"http://127.0.0.1:{port}", "ROS_IP": "127.0.0.1", "ROS_LOG_DIR": str(logs)}
    return {**environment, **local, "PATH": path}


def log_text(log: Path) -> str:
    """Return what a log file has, without colours; empty if there is none."""
    return _COLOURS.sub("", log.read_text(encoding="utf-8", errors="replace")) if log.is_file() else ""


def cause(log: Path) -> str:
    """Return the first line of a log that tells of trouble, and where the log is."""
    lines = [line.strip() for line in log_text(log).splitlines() if _CAUSE.search(line)]
    return f"{lines[0]}; log: {log}" if lines else f"log: {log}"
