"""Readings of a running simulation: its state from the simulator, the vehicles' from their MAVROS.

The project's MAVROS layer is asked by a service, which needs no simulated time and changes nothing. A real MAVROS, and
the simplified simulator, are read by their topics.
"""

from __future__ import annotations

import re
import time
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

from xtdrone_common.fleet import FleetError, check_instance, parse_fleet
from xtdrone_interaction.doctor.findings import ESTIMATES, Check, Simulator, Vehicle
from xtdrone_interaction.doctor.graph import Master
from xtdrone_interaction.simulation_services import SimError, call

if TYPE_CHECKING:
    from xtdrone_msgs.msg import SimulationStatus

LISTENING = 3.0  # s of wall time to listen to the topics of a real MAVROS
_READINESS = "get_readiness"
_STATE = re.compile(r"^(?P<prefix>(?:/(?P<name>\w+))?/mavros)/state$")
_MOST_HEARD = 50  # vehicles whose topics are read


def simulator_of(status: SimulationStatus) -> Simulator:
    """Return the state of the simulator, from its message."""
    return Simulator(
        time=status.sim_time.to_sec(),
        speed=status.speed,
        measured_speed=status.measured_speed,
        paused=bool(status.paused and not status.stepping),
        participants=tuple(sorted(status.participants)),
        waiting_for=tuple(sorted(status.waiting_for)),
        waiting=status.waiting.to_sec(),
        reason=str(status.reason),
    )


def read_simulator(master: Master) -> Simulator | None:
    """Return the state of the simulator; None without one.

    Raises:
        SimError: the simulator does not answer.
    """
    from xtdrone_msgs.srv import GetStatus, GetStatusRequest

    if "/simulator/get_status" not in master.services:
        return None
    return simulator_of(call(master.uri, "/simulator/get_status", GetStatus, GetStatusRequest()).status)


def read_vehicles(master: Master, simulator: Simulator | None) -> list[Vehicle]:
    """Return the vehicles of the fleet, or those with a MAVROS if no fleet is set, in order.

    Args:
        master: with the vehicles' topics.
        simulator: None for vehicles on wall time.

    Raises:
        SimError: a MAVROS layer does not answer.
    """
    found = {vehicle.prefix: vehicle for vehicle in read_asked_vehicles(master)}
    rest = [prefix for prefix in _prefixes(master) if prefix not in found]
    found |= {vehicle.prefix: vehicle for vehicle in _heard(master, rest[:_MOST_HEARD], simulator)}
    names = _fleet(master)
    fleet = [found.pop(prefix, _unserved(name)) for name in names for prefix in (f"/{name}/mavros",)]
    return [*fleet, *found.values()]


def _unserved(name: str) -> Vehicle:
    return Vehicle(name=name, prefix=f"/{name}/mavros", served=False)


def _fleet(master: Master) -> list[str]:
    text = str(master.parameter("/xtdrone/fleet"))
    try:
        return [vehicle.name for vehicle in parse_fleet(text, check_instance(master.parameter("/xtdrone/instance", 0)))]
    except FleetError:  # none, or another program's
        return []


def _prefixes(master: Master) -> list[str]:
    """Return the namespaces in which a living node publishes MAVROS's state."""
    return [match["prefix"] for topic in sorted(master.graph.publishers) if (match := _STATE.match(topic))]


def read_asked_vehicles(master: Master, *, telemetry: bool = False) -> list[Vehicle]:
    """Return the vehicles of the project's MAVROS layers, which are asked by a service.

    Args:
        master: with the services.
        telemetry: with battery and estimator.

    Raises:
        SimError: a MAVROS layer does not answer.
    """
    from xtdrone_msgs.srv import GetReadiness, GetReadinessRequest

    vehicles = []
    for service in sorted(name for name in master.services if name.endswith(f"/{_READINESS}")):
        answer = call(master.uri, service, GetReadiness, GetReadinessRequest(telemetry=telemetry))
        own = service.removesuffix(f"/{_READINESS}")  # the node's name: a namespace of topics with one vehicle
        alone = f"{own}/state" in master.graph.publishers
        for entry in answer.vehicles:
            vehicles.append(
                Vehicle(
                    name=entry.vehicle,
                    prefix=own if alone else f"/{entry.vehicle}/mavros",
                    served=True,
                    heard=True,
                    connected=entry.connected,
                    armed=entry.armed,
                    mode=entry.mode,
                    system_status=entry.system_status,
                    fcu_url=entry.fcu_url,
                    checks=_checks(entry.checks) if entry.reported else None,
                    battery=float(entry.battery) if 0.0 <= entry.battery <= 1.0 else None,
                    estimates=_estimates(entry.estimator_flags) if entry.estimated else None,
                )
            )
    return vehicles


def _estimates(flags: int) -> tuple[str, ...]:
    return tuple(word for _, bit, word in ESTIMATES if flags & bit)


def _checks(entries: Iterable[object]) -> tuple[Check, ...]:
    return tuple(
        Check(entry.name, entry.text, entry.blocks_arming, entry.blocks_offboard)  # type: ignore[attr-defined]
        for entry in entries
    )


def _heard(master: Master, prefixes: Sequence[str], simulator: Simulator | None) -> list[Vehicle]:
    """Return what vehicles report on their topics within ``LISTENING`` s of wall time."""
    if not prefixes:
        return []
    from xtdrone_interaction.doctor.listening import Listener

    with Listener(master.uri, prefixes, master.graph.publishers) as listener:
        time.sleep(LISTENING)
        counted = _counted_time(master, simulator)
        return [listener.vehicle(prefix, counted) for prefix in prefixes]


def _counted_time(master: Master, simulator: Simulator | None) -> float:
    """Return the time in which setpoints were counted, s; 0 where their rate says nothing."""
    if simulator is None:
        return LISTENING
    simplified = "/simulator/autopilot" not in master.parameters  # it needs no setpoints, commands alone move it
    return 0.0 if simplified or simulator.reason else LISTENING * simulator.measured_speed


__all__ = ["LISTENING", "SimError", "read_asked_vehicles", "read_simulator", "read_vehicles", "simulator_of"]
