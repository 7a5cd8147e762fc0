"""The nodes that draw a view: robot_tf, swarm_markers and rviz_offscreen, on a ROS master that is there."""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import subprocess
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import rosgraph
import roslib.packages

from xtdrone_interaction.launched import DemoError
from xtdrone_interaction.processes import ProcessTree

DRAWER = "rviz_offscreen"
_PATIENCE = 30.0  # wall s for the film to be finished
_LAST_LINES = 6


class StageError(DemoError):
    """A node that cannot be started, or has ended too early; the message has its last words."""


def program(package: str, name: str) -> str:
    """Return the path of a node's program.

    Raises:
        StageError: it is not there.
    """
    found = roslib.packages.find_node(package, name)
    if not found:
        raise StageError(f"{name}: not found in {package}; is the workspace built, with rviz?")
    return str(found[0])


def check_tools() -> None:
    """Check that what the drawing needs is installed.

    Raises:
        StageError: it is not.
    """
    for tool, package in (("Xvfb", "xvfb"), ("ffmpeg", "ffmpeg")):
        if shutil.which(tool) is None:
            raise StageError(f"{tool}: not found; install it (Debian: apt-get install {package})")
    program("xtdrone_rviz", DRAWER)


class Stage:
    """Nodes as processes; as a context manager it ends them all, the one that draws first."""

    def __init__(self, environment: Mapping[str, str], logs: Path) -> None:
        """Start nothing yet.

        Args:
            environment: of the nodes; it names the master.
            logs: folder, which is there, for what they write.
        """
        self._environment = dict(environment)
        self._logs = logs
        self._nodes: dict[str, ProcessTree] = {}

    def start(self, package: str, name: str, parameters: Mapping[str, Any]) -> None:
        """Start a node of the name ``name``; its program has that name too, with .py where it is Python's.

        Args:
            package: ROS package.
            name: of the node.
            parameters: private ones; those with None are left out.

        Raises:
            StageError: its program is not there.
        """
        file = name if name == DRAWER else f"{name}.py"
        command = [program(package, file), f"__name:={name}"]
        # Not on the command line: some nodes look before rospy has read that.
        master = rosgraph.Master("/record_view", master_uri=self._environment["ROS_MASTER_URI"])
        for key, value in parameters.items():
            if value is not None:
                master.setParam(f"/{name}/{key}", str(value) if isinstance(value, Path) else value)
        self._nodes[name] = ProcessTree(command, self._environment, self.log(name))

    def log(self, name: str) -> Path:
        """Return the file of what a node writes."""
        return self._logs / f"{name}.log"

    def ended(self, name: str) -> bool:
        """Whether a node has ended."""
        return self._nodes[name].wait(0.0)

    def wait(self, name: str, timeout: float) -> bool:
        """Wait up to ``timeout`` s for a node's end; return whether it has ended."""
        return self._nodes[name].wait(timeout)

    def check(self) -> None:
        """Check that all nodes run.

        Raises:
            StageError: one has ended.
        """
        for name, tree in self._nodes.items():
            if tree.wait(0.0):
                raise StageError(f"{name} has ended (status {tree.process.returncode}): {self.last_words(name)}")

    def last_words(self, name: str) -> str:
        """Return the end of what a node wrote."""
        lines = self.log(name).read_text(encoding="utf-8", errors="replace").strip().splitlines()
        return "\n".join(lines[-_LAST_LINES:]) or "it said nothing"

    def finish(self) -> None:
        """Have the drawing node end in an orderly way, so that the film is finished.

        Raises:
            StageError: it failed.
        """
        tree = self._nodes[DRAWER]
        if tree.process.poll() is None:
            tree.process.send_signal(signal.SIGINT)
        if not tree.wait(_PATIENCE):
            raise StageError(f"{DRAWER} has not ended within {_PATIENCE:g} s")
        if tree.process.returncode != 0:
            raise StageError(f"{DRAWER} has failed (status {tree.process.returncode}): {self.last_words(DRAWER)}")

    def close(self) -> None:
        """End all nodes."""
        order: Sequence[str] = sorted(self._nodes, key=lambda name: name != DRAWER)
        for name in order:
            process = self._nodes[name].process
            if process.poll() is None:
                process.send_signal(signal.SIGINT)
                with contextlib.suppress(subprocess.TimeoutExpired):
                    process.wait(_PATIENCE)
        for tree in self._nodes.values():
            if tree.process.poll() is None:
                tree.process.kill()
                tree.process.wait()

    def __enter__(self) -> Stage:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def node_environment(master: str) -> dict[str, str]:
    """Return the environment of nodes at a master on this machine."""
    environment = {**os.environ, "ROS_MASTER_URI": master}
    if not {"ROS_IP", "ROS_HOSTNAME"} & environment.keys():
        environment["ROS_IP"] = "127.0.0.1"
    return environment
