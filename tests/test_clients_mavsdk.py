"""MAVSDK-Python, as its users write it, against the autopilot: one flight, tests in file order."""

from __future__ import annotations

import asyncio
import json
import math
import warnings
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator
from typing import Any, TypeVar

import pytest
from client_world import CLIENT_LIMIT, Core, free_port

from xtdrone_common.fleet import PX4

with warnings.catch_warnings():
    warnings.simplefilter("ignore", FutureWarning)  # the package announces a change in its next version
    mavsdk = pytest.importorskip("mavsdk")
    from mavsdk.action import ActionError
    from mavsdk.component_metadata import MetadataType
    from mavsdk.follow_me import Config, TargetLocation
    from mavsdk.geofence import FenceType, GeofenceData, Point, Polygon
    from mavsdk.mission import MissionItem, MissionPlan
    from mavsdk.offboard import OffboardError, PositionNedYaw, VelocityNedYaw
    from mavsdk.param import ParamError
    from mavsdk.telemetry import FlightMode, LandedState

FIRST = 6  # with PX4's stock ports, for at most ten vehicles
HOME = (47.397742, 8.545594)  # degrees; the world's origin
NAN = math.nan

T = TypeVar("T")


class Client:
    """A MAVSDK System, and its event loop.

    Attributes:
        drone: the System.
    """

    def __init__(self, address: str) -> None:
        self._loop = asyncio.new_event_loop()
        asyncio.set_event_loop(self._loop)
        self.drone = mavsdk.System(port=free_port())
        self.run(self._connect(address))

    async def _connect(self, address: str) -> None:
        await self.drone.connect(system_address=address)
        await first(self.drone.core.connection_state(), lambda state: state.is_connected)

    def run(self, what: Awaitable[T]) -> T:
        """Run ``what`` to its end."""
        return self._loop.run_until_complete(asyncio.wait_for(what, CLIENT_LIMIT))

    def until(self, stream: AsyncIterator[T], condition: Callable[[T], bool] = lambda value: True) -> T:
        """Return the first value of a telemetry stream that satisfies ``condition``."""
        return self.run(first(stream, condition))

    def close(self) -> None:
        self.drone._stop_mavsdk_server()
        self._loop.close()


async def first(stream: AsyncIterator[T], condition: Callable[[T], bool]) -> T:
    async for value in stream:
        if condition(value):
            return value
    raise AssertionError("the stream has ended")


@pytest.fixture(scope="module")
def core(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Core]:
    core = Core(FIRST, tmp_path_factory.mktemp("mavsdk"), ports=PX4)
    yield core
    core.close()


@pytest.fixture(scope="module")
def client(core: Core) -> Iterator[Client]:
    client = Client(f"udpin://127.0.0.1:{14540 + FIRST}")
    yield client
    client.close()


def near(client: Client, north: float, east: float, down: float, radius: float = 0.5) -> Any:
    """Wait until the vehicle is at a position, m NED from the world's origin."""

    def is_there(state: Any) -> bool:
        p = state.position
        return math.dist((p.north_m, p.east_m, p.down_m), (north, east, down)) < radius

    return client.until(client.drone.telemetry.position_velocity_ned(), is_there)


def test_it_is_a_px4(client):
    drone = client.drone
    version = client.run(drone.info.get_version())
    assert (version.flight_sw_major, version.flight_sw_minor) == (1, 14)
    client.run(drone.info.get_identification())
    product = client.run(drone.info.get_product())
    assert product.vendor_name


def test_telemetry(client):
    telemetry = client.drone.telemetry
    health = client.until(telemetry.health(), lambda health: health.is_armable)
    assert health.is_global_position_ok
    assert health.is_local_position_ok
    assert health.is_home_position_ok
    position = client.until(telemetry.position())
    assert position.latitude_deg == pytest.approx(HOME[0], abs=1e-3)
    assert position.relative_altitude_m == pytest.approx(0.0, abs=0.5)
    home = client.until(telemetry.home())
    assert home.longitude_deg == pytest.approx(HOME[1], abs=1e-3)
    assert client.until(telemetry.attitude_euler()).roll_deg == pytest.approx(0.0, abs=2.0)
    assert abs(client.until(telemetry.attitude_quaternion()).w) <= 1.0
    assert client.until(telemetry.battery()).remaining_percent > 90.0
    assert client.until(telemetry.gps_info()).num_satellites == 14
    assert client.until(telemetry.flight_mode()) is FlightMode.HOLD
    assert client.until(telemetry.landed_state()) is LandedState.ON_GROUND
    assert not client.until(telemetry.armed())
    assert not client.until(telemetry.in_air())
    assert client.until(telemetry.raw_gps()).absolute_altitude_m == pytest.approx(488.0, abs=2.0)
    assert client.until(telemetry.imu()).acceleration_frd.down_m_s2 == pytest.approx(-9.8, abs=0.5)


def test_a_rate_can_be_requested(client):
    client.run(client.drone.telemetry.set_rate_position_velocity_ned(30.0))
    client.run(client.drone.telemetry.set_rate_attitude_euler(50.0))


def test_parameters(client):
    param = client.drone.param
    assert client.run(param.get_param_float("MPC_XY_VEL_MAX")) == 12.0
    assert client.run(param.get_param_int("MAV_SYS_ID")) == FIRST + 1
    client.run(param.set_param_float("MIS_TAKEOFF_ALT", 4.0))
    assert client.run(param.get_param_float("MIS_TAKEOFF_ALT")) == 4.0
    everything = client.run(param.get_all_params())
    assert {p.name: p.value for p in everything.float_params}["MIS_TAKEOFF_ALT"] == 4.0
    assert "COM_RC_IN_MODE" in {p.name for p in everything.int_params}
    with pytest.raises(ParamError):
        client.run(param.get_param_int("NO_SUCH_NAME"))


async def steps(calibration: AsyncIterator[Any]) -> list[Any]:
    return [step async for step in calibration]


def test_calibrations_that_need_no_movement(client):
    """The generators end without an error once the calibration is done."""
    calibration = client.drone.calibration
    for found in (
        client.run(steps(calibration.calibrate_gyro())),
        client.run(steps(calibration.calibrate_level_horizon())),
    ):
        percents = [round(100 * step.progress) for step in found if step.has_progress]
        assert percents == sorted(percents)
        assert 20 in percents
        assert percents[-1] == 100


def test_metadata_of_events_and_parameters(client):
    plugin = client.drone.component_metadata

    async def load() -> dict[Any, str]:
        found: dict[Any, str] = {}
        await plugin.request_autopilot_component()
        async for update in plugin.metadata_available():
            if update.type is MetadataType.ALL_COMPLETED:
                return found
            found[update.type] = update.json_metadata
        raise AssertionError("the stream has ended")

    found = client.run(load())
    assert set(found) == {MetadataType.PARAMETER, MetadataType.EVENTS}
    parameters = {entry["name"]: entry for entry in json.loads(found[MetadataType.PARAMETER])["parameters"]}
    assert parameters["MAV_SYS_ID"]["default"] == FIRST + 1
    assert parameters["MPC_XY_VEL_MAX"]["units"] == "m/s"


def test_events_as_text(client):
    """MAVSDK reads the definitions itself, and formats our events with them."""
    events = client.drone.events

    async def listen(stream: AsyncIterator[T], condition: Callable[[T], bool], cause: Awaitable[Any]) -> T:
        found = asyncio.ensure_future(first(stream, condition))
        await cause
        return await found

    async def refused() -> None:
        for _ in range(3):  # the definitions are loaded in the background
            with pytest.raises(ActionError):
                await client.drone.action.arm()
            await asyncio.sleep(0.3)

    client.run(client.drone.param.set_param_int("COM_ARM_MIS_REQ", 1))
    report = client.run(listen(events.health_and_arming_checks(), lambda report: True, refused()))
    assert not report.current_mode_intention.can_arm_or_run
    assert [problem.message for problem in report.current_mode_intention.problems] == ["No valid mission available"]
    assert {part.name for part in report.health_components} >= {"gps", "battery", "attitude_estimate"}
    client.run(client.drone.param.set_param_int("COM_ARM_MIS_REQ", 0))
    armed = client.run(listen(events.events(), lambda e: "armed_by" in e.event_name, client.drone.action.arm()))
    assert (armed.event_name, armed.message) == ("commander_armed_by", "Armed by external command")
    client.run(client.drone.action.disarm())


def test_refusals_on_the_ground(client):
    offboard = client.drone.offboard
    with pytest.raises(OffboardError, match="NO_SETPOINT_SET"):
        client.run(offboard.start())


def test_take_off(client):
    action, telemetry = client.drone.action, client.drone.telemetry
    client.run(action.set_takeoff_altitude(5.0))
    assert client.run(action.get_takeoff_altitude()) == 5.0
    client.run(action.arm())
    assert client.until(telemetry.armed(), lambda armed: armed)
    client.run(action.takeoff())
    client.until(telemetry.landed_state(), lambda state: state is LandedState.IN_AIR)
    client.until(telemetry.flight_mode(), lambda mode: mode is FlightMode.HOLD)
    position = client.until(telemetry.position(), lambda position: position.relative_altitude_m > 4.0)
    assert position.relative_altitude_m < 5.5


def test_disarming_in_the_air_is_rejected(client):
    with pytest.raises(ActionError, match="COMMAND_DENIED"):
        client.run(client.drone.action.disarm())


def test_offboard_position(client):
    offboard = client.drone.offboard
    client.run(offboard.set_position_ned(PositionNedYaw(3.0, 0.0, -6.0, 0.0)))
    client.run(offboard.start())
    client.until(client.drone.telemetry.flight_mode(), lambda mode: mode is FlightMode.OFFBOARD)
    near(client, 3.0, 0.0, -6.0)
    client.run(offboard.set_position_ned(PositionNedYaw(8.0, 0.0, -6.0, 90.0)))
    near(client, 8.0, 0.0, -6.0)
    heading = client.until(client.drone.telemetry.heading(), lambda heading: abs(heading.heading_deg - 90.0) < 5.0)
    assert heading.heading_deg == pytest.approx(90.0, abs=5.0)


def test_offboard_velocity(client):
    offboard = client.drone.offboard
    client.run(offboard.set_velocity_ned(VelocityNedYaw(0.0, 3.0, 0.0, 90.0)))
    state = client.until(
        client.drone.telemetry.position_velocity_ned(), lambda state: abs(state.velocity.east_m_s - 3.0) < 0.3
    )
    assert abs(state.velocity.north_m_s) < 0.7
    client.run(offboard.set_velocity_ned(VelocityNedYaw(0.0, 0.0, 0.0, 90.0)))
    client.until(client.drone.telemetry.position_velocity_ned(), lambda state: abs(state.velocity.east_m_s) < 0.2)
    client.run(offboard.stop())
    client.until(client.drone.telemetry.flight_mode(), lambda mode: mode is FlightMode.HOLD)


def test_go_to_a_place(client):
    client.run(client.drone.action.goto_location(HOME[0] + 1e-4, HOME[1], 494.0, 0.0))
    near(client, 11.1, 0.0, -6.0, 1.0)


def test_follow_me(client):
    """In front of a standing target, whose course counts as north: above the vehicle's present position."""
    follow = client.drone.follow_me
    config = Config(9.0, 6.0, 0.5, Config.FollowAltitudeMode.CONSTANT, 4.0, 0.0)
    client.run(follow.set_config(config))
    get = client.drone.param.get_param_float
    assert [client.run(get(f"FLW_TGT_{name}")) for name in ("HT", "DST", "RS", "MAX_VEL", "FA")] == [9, 6, 0.5, 4, 0]
    client.run(follow.start())
    client.until(client.drone.telemetry.flight_mode(), lambda mode: mode is FlightMode.FOLLOW_ME)
    client.until(client.drone.telemetry.position())  # one message later the plugin has received the mode, too
    target = item(5.1, 0.0, 488.0)
    location = TargetLocation(target.latitude_deg, target.longitude_deg, 488.0, 0.0, 0.0, 0.0)
    client.run(follow.set_target_location(location))
    near(client, 11.1, 0.0, -9.0)
    heading = client.until(client.drone.telemetry.heading(), lambda heading: abs(heading.heading_deg - 180.0) < 5.0)
    assert heading.heading_deg == pytest.approx(180.0, abs=5.0)
    client.run(follow.stop())
    client.until(client.drone.telemetry.flight_mode(), lambda mode: mode is FlightMode.HOLD)


def item(north: float, east: float, altitude: float, speed: float = 5.0) -> MissionItem:
    """Return a waypoint, m from the world's origin."""
    latitude = HOME[0] + math.degrees(north / 6371000.0)
    longitude = HOME[1] + math.degrees(east / 6371000.0 / math.cos(math.radians(HOME[0])))
    action = MissionItem.CameraAction.NONE
    vehicle = MissionItem.VehicleAction.NONE
    return MissionItem(
        latitude, longitude, altitude, speed, True, NAN, NAN, action, NAN, NAN, 1.0, NAN, NAN, vehicle
    )  # fmt: skip


def test_a_mission(client):
    mission = client.drone.mission
    plan = MissionPlan([item(15.0, 0.0, 8.0), item(15.0, 15.0, 8.0), item(0.0, 15.0, 8.0)])
    client.run(mission.set_return_to_launch_after_mission(False))
    client.run(mission.upload_mission(plan))
    downloaded = client.run(mission.download_mission())
    assert [round(i.relative_altitude_m, 3) for i in downloaded.mission_items] == [8.0] * 3
    assert downloaded.mission_items[1].longitude_deg == pytest.approx(plan.mission_items[1].longitude_deg, abs=1e-6)
    client.run(mission.start_mission())
    client.until(client.drone.telemetry.flight_mode(), lambda mode: mode is FlightMode.MISSION)
    seen = []

    async def fly() -> None:
        async for progress in mission.mission_progress():
            seen.append((progress.current, progress.total))
            if progress.current == progress.total:
                return

    client.run(fly())
    assert [current for current, _ in seen] == sorted(current for current, _ in seen)
    assert {total for _, total in seen} == {3}
    assert client.run(mission.is_mission_finished())
    near(client, 0.0, 15.0, -8.0, 2.0)
    client.until(client.drone.telemetry.flight_mode(), lambda mode: mode is FlightMode.HOLD)


def test_a_geofence(client):
    geofence = client.drone.geofence
    corners = [item(north, east, 0.0) for north, east in ((-80, -80), (-80, 80), (80, 80), (80, -80))]
    points = [Point(corner.latitude_deg, corner.longitude_deg) for corner in corners]
    client.run(geofence.upload_geofence(GeofenceData([Polygon(points, FenceType.INCLUSION)], [])))
    client.run(geofence.clear_geofence())


def test_return_and_land(client):
    action, telemetry = client.drone.action, client.drone.telemetry
    client.run(action.set_return_to_launch_altitude(12.0))
    client.run(action.return_to_launch())
    client.until(telemetry.flight_mode(), lambda mode: mode is FlightMode.RETURN_TO_LAUNCH)
    client.until(telemetry.landed_state(), lambda state: state is LandedState.ON_GROUND)
    client.until(telemetry.armed(), lambda armed: not armed)
    near(client, 3.0, 0.0, 0.0, 0.7)


def test_the_flights_log_is_downloaded(client, core, tmp_path):
    pyulog = pytest.importorskip("pyulog")
    logs = client.drone.log_files
    entries = client.run(logs.get_entries())
    assert entries
    path = tmp_path / "flight.ulg"

    async def download() -> None:
        async for _ in logs.download_log_file(entries[-1], str(path)):
            pass

    client.run(download())
    assert path.stat().st_size == entries[-1].size_bytes
    downloaded = path.read_bytes()
    written = [file.read_bytes() for file in core.logs.rglob("*.ulg")]  # the log may grow after the list was made
    assert [content.startswith(downloaded) for content in written] == [True]
    names = {data.name for data in pyulog.ULog(str(path)).data_list}
    assert {"vehicle_local_position", "vehicle_attitude", "vehicle_status"} <= names


def test_the_core_lives(core):
    assert core.alive
