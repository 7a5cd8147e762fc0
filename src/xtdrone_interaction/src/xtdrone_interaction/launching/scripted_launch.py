"""Runs roslaunch from a program: with its own master, logs in a folder, and signals deferred until the clean-up."""

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

from xtdrone_interaction import command_options
from xtdrone_interaction.launching.process_tree import end_descendants, roslaunch_words

PATIENCE = 25.0  # s for roslaunch to stop its nodes
NODE_PATIENCE = 8.0  # s for a node to stop
_COLOURS = re.compile(r"\x1b\[[0-9;]*m")
_CAUSE = re.compile(r"\b(ERROR|FATAL)\b|(Error|Exception)\b|has died|cannot launch|Invalid <")


class LaunchError(RuntimeError):
    """A launch that failed; the message names the launch and its log."""


class Stopped(BaseException):
    """SIGINT, SIGTERM or SIGHUP was received.

    Attributes:
        number: the signal.
    """

    def __init__(self, number: int) -> None:
        """Store the number of the signal."""
        super().__init__(signal.Signals(number).name)
        self.number = number


class StopRequest:
    """Receives SIGINT, SIGTERM and SIGHUP and stores the first, so that no signal interrupts a clean-up.

    A context manager: at its end, all processes started inside have ended.

    Attributes:
        number: of the first signal, 0 before that.
    """

    def __init__(self, *, end_processes: bool = True) -> None:
        """Prepare without a signal.

        Args:
            end_processes: whether to end the processes started inside; otherwise the caller ends them.
        """
        self.number = 0
        self._end_processes = end_processes
        self._previous: dict[int, Any] = {}

    def check(self) -> None:
        """Raise :class:`Stopped` after a signal."""
        if self.number:
            raise Stopped(self.number)

    def __enter__(self) -> StopRequest:
        """Install the signal handlers."""
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            self._previous[number] = signal.signal(number, self._note)
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        """End the remaining processes and restore the signal handlers."""
        if self._end_processes:
            end_descendants()
        for number, handler in self._previous.items():
            signal.signal(number, handler)

    def _note(self, number: int, _: FrameType | None) -> None:
        self.number = self.number or number


def launch_command(launch_file: str, arguments: Mapping[str, object], port: int) -> list[str]:
    """Return the command that runs a file of launch/ with a master of its own on TCP ``port``.

    Raises:
        LaunchError: roslaunch is not installed.
    """
    return [
        *roslaunch_words(roslaunch_program()), "--sigint-timeout", str(NODE_PATIENCE), "-p", str(port),
        str(command_options.repository() / "launch" / launch_file),
        *(f"{name}:={value}" for name, value in arguments.items()),
    ]  # fmt: skip


def roslaunch_program() -> str:
    """Return the path of roslaunch.

    Raises:
        LaunchError: it is not installed.
    """
    program = shutil.which("roslaunch")
    if program is None:
        raise LaunchError("roslaunch: not found; source the workspace's devel/setup.bash first")
    return program


def launch_environment(port: int, logs: Path) -> dict[str, str]:
    """Return the environment of a launch with its own master on this machine's ``port``, logs in ``logs``."""
    environment = {k: v for k, v in os.environ.items() if k != "ROS_HOSTNAME"}
    # in an unbuilt workspace nodes start through /usr/bin/env python3, which must be this Python
    path = f"{Path(sys.executable).parent}{os.pathsep}{environment.get('PATH', '')}"
    local = {"ROS_MASTER_URI": f"http://127.0.0.1:{port}", "ROS_IP": "127.0.0.1", "ROS_LOG_DIR": str(logs)}
    return {**environment, **local, "PATH": path}


def log_text(log: Path) -> str:
    """Return the text of a log file without colour codes; empty if it does not exist."""
    return _COLOURS.sub("", log.read_text(encoding="utf-8", errors="replace")) if log.is_file() else ""


def cause(log: Path) -> str:
    """Return the first line of a log that reports an error, and the path of the log."""
    lines = [line.strip() for line in log_text(log).splitlines() if _CAUSE.search(line)]
    return f"{lines[0]}; log: {log}" if lines else f"log: {log}"
