"""MAVSDK's gimbal plugin, as its users write it, with the simulated typhoon's gimbal: tests in file order."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from typing import Any

import pytest
from client_world import Core

with warnings.catch_warnings():
    warnings.simplefilter("ignore", FutureWarning)  # the package announces a change in its next version
    pytest.importorskip("mavsdk")
    from mavsdk.gimbal import ControlMode, GimbalError, GimbalMode, SendMode
    from test_clients_mavsdk import HOME, Client

FIRST = 140


@pytest.fixture(scope="module")
def core(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Core]:
    core = Core(FIRST, tmp_path_factory.mktemp("gimbal"), kind="typhoon_h480")
    yield core
    core.close()


@pytest.fixture(scope="module")
def client(core: Core) -> Iterator[Client]:
    client = Client(f"udpin://127.0.0.1:{core.vehicles[0].offboard_remote_port}")
    yield client
    client.close()


@pytest.fixture(scope="module")
def gimbal_id(client: Client) -> int:
    """The id that MAVSDK assigns to the gimbal that it finds."""
    found = client.until(client.drone.gimbal.gimbal_list(), lambda found: bool(found.gimbals))
    (gimbal,) = found.gimbals
    assert (gimbal.gimbal_manager_component_id, gimbal.gimbal_device_id) == (1, 1)
    return int(gimbal.gimbal_id)


def looks(client: Client, pitch: float, yaw: float) -> Any:
    """Wait until the gimbal has a direction, degrees from the horizon and the heading."""

    def there(attitude: Any) -> bool:
        angles = attitude.euler_angle_forward
        return abs(angles.pitch_deg - pitch) < 3.0 and abs(angles.yaw_deg - yaw) < 3.0

    return client.until(client.drone.gimbal.attitude(), there)


def angles(client: Client, gimbal_id: int, pitch: float, yaw: float) -> None:
    gimbal = client.drone.gimbal
    client.run(gimbal.set_angles(gimbal_id, 0.0, pitch, yaw, GimbalMode.YAW_FOLLOW, SendMode.ONCE))


def test_control_is_taken_and_the_camera_turns(client, gimbal_id):
    gimbal = client.drone.gimbal
    with pytest.raises(GimbalError):
        angles(client, gimbal_id, -60.0, 20.0)
    client.run(gimbal.take_control(gimbal_id, ControlMode.PRIMARY))
    client.until(gimbal.control_status(), lambda status: status.control_mode is ControlMode.PRIMARY)
    angles(client, gimbal_id, -60.0, 20.0)
    looks(client, -60.0, 20.0)


def test_a_place_is_looked_at(client, gimbal_id):
    # 100 m north of the world's origin and as high as home; MAVSDK's altitude is AMSL. The vehicle looks east.
    client.run(client.drone.gimbal.set_roi_location(gimbal_id, HOME[0] + 9e-4, HOME[1], 488.0))
    looks(client, 0.0, -90.0)


def test_control_is_given_back(client, gimbal_id):
    gimbal = client.drone.gimbal
    client.run(gimbal.release_control(gimbal_id))
    client.until(gimbal.control_status(), lambda status: status.control_mode is ControlMode.NONE)
    with pytest.raises(GimbalError):
        angles(client, gimbal_id, 0.0, 0.0)


def test_the_core_lives(core):
    assert core.alive
