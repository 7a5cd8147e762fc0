"""Inspect a launch file before it runs: its arguments, its nodes, and missing programs."""

from __future__ import annotations

import difflib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from xtdrone_common.fleet import (
    SPAWNED,
    XTDRONE,
    Vehicle,
    check_instance,
    check_ports,
    fleet_text,
    parse_fleet,
    spawned_fleet,
)
from xtdrone_interaction.command_options import OptionError, repository
from xtdrone_interaction.monitoring.ended_nodes import SIMULATOR

_MAVLINK = "simulator.py"  # the simulator program with MAVLink
_MAVROS = "mavros_node.py"
_BUILTIN = "builtin"


@dataclass(frozen=True)
class LaunchFile:
    """A launch file evaluated with its arguments.

    Attributes:
        path: of the file.
        nodes: names of its nodes, with the leading slash.
        parameters: name to value.
        has_simulator: whether one of the nodes is a simulator of this project.
        has_mavlink: whether the simulator runs autopilots with UDP ports.
        has_mavros: whether our MAVROS layer binds its ends of the vehicles' offboard links on this machine.
    """

    path: Path
    nodes: tuple[str, ...]
    parameters: Mapping[str, Any]
    has_simulator: bool
    has_mavlink: bool
    has_mavros: bool

    @property
    def fleet(self) -> str:
        """The vehicles, as ``iris:3``; empty if none are given.

        Raises:
            FleetError: the vehicles that the file spawns are not allowed.
        """
        if self.of_simulator("spawned"):
            return fleet_text(spawned_fleet(_groups(self.parameters), self._instance))
        return str(self.parameters.get("/xtdrone/fleet", ""))

    @property
    def _instance(self) -> int:
        return check_instance(self.parameters.get("/xtdrone/instance", 0))

    @property
    def ports(self) -> str:
        """The ports of the vehicles' offboard links, see ``parse_fleet``.

        Raises:
            FleetError: they are not allowed.
        """
        return check_ports(self.parameters.get("/xtdrone/ports", XTDRONE))

    @property
    def vehicles(self) -> tuple[Vehicle, ...]:
        """The vehicles of the simulator.

        Raises:
            FleetError: the fleet is invalid.
        """
        if not (self.has_simulator and self.fleet):
            return ()
        return parse_fleet(self.fleet, self._instance, self.ports)

    def of_simulator(self, name: str) -> Any:
        """Return a private parameter of the simulator, None if it is not set."""
        return self.parameters.get(f"/{SIMULATOR}/{name}")


def _groups(parameters: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Return the groups of parameters below ``SPAWNED``, by their keys."""
    groups: dict[str, dict[str, Any]] = {}
    for name, value in parameters.items():
        key, _, argument = name.removeprefix(f"{SPAWNED}/").partition("/")
        if name.startswith(f"{SPAWNED}/"):
            groups.setdefault(key, {})[argument] = value
    return groups


def find(text: str) -> Path:
    """Return the launch file with the given path, or name in launch/ with or without extension.

    Raises:
        OptionError: the file does not exist.
    """
    folder = repository() / "launch"
    for path in (Path(text), folder / text, folder / f"{text}.launch"):
        if path.is_file():
            return path.resolve()
    known = ", ".join(sorted(path.stem for path in folder.glob("*.launch")))
    raise OptionError(f"launch file: {text!r} does not exist; a path, or one of {known}")


def split_arguments(words: Sequence[str]) -> dict[str, str]:
    """Return the launch arguments of a command line, ``name:=value`` each.

    Raises:
        OptionError: a word has another form, or a name is given twice.
    """
    arguments: dict[str, str] = {}
    for word in words:
        name, sign, value = word.partition(":=")
        if not (sign and name):
            raise OptionError(f"launch argument: {word!r} is not allowed, name:=value")
        if name in arguments:
            raise OptionError(f"launch argument: {name} is given twice, as {arguments[name]!r} and {value!r}")
        arguments[name] = value
    return arguments


def check_arguments(path: Path, given: Mapping[str, str]) -> None:
    """Check that a launch file declares the given arguments; roslaunch ignores unknown ones.

    Raises:
        OptionError: an argument is not declared; the message lists the declared ones.
    """
    declared = _declared(path)
    for name in given:
        if name not in declared:
            near = difflib.get_close_matches(name, declared, 1)
            meant = f" (did you mean {near[0]}?)" if near else ""
            names = ", ".join(sorted(declared)) or "none"
            raise OptionError(f"launch argument: {path.name} has no {name!r}{meant}; there are: {names}")


def _declared(path: Path) -> list[str]:
    import roslaunch.arg_dump
    from roslaunch.core import RLException

    try:
        return list(roslaunch.arg_dump.get_args([str(path)]))
    except RLException as error:
        raise OptionError(f"launch file: {_one_line(error)}") from error


def load(path: Path, given: Mapping[str, str]) -> LaunchFile:
    """Evaluate a launch file.

    Raises:
        OptionError: the file cannot be read, an argument is missing or invalid, or a node's program does not exist.
    """
    from roslaunch.config import load_config_default
    from roslaunch.core import RLException

    words = [f"{name}:={value}" for name, value in given.items()]
    try:
        config = load_config_default([(str(path), words)], None, verbose=False, assign_machines=False)
    except RLException as error:
        raise OptionError(f"launch file: {_one_line(error)}") from error
    if config.config_errors:
        raise OptionError(f"launch file: {_one_line(config.config_errors[0])}")
    _check_programs(config.nodes)
    parameters = {parameter.key: parameter.value for parameter in config.params.values()}
    simulators = [node for node in config.nodes if node.name == SIMULATOR]
    ours = parameters.get(f"/{SIMULATOR}/autopilot", _BUILTIN) == _BUILTIN
    return LaunchFile(
        path,
        tuple(f"{node.namespace}{node.name}" for node in config.nodes),
        parameters,
        bool(simulators),
        any(node.type == _MAVLINK for node in simulators) and ours,
        any(_binds_offboard_ports(node, parameters) for node in config.nodes),
    )


def _binds_offboard_ports(node: Any, parameters: Mapping[str, Any]) -> bool:
    """Return whether a node is our MAVROS layer, here and without a link of its own."""
    own_link = any(parameters.get(f"{node.namespace}{node.name}/{name}") for name in ("fleet_url", "fcu_url"))
    return node.type == _MAVROS and not node.machine_name and not own_link


def _check_programs(nodes: Sequence[Any]) -> None:
    """Check that each node's program exists; roslaunch would start the other nodes and continue.

    Raises:
        OptionError: a program does not exist.
    """
    import rospkg
    from roslib.packages import find_node

    packages = rospkg.RosPack()
    checked = set()
    for node in nodes:
        if (node.package, node.type) in checked or node.machine_name:
            continue
        checked.add((node.package, node.type))
        try:
            there = bool(find_node(node.package, node.type, packages))
        except rospkg.ResourceNotFound as error:
            missing = error.args[0] if error.args else node.package
            raise OptionError(
                f"node {node.name}: there is no package {missing!r}; in a workspace of your own, build it and source "
                "its devel/setup.bash"
            ) from error
        if not there:
            raise OptionError(
                f"node {node.name}: package {node.package!r} has no program {node.type!r}; a program must be built "
                "(./xtdrone setup) and executable"
            )


def _one_line(error: object) -> str:
    return " ".join(str(error).split())
