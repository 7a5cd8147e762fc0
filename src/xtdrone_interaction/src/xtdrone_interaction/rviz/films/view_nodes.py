"""The nodes that draw a view on a running ROS master: robot_tf, swarm_markers and rviz_offscreen."""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Container, Mapping
from pathlib import Path
from typing import Any

import rosgraph
import roslib.packages

from xtdrone_common.fleet import parse_fleet
from xtdrone_interaction.launching.process_tree import ProcessTree
from xtdrone_interaction.launching.supervised_launch import DemoError, defer_signals
from xtdrone_interaction.rviz.films.film_options import FilmSettings
from xtdrone_interaction.rviz.view_configurations import SHIPPED, Array, make_view, marker_parameters
from xtdrone_sim.vehicles.vehicle_model import load_vehicle

DRAWER = "rviz_offscreen"
TF, MARKERS = "robot_tf", "swarm_markers"
NODES = tuple(f"/{name}" for name in (TF, MARKERS, DRAWER))
_CORE_PATTERN = Path("/proc/sys/kernel/core_pattern")
_PATIENCE = 30.0  # wall s for the film to be finished
_LAST_LINES = 6
_MOST_COMPLAINTS = 10
_DRAWN = re.compile(rf"^{DRAWER}: (\d+) frames drawn$", re.MULTILINE)  # its last line
# lines of rosconsole
_COMPLAINT = re.compile(r"\[(?: WARN|ERROR|FATAL)\] \[[\d., ]+\]: (.*?)(?:\x1b\[0m)?$", re.MULTILINE)


# Lets the drawing node leave a core in its folder, if the machine's limit and core_pattern allow it.
_KEEP_CORE = ("sh", "-c", 'ulimit -S -c "$(ulimit -H -c)"; cd "$0" && exec "$@"')
_CRASHES = (signal.SIGSEGV, signal.SIGABRT, signal.SIGBUS, signal.SIGILL, signal.SIGFPE)


class StageError(DemoError):
    """A node cannot be started or has ended early; the message contains its last output."""


class CrashError(StageError):
    """The drawing node has crashed; the message names its core."""


def program(package: str, name: str) -> str:
    """Return the path of a node's program.

    Raises:
        StageError: not found.
    """
    found = roslib.packages.find_node(package, name)
    if not found:
        raise StageError(f"{name}: not found in {package}; is the workspace built, with rviz?")
    return str(found[0])


def check_tools() -> None:
    """Check that the programs for drawing are installed.

    Raises:
        StageError: one is missing.
    """
    for tool, package in (("Xvfb", "xvfb"), ("ffmpeg", "ffmpeg")):
        if shutil.which(tool) is None:
            raise StageError(f"{tool}: not found; install it (Debian: apt-get install {package})")
    program("xtdrone_rviz", DRAWER)


class Stage:
    """Processes of the nodes; the context manager ends them, the drawing node first."""

    def __init__(self, environment: Mapping[str, str], work: Path) -> None:
        """Start no node yet.

        Args:
            environment: of the nodes, with the URI of the master.
            work: existing folder for their files.
        """
        self._environment = dict(environment)
        self._work = work
        self._master = rosgraph.Master("/record_view", master_uri=self._environment["ROS_MASTER_URI"])
        self._nodes: dict[str, ProcessTree] = {}
        self._film = Path()

    def start_all(
        self, settings: FilmSettings, fleet: str, running: Container[str] = (), flown: Array | None = None
    ) -> None:
        """Start the nodes that are not running yet.

        Args:
            settings: of the film.
            fleet: such as ``iris:9``.
            running: names of running nodes, such as ``/robot_tf``.
            flown: positions of the vehicles, see ``make_view``.

        Raises:
            StageError: a program is missing.
        """
        self._film = settings.out
        vehicles = parse_fleet(fleet)
        for vehicle in vehicles:
            # The simplified simulator and bags provide no robot descriptions.
            if not self._master.hasParam(f"/{vehicle.name}/robot_description"):
                self._master.setParam(f"/{vehicle.name}/robot_description", load_vehicle(vehicle.model).urdf.text)
        config = Path(settings.view)
        if settings.view in SHIPPED:
            config = self._work / f"{settings.view}.rviz"
            view = make_view(settings.view, [vehicle.name for vehicle in vehicles], flown)
            config.write_text(view, encoding="utf-8")
        if f"/{TF}" not in running:
            self.start("xtdrone_sim", TF, {"rate": settings.rate})
        if f"/{MARKERS}" not in running:
            parameters = {"rate": settings.rate, **marker_parameters(settings.view, flown)}
            self.start("xtdrone_interaction", MARKERS, parameters)
        self.start("xtdrone_rviz", DRAWER, {
            "config": config,
            "rate": settings.rate,
            "fps": settings.fps,
            "width": settings.size[0],
            "height": settings.size[1],
            "antialiasing": settings.antialiasing,
            "film": settings.out,
            "frames": settings.frames,
        })  # fmt: skip

    def start(self, package: str, name: str, parameters: Mapping[str, Any]) -> None:
        """Start the node ``name``, whose program has the same name, with .py for Python.

        Args:
            package: ROS package.
            name: of the node.
            parameters: private ones; None values are left out.

        Raises:
            StageError: its program is missing.
        """
        file = name if name == DRAWER else f"{name}.py"
        command = [program(package, file), f"__name:={name}"]
        if name == DRAWER:
            command = [*_KEEP_CORE, str(self._work), *command]
        # Set on the server, because some nodes read parameters before rospy parses the command line.
        if self._master.hasParam(f"/{name}"):  # of an earlier node
            self._master.deleteParam(f"/{name}")
        for key, value in parameters.items():
            if value is not None:
                self._master.setParam(f"/{name}/{key}", str(value.absolute()) if isinstance(value, Path) else value)
        self._nodes[name] = ProcessTree(command, self._environment, self.log(name))

    def log(self, name: str) -> Path:
        """Return the file of a node's output."""
        return self._work / f"{name}.log"

    def wait(self, name: str, timeout: float) -> bool:
        """Wait up to ``timeout`` s for the end of a node and return whether it has ended."""
        return self._nodes[name].wait(timeout)

    def check(self) -> None:
        """Check that all nodes run.

        Raises:
            StageError: a node has ended.
        """
        for name, tree in self._nodes.items():
            if tree.wait(0.0):
                self._raise_crash()
                raise StageError(f"{name} has ended (status {tree.status}): {self.last_words(name)}")

    def check_others(self) -> None:
        """Check that no node other than the drawing one has failed.

        Raises:
            StageError: one has ended with an error.
        """
        for name, tree in self._nodes.items():
            if name != DRAWER and tree.wait(0.0) and tree.process.returncode != 0:
                raise StageError(f"{name} has failed (status {tree.status}): {self.last_words(name)}")

    def last_words(self, name: str = DRAWER) -> str:
        """Return the last lines of a node's output."""
        lines = self.log(name).read_text(encoding="utf-8", errors="replace").strip().splitlines()
        return "\n".join(lines[-_LAST_LINES:]) or "it said nothing"

    def complaints(self) -> list[str]:
        """Return the distinct warnings of the drawing node."""
        text = self.log(DRAWER).read_text(encoding="utf-8", errors="replace")
        return list(dict.fromkeys(_COMPLAINT.findall(text)))

    def finish(self) -> int:
        """Stop the drawing node, which finishes the film, and return the number of frames.

        Its warnings go to standard error.

        Raises:
            StageError: the node has failed, or the film has no frame.
        """
        tree = self._nodes[DRAWER]
        if tree.process.poll() is None:
            tree.process.send_signal(signal.SIGINT)
        if not tree.wait(_PATIENCE):
            raise StageError(f"{DRAWER} has not ended within {_PATIENCE:g} s")
        self._raise_crash()
        if tree.process.returncode != 0:
            raise StageError(f"{DRAWER} has failed (status {tree.status}): {self.last_words()}{self._rest()}")
        for words in self.complaints()[:_MOST_COMPLAINTS]:
            print(f"rviz: {words}", file=sys.stderr)
        drawn = _DRAWN.search(self.log(DRAWER).read_text(encoding="utf-8", errors="replace"))
        frames = int(drawn[1]) if drawn else 0
        if frames == 0:
            raise StageError(f"no frame was drawn: {self.last_words()}")
        return frames

    def _raise_crash(self) -> None:
        """Raise an error if the drawing node has crashed, and keep its core beside the film.

        Raises:
            CrashError: it has.
        """
        status = self._nodes[DRAWER].status if DRAWER in self._nodes else None
        if status is None or -status not in _CRASHES:
            return
        words = f"no core in its folder (core_pattern {_CORE_PATTERN.read_text().strip()!r}, or a limit of 0)"
        for core in self._work.glob("core*"):
            kept = self._film.with_name(f"{self._film.stem}.core")
            shutil.move(core, kept)
            words = f"core: {kept}"
        how = f"{DRAWER} has crashed ({signal.Signals(-status).name}); {words}"
        raise CrashError(f"{how}: {self.last_words()}{self._rest()}")

    def _rest(self) -> str:
        """Return a message with the file of an unfinished film, if any."""
        part = self._film.with_name(f".{self._film.name}.{self._nodes[DRAWER].pid}.part.mp4")
        return f"\npartial film: {part}" if part.exists() else ""

    def close(self) -> None:
        """End all nodes."""
        for name in sorted(self._nodes, key=lambda name: name != DRAWER):
            process = self._nodes[name].process
            if process.poll() is None:
                process.send_signal(signal.SIGINT)
                with contextlib.suppress(subprocess.TimeoutExpired):
                    process.wait(_PATIENCE)
        for tree in self._nodes.values():
            tree.kill()

    def __enter__(self) -> Stage:
        return self

    def __exit__(self, *_: object) -> None:
        with defer_signals():
            self.close()


def node_environment(master: str) -> dict[str, str]:
    """Return the environment of nodes at a master on this machine."""
    environment = {**os.environ, "ROS_MASTER_URI": master}
    if not {"ROS_IP", "ROS_HOSTNAME"} & environment.keys():
        environment["ROS_IP"] = "127.0.0.1"
    return environment
