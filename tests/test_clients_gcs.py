"""The project's own ground station flies three vehicles: one flight, tests in file order."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator

import numpy as np
import pytest
from client_world import CLIENT_LIMIT, Core

from xtdrone_autopilot.mavlink.mavlink_server import MavlinkServer
from xtdrone_common import modes
from xtdrone_common.fleet import Vehicle
from xtdrone_interaction.gcs import GroundStation, Peer
from xtdrone_interaction.gcs.exchanges import exchange, logs, parameters
from xtdrone_interaction.gcs.exchanges import plans as plan_exchanges
from xtdrone_interaction.gcs.vehicle_state import VehicleState
from xtdrone_interaction.gcs_commands.gcs_cli import main
from xtdrone_sim.simulation import Simulation

FIRST = 230
COUNT = 3
VEHICLES = [str(FIRST + i) for i in range(COUNT)]


@pytest.fixture(scope="module")
def core(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Core]:
    core = Core(FIRST, tmp_path_factory.mktemp("gcs_core"), COUNT)
    yield core
    core.close()


@pytest.fixture(scope="module")
def until(core: Core) -> Iterator[Callable[[Callable[[list[VehicleState]], bool], str], None]]:
    """Yield a function that waits until the vehicles' states meet a condition."""
    peers = [Peer.of(vehicle) for vehicle in core.vehicles]

    with GroundStation(peers, heartbeat=True) as station:

        def wait(condition: Callable[[list[VehicleState]], bool], what: str) -> None:
            end = time.monotonic() + CLIENT_LIMIT
            while True:
                station.poll(0.2)
                states = station.states()
                if all(state.landed and state.local for state in states) and condition(states):
                    return
                assert core.alive
                assert time.monotonic() < end, (what, [(s.height, s.armed, s.mode, s.landed, s.local) for s in states])

        yield wait


def gcs(*arguments: str) -> int:
    """Run a command for all vehicles."""
    return main([*arguments, "--vehicle", *VEHICLES])


def test_all_take_off(until):
    until(lambda states: all(state.ready for state in states), "ready")
    assert gcs("takeoff", "4") == 0
    until(lambda states: all(state.height > 3.0 and state.armed for state in states), "up")


def test_all_go_to_a_place_of_the_map(until):
    assert gcs("goto", "6", "-8", "5", "--speed", "6") == 2  # all at one position
    assert gcs("goto", "6", "-8", "5", "--speed", "6", "--spacing", "3") == 0
    until(
        lambda states: all(math.dist(s.local, (6.0, -8.0, 5.0 + 3.0 * i)) < 1.0 for i, s in enumerate(states)), "there"
    )
    until(lambda states: all(state.mode == "AUTO.LOITER" for state in states), "loiter")


def test_a_landed_vehicle_rejects_and_the_others_continue(until, capsys):
    assert main(["land", "--vehicle", VEHICLES[0]]) == 0  # the lowest one: the others are above it
    until(lambda states: not states[0].armed, "landed")
    capsys.readouterr()
    assert gcs("goto", "0", "0", "6", "--spacing", "3") == 1
    caught = capsys.readouterr()
    assert [line.split(maxsplit=1)[1] for line in caught.out.splitlines()] == ["failed", "goes there", "goes there"]
    assert f"vehicle_{VEHICLES[0]}: goto: the vehicle is on the ground and disarmed" in caught.err
    until(lambda states: all(math.dist(states[i].local, (0.0, 0.0, 6.0 + 3.0 * i)) < 1.0 for i in (1, 2)), "there")


def test_hold_mode_and_return(until):
    flying = ["--vehicle", *VEHICLES[1:]]
    assert main(["hold", *flying]) == 0
    assert main(["takeoff", "9", *flying]) == 1  # they are in the air already
    assert main(["mode", "LAND", "--vehicle", VEHICLES[1]]) == 0
    assert main(["rtl", "--vehicle", VEHICLES[2]]) == 0
    until(lambda states: (states[1].mode, states[2].mode) == ("AUTO.LAND", "AUTO.RTL"), "modes")
    until(lambda states: not any(state.armed for state in states), "all are down")


def flown(watched: bool) -> tuple[np.ndarray, int]:
    """Return positions and velocities of two vehicles that take off, and the number of a station's requests."""
    fleet = tuple(Vehicle("iris", i, FIRST + COUNT + i) for i in range(2))
    simulation = Simulation(fleet, seed=2)
    server = MavlinkServer(fleet, simulation.autopilot, simulation.commanders)
    peers = [Peer.of(vehicle) for vehicle in fleet] if watched else []
    jobs = (
        exchange.request_state,
        parameters.fetch_all,
        lambda beat: plan_exchanges.download_plan(beat.system),
        logs.fetch_list,
    )
    futures = []
    rows = []
    try:
        with GroundStation(peers, heartbeat=True) as station:
            while simulation.time_us < 8_000_000:
                if simulation.time_us == 3_000_000:
                    for commander in simulation.commanders:
                        assert commander.request(modes.AUTO_TAKEOFF) == 0
                        assert commander.arm_disarm(True) == 0
                simulation.step()
                if simulation.time_us >= server.next_due_us:
                    server.send_streams(simulation.time_us)
                server.receive(0.0)
                if all(future.done() for future in futures[-len(peers) :]):
                    futures += [station.submit(peer, jobs[len(futures) // 2 % len(jobs)]) for peer in peers]
                station.poll(0.0)
                plant = simulation.world.plant
                rows.append(np.concatenate([plant[field].ravel() for field in ("position", "velocity")]))
            failed = [future.exception() for future in futures if future.done()]
            assert failed == [None] * len(failed)
    finally:
        server.close()
        simulation.close()
    return np.array(rows), len(futures)


def test_a_read_only_station_does_not_change_the_flight():
    alone, _ = flown(False)
    watched, asked = flown(True)
    assert alone[-1, 2] > 0.2  # in the air
    assert asked > 20
    np.testing.assert_array_equal(alone, watched)
