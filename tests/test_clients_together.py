"""Four clients at once on one vehicle, each with its own link: MAVSDK twice, MAVProxy, and a pymavlink script.

Each works while the others do; one disconnects in flight, and another one connects.
"""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from client_world import Core

pytest.importorskip("mavsdk")
pytest.importorskip("MAVProxy")
from pymavlink.dialects.v20 import common as mavlink
from test_clients_mavproxy import Prompt
from test_clients_mavsdk import Client
from test_clients_pymavlink import Station

FIRST = 170


@pytest.fixture(scope="module")
def core(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Core]:
    core = Core(FIRST, tmp_path_factory.mktemp("together"))
    yield core
    core.close()


def test_four_clients_at_one_vehicle(core, tmp_path):
    vehicle = core.vehicles[0]
    system = vehicle.system_id
    onboard = Client(f"udpin://127.0.0.1:{vehicle.offboard_remote_port}")
    ground = Client(f"udpout://127.0.0.1:{vehicle.gcs_local_port}")
    prompt = Prompt(vehicle.gcs_local_port, tmp_path)
    script = Station(core)
    try:
        prompt.wait(f"Detected vehicle {system}:1", "Received ", "parameters")
        script.until(lambda: (system, "HEARTBEAT") in script.last, "a heartbeat")
        # one sets, all receive it
        script.connection.mav.param_set_send(system, 1, b"MIS_TAKEOFF_ALT", 4.0, 9)
        script.until(
            lambda: getattr(script.last.get((system, "PARAM_VALUE")), "param_id", "") == "MIS_TAKEOFF_ALT", "its answer"
        )
        for client in (onboard, ground):
            assert client.run(client.drone.param.get_param_float("MIS_TAKEOFF_ALT")) == 4.0
        # one arms, another one takes off, all receive it
        ground.until(ground.drone.telemetry.health(), lambda health: health.is_armable)
        prompt.say("arm throttle", "COMPONENT_ARM_DISARM: ACCEPTED")
        onboard.until(onboard.drone.telemetry.armed(), lambda armed: armed)
        onboard.run(onboard.drone.action.takeoff())
        ground.until(ground.drone.telemetry.position(), lambda position: position.relative_altitude_m > 3.0)
        script.until(lambda: script.height(system) > 3.0, "the script sees it")
        prompt.wait("Takeoff detected")
        # one disconnects, the others stay
        onboard.close()
        assert script.command(system, mavlink.MAV_CMD_NAV_LAND) == 0
        ground.until(ground.drone.telemetry.armed(), lambda armed: not armed)
        prompt.wait("DISARMED")
        # another one connects in its place
        onboard = Client(f"udpin://127.0.0.1:{vehicle.offboard_remote_port}")
        assert not onboard.until(onboard.drone.telemetry.in_air(), lambda in_air: not in_air)
    finally:
        script.close()
        prompt.close()
        for client in (onboard, ground):
            client.close()
    assert core.alive
