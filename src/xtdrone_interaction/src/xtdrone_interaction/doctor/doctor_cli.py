"""``./xtdrone doctor``: reasons why a vehicle does not arm, fly OFFBOARD or send data, and remedies.

It reads a running simulation, or a real MAVROS, and changes nothing: a flight is the same to the last bit with it.

Exit status: 0 if all is well, 1 if anything is found, 130 after Ctrl-C.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Iterable
from pathlib import Path

from rich.text import Text

from xtdrone_interaction import command_options
from xtdrone_interaction.console import PatientConsole
from xtdrone_interaction.doctor.findings import (
    Finding,
    examine_graph,
    examine_simulator,
    examine_vehicle,
)
from xtdrone_interaction.doctor.graph import Master, read_master
from xtdrone_interaction.doctor.machine_check import (
    Holder,
    examine_packages,
    examine_ports,
    examine_stock_ports,
    instance_words,
    port_holders,
)
from xtdrone_interaction.doctor.readings import read_simulator, read_vehicles
from xtdrone_interaction.doctor.screen import BAD, OK, Line, finding_lines, simulator_lines, vehicle_lines, wrapped
from xtdrone_interaction.simulation_services import DEFAULT_MASTER, RUNS, SimError, choose_master, master_uri

_WIDTH = 110  # characters of a line without a terminal
_LEAST_WIDTH = 60
_LONGEST_FLEET = 60  # characters
_STYLES = {OK: "green", BAD: "yellow"}
_START = "./xtdrone launch multi_vehicle vehicles:=iris:1, or ./xtdrone demo hello"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    parser.description = (
        "Report why vehicles of the running simulation do not arm, fly OFFBOARD or send data, and what to do about "
        "it. Also works with a real MAVROS, and changes nothing. Exit status 0 if all is well, else 1."
    )
    parser.add_argument(
        "--master",
        type=master_uri,
        metavar="PORT|URI",
        help="the ROS master (default: ROS_MASTER_URI; without a simulator there, the newest flight)",
    )


def run(arguments: argparse.Namespace) -> int:
    """Print the report and return the exit status."""
    try:
        lines, healthy = _report(arguments.master or "")
    except KeyboardInterrupt:
        return 130
    console = PatientConsole(highlight=False)
    width = max(console.width, _LEAST_WIDTH) if console.is_terminal else _WIDTH
    for line in lines:
        console.print(Text(wrapped(line, width), style=_STYLES.get(line.kind, "")), soft_wrap=True)
    return 0 if healthy else 1


def _report(given: str) -> tuple[list[Line], bool]:
    """Return the lines, and whether all is well."""
    holders = port_holders()
    machine = [*examine_ports(holders), *examine_stock_ports(), *examine_packages(command_options.repository())]
    lines = [Line(f"machine   instances: {instance_words(holders)}"), *finding_lines(machine)]
    try:
        running, healthy = _running(given)
    except SimError as error:
        missing = Finding("running", str(error).partition("; start one")[0], _start_words(holders))
        running, healthy = finding_lines([missing]), False
    healthy = healthy and not machine
    verdict = Line("all is well", OK) if healthy else Line("not all is well: see the arrows", BAD)
    return [*running, *lines, verdict], healthy


def _running(given: str) -> tuple[list[Line], bool]:
    """Return the lines about the running simulation or MAVROS.

    Raises:
        SimError: none is running.
    """
    master = _master(given)
    simulator = read_simulator(master)
    findings = [] if simulator is None else examine_simulator(simulator, master.graph)
    findings += examine_graph(master.graph)
    vehicles = read_vehicles(master, simulator)
    if not vehicles:
        findings.append(Finding("vehicles", "no vehicle and no MAVROS is on this ROS master", _START))
    examined = [(vehicle, examine_vehicle(vehicle, master.graph, simulator)) for vehicle in vehicles]
    fleet, world = str(master.parameter("/xtdrone/fleet")), Path(str(master.parameter("/xtdrone/world"))).stem
    if len(fleet) > _LONGEST_FLEET:  # a list with poses
        fleet = f"{len(vehicles)} vehicles"
    lines = simulator_lines(master.uri, fleet, world, simulator) + finding_lines(findings) + vehicle_lines(examined)
    return lines, not findings and not any(found for _, found in examined)


def _master(given: str) -> Master:
    """Return the master of the running simulation, or that of a real MAVROS.

    Raises:
        SimError: there is neither.
    """
    environment = os.environ.get("ROS_MASTER_URI", "")
    try:
        return read_master(choose_master(given, environment, [Path("runs"), RUNS])[0])
    except SimError:
        master = _quietly(environment or DEFAULT_MASTER) if not given else None
        if master is None or not any(topic.endswith("mavros/state") for topic in master.graph.publishers):
            raise
        return master


def _quietly(uri: str) -> Master | None:
    """Return a master; None if none answers."""
    try:
        return read_master(uri)
    except SimError:
        return None


def _start_words(holders: dict[int, dict[int, Holder]]) -> str:
    masters = list(_masters(holder for ports in holders.values() for holder in ports.values()))
    if masters:
        return f"a simulation runs on another ROS master: ./xtdrone doctor --master {masters[0]}"
    return _START


def _masters(holders: Iterable[Holder]) -> Iterable[str]:
    return dict.fromkeys(holder.master for holder in holders if holder.ours and holder.master)
