"""Ports, packages and the build of this machine."""

from __future__ import annotations

import contextlib
import os
import re
import subprocess
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path

from xtdrone_common.fleet import GCS_REMOTE_PORT, MAX_INSTANCE, OFFBOARD_PORTS, PX4, Vehicle, parse_fleet
from xtdrone_interaction.doctor.findings import Finding, listed

_OURS = ("simulator.py", "mavros_node.py", "simplified_simulator")
_REQUIREMENT = re.compile(r"^\s*(?P<name>[A-Za-z0-9_.-]+)\s*==\s*(?P<version>[^\s;#]+)")
_PACKAGES_LIMIT = 20.0  # s
_STOCK = OFFBOARD_PORTS[PX4]


@dataclass(frozen=True)
class Holder:
    """A process that holds a port.

    Attributes:
        pid: 0 if the process is another user's.
        command: its program, such as ``simulator.py``.
        master: URI of its ROS master; empty if unknown.
    """

    pid: int
    command: str
    master: str = ""

    @property
    def ours(self) -> bool:
        """Whether it is a simulator or MAVROS layer of this project."""
        return any(name in self.command for name in _OURS)

    def __str__(self) -> str:
        """Return the program and its process."""
        if not self.pid:
            return "a program of another user"
        return f"{self.command} (pid {self.pid}{f', ROS master {self.master}' if self.master else ''})"


# ---- ports


def port_holders(fleet: str = "iris:9") -> dict[int, dict[int, Holder]]:
    """Return the holders of UDP ports of a fleet, by instance and port."""
    taken = _udp_sockets()
    wanted = {i: _ports(parse_fleet(fleet, i)) & taken.keys() for i in range(MAX_INSTANCE + 1)}
    owners = _owners({taken[port] for ports in wanted.values() for port in ports})
    stranger = Holder(0, "")
    return {i: {port: owners.get(taken[port], stranger) for port in sorted(ports)} for i, ports in wanted.items()}


def examine_ports(holders: Mapping[int, Mapping[int, Holder]]) -> list[Finding]:
    """Return the ports of instances that programs other than a simulation hold."""
    findings = []
    for instance, ports in holders.items():
        foreign = {port: holder for port, holder in ports.items() if not holder.ours and holder.pid}
        if not foreign:
            continue
        free = [i for i, held in holders.items() if not held]
        way = f"or use another instance: instance:={free[0]} (demos choose by themselves)" if free else ""
        names = dict.fromkeys(str(holder) for holder in foreign.values())
        findings.append(
            Finding(
                "ports",
                f"UDP {listed(map(str, foreign))} of instance {instance} {'is' if len(foreign) == 1 else 'are'} taken "
                f"by {listed(names)}",
                f"end that program, {way}".rstrip(", "),
            )
        )
    return findings


def examine_stock_ports() -> list[Finding]:
    """Return the programs that listen where a PX4 with its stock ports would send, while no such PX4 runs."""
    taken = _udp_sockets()
    waiting = [i for i in range(_STOCK.vehicles) if _STOCK.remote + i in taken and _STOCK.local + i not in taken]
    owners = _owners({taken[_STOCK.remote + i] for i in waiting})
    return [_stock_finding(i, owners.get(taken[_STOCK.remote + i], Holder(0, ""))) for i in waiting]


def _stock_finding(number: int, holder: Holder) -> Finding:
    vehicle = Vehicle("iris", number, number)
    return Finding(
        "ports",
        f"{holder} listens on UDP {_STOCK.remote + number}, PX4's stock port; no PX4 is at {_STOCK.local + number}: "
        "simulations here have upstream XTDrone's ports",
        f"start the simulation with ports:=px4 mavros:=false, or connect to vehicle {number} at "
        f"udpout://127.0.0.1:{vehicle.gcs_local_port}; listen on {GCS_REMOTE_PORT} as a ground station, or with "
        f"mavros:=false on {vehicle.offboard_remote_port} in the place of MAVROS",
    )


def instance_words(holders: Mapping[int, Mapping[int, Holder]]) -> str:
    """Return which instances are taken and which are free, as ``0 is taken, 1 2 3 are free``."""
    parts = []
    for words, chosen in (("taken", True), ("free", False)):
        numbers = [str(instance) for instance, ports in holders.items() if bool(ports) is chosen]
        if numbers:
            parts.append(f"{' '.join(numbers)} {'is' if len(numbers) == 1 else 'are'} {words}")
    return ", ".join(parts)


def _ports(fleet: Iterable[Vehicle]) -> set[int]:
    return {
        port
        for v in fleet
        for port in (v.offboard_local_port, v.gcs_local_port, v.payload_local_port, v.offboard_remote_port)
    }


def _udp_sockets() -> dict[int, str]:
    """Return the inode of the socket bound to each UDP port of this machine."""
    found = {}
    for file in ("/proc/net/udp", "/proc/net/udp6"):
        try:
            lines = Path(file).read_text(encoding="ascii").splitlines()[1:]
        except OSError:
            continue
        for line in lines:
            words = line.split()
            found[int(words[1].rpartition(":")[2], 16)] = words[9]
    return found


def _owners(inodes: set[str]) -> dict[str, Holder]:
    """Return the processes, of this user or all for root, that have these sockets."""
    names = {f"socket:[{inode}]": inode for inode in inodes}
    found: dict[str, Holder] = {}
    for process in Path("/proc").glob("[0-9]*") if names else ():
        for link in _descriptors(process) & names.keys():
            found.setdefault(names[link], _holder(process))
    return found


def _descriptors(process: Path) -> set[str]:
    """Return the targets of a process's open descriptors; empty for another user's process."""
    links = set()
    with contextlib.suppress(OSError):
        for entry in os.listdir(process / "fd"):
            with contextlib.suppress(OSError):  # it has been closed since
                links.add(os.readlink(process / "fd" / entry))
    return links


def _holder(process: Path) -> Holder:
    try:
        words = [word for word in (process / "cmdline").read_bytes().decode(errors="replace").split("\0") if word]
        variables = (process / "environ").read_bytes().split(b"\0")
    except OSError:
        return Holder(int(process.name), "an ended program")
    scripts = [Path(word).name for word in words if not word.startswith("-")]
    python = len(scripts) > 1 and scripts[0].startswith("python")
    command = scripts[1] if python else (scripts or ["?"])[0]
    uri = next((v.decode(errors="replace") for v in variables if v.startswith(b"ROS_MASTER_URI=")), "")
    return Holder(int(process.name), command, uri.partition("=")[2])


# ---- packages


def examine_packages(repository: Path) -> list[Finding]:
    """Return the packages that are missing, and whether the workspace is built."""
    findings = []
    debian = _missing_debian(repository)
    if debian:
        findings.append(Finding("packages", f"Debian packages are missing: {listed(debian)}", "./xtdrone setup"))
    python = missing_python(repository / "requirements.txt")
    if python:
        findings.append(Finding("packages", f"Python packages are missing: {listed(python)}", "./xtdrone setup"))
    if not (repository / "devel" / "setup.bash").is_file():
        findings.append(Finding("packages", "the workspace is not built", "./xtdrone setup"))
    return findings


def _missing_debian(repository: Path) -> list[str]:
    """Return missing Debian packages, by the set-up's own list; empty where there is no dpkg."""
    script = (
        'root="$1"; source "$root/scripts/install_and_build.bash"; '
        "! command -v dpkg-query >/dev/null || missing_packages"
    )
    try:
        done = subprocess.run(
            ["bash", "-c", script, "_", str(repository)],
            capture_output=True,
            text=True,
            timeout=_PACKAGES_LIMIT,
            check=False,
        )
    except (OSError, subprocess.TimeoutExpired):
        return []
    return done.stdout.split() if done.returncode == 0 else []


def missing_python(requirements: Path) -> list[str]:
    """Return the pinned packages of a requirements file that are missing or of another version."""
    missing = []
    for line in requirements.read_text(encoding="utf-8").splitlines():
        match = _REQUIREMENT.match(line)
        if match is None:
            continue
        try:
            version = metadata.version(match["name"])
        except metadata.PackageNotFoundError:
            missing.append(match["name"])
            continue
        if version != match["version"]:
            missing.append(f"{match['name']} {match['version']} (there is {version})")
    return missing
