"""Numbers of vehicles: disjoint ports of instances, stable ids."""

from __future__ import annotations

import pytest

from xtdrone_common.fleet import (
    MAX_INSTANCE,
    MAX_VEHICLES,
    PX4,
    FleetError,
    Vehicle,
    check_instance,
    check_ports,
    fleet_text,
    parse_fleet,
    place_ids,
)


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


def test_ten_vehicles_on_px4s_ports_are_clear_of_each_instance_but_the_payloads_of_a_larger_one() -> None:
    for instance in range(MAX_INSTANCE + 1):
        stock = parse_fleet("iris:10", instance, PX4)
        ends = {port for one in stock for port in (one.offboard_local_port, one.offboard_remote_port)}
        assert len(ends - {stock[0].gcs_remote_port}) == 20
        others = [one for i in range(MAX_INSTANCE + 1) for one in parse_fleet(f"iris:{MAX_VEHICLES}", i)]
        met = {(one.instance, one.id) for one in others if ends & set(ports(one))}
        assert met <= {(instance + 1, number) for number in range(10, 20)}


def test_px4s_ports_are_those_of_its_own_simulations() -> None:
    vehicle = parse_fleet("iris:10", 0, PX4)[9]
    assert ports(vehicle) == [14589, 14549, 18579, 14289, 14039, 4569]
    assert vehicle.fcu_url == "udp://:14549@localhost:14589"
    assert fleet_text(parse_fleet("iris:10", 2, PX4)) == "iris:10"


def test_more_vehicles_than_px4s_ports_are_for_are_reported() -> None:
    with pytest.raises(FleetError, match="vehicles: 11 with ports 'px4' are not allowed, 1 to 10"):
        parse_fleet("iris:6,solo:5", 0, PX4)
    with pytest.raises(FleetError, match="id: 12 of iris_3 with ports 'px4' is not allowed, 0 to 9"):
        parse_fleet("- {name: iris_3, id: 12}\n- {name: iris_1}", 0, PX4)
    fleet = parse_fleet("iris:8", 0, PX4)
    assert place_ids(fleet, 2) == [*range(10)]
    with pytest.raises(FleetError, match="reserve: 3 is not allowed, 0 to 2 beside 8 vehicles"):
        place_ids(fleet, 3)


@pytest.mark.parametrize("value", ["foo", "PX4", "", 1, None])
def test_unknown_ports_are_reported(value: object) -> None:
    with pytest.raises(FleetError, match=r"ports: .* is not allowed, xtdrone or px4"):
        check_ports(value)


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
