"""Numbers of vehicles: disjoint ports of instances, stable ids."""

from __future__ import annotations

import pytest

from xtdrone_control.fleet import MAX_INSTANCE, MAX_VEHICLES, FleetError, Vehicle, check_instance, parse_fleet


def ports(vehicle: Vehicle) -> list[int]:
    """Return all ports of a vehicle."""
    return [
        vehicle.offboard_local_port, vehicle.offboard_remote_port, vehicle.gcs_local_port, vehicle.payload_local_port,
        vehicle.payload_remote_port, vehicle.simulator_tcp_port,
    ]  # fmt: skip


def test_no_port_of_any_instance_is_anothers() -> None:
    fleets = [parse_fleet(f"iris:{MAX_VEHICLES}", instance) for instance in range(MAX_INSTANCE + 1)]
    every = [port for fleet in fleets for vehicle in fleet for port in ports(vehicle)]
    every += [fleet[0].gcs_remote_port for fleet in fleets]
    assert len(set(every)) == len(every)
    assert max(every) < 65536


def test_instance_0_has_upstreams_ports_and_ids_are_the_same_in_all() -> None:
    vehicle, other = parse_fleet("iris:3")[2], parse_fleet("iris:3", 4)[2]
    assert ports(vehicle) == [34582, 24542, 18572, 14282, 14032, 4562]
    assert vehicle.gcs_remote_port == 14550
    assert [b - a for a, b in zip(ports(vehicle), ports(other), strict=True)] == [4 * 540] * 6
    assert (vehicle.system_id, vehicle.name) == (other.system_id, other.name)
    assert vehicle.fcu_url == "udp://:24542@localhost:34582"


@pytest.mark.parametrize("value", [-1, 8, "x", "", True, 1.5])
def test_an_invalid_instance_is_reported(value: object) -> None:
    with pytest.raises(FleetError, match="is not allowed, a whole number from 0 to 7"):
        check_instance(value)
