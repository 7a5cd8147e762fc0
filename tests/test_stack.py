"""The whole stack for two vehicles as ``roslaunch multi_vehicle.launch`` starts it, at full speed, seen by its users.

One launch serves all tests of this file, which run in file order: on the ground, in flight, landing,
and at last the end of the launch.
"""

from __future__ import annotations

import math
import os
import signal
import sys
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from conftest import FLEET, REPOSITORY, START_LIMIT, WALL_LIMIT, Graph, Stack, poll, wait_for_ports

pytest.importorskip("rospy")

from geometry_msgs.msg import PoseStamped, Twist, TwistStamped
from mavros_msgs.msg import ExtendedState, HomePosition, StatusText
from mavros_msgs.srv import CommandBool, CommandHome, CommandTOL, SetMode
from pymavlink import mavutil
from pymavlink.dialects.v20 import common as mavlink
from sensor_msgs.msg import BatteryState, Imu, NavSatFix
from std_msgs.msg import Float64
from xtdrone_msgs.srv import SetSpeed

from xtdrone_autopilot.navigator.plan import PlanItem
from xtdrone_autopilot.plans import waypoint_file
from xtdrone_autopilot.plans.waypoint_file import Row
from xtdrone_mavros.programs import mavcmd, mavparam, mavsafety, mavsys, mavwp, parameter_formats
from xtdrone_mavros.programs.shared_arguments_and_calls import ProgramError, execute

DATUM = (47.397742, 8.545594, 488.0)  # of the world "empty": degrees, degrees, m AMSL
GEOID = 47.3  # m over the ellipsoid there
EARTH = 6371000.0  # m
GCS_PORT = 18570
HEIGHT = 3.0  # m
SPAWN = [(0.0, 3.0), (3.0, 3.0)]  # m ENU, with two rows

TOPICS = {
    "state": "mavros_msgs/State",
    "extended_state": "mavros_msgs/ExtendedState",
    "battery": "sensor_msgs/BatteryState",
    "statustext/recv": "mavros_msgs/StatusText",
    "local_position/pose": "geometry_msgs/PoseStamped",
    "local_position/velocity_local": "geometry_msgs/TwistStamped",
    "local_position/velocity_body": "geometry_msgs/TwistStamped",
    "local_position/odom": "nav_msgs/Odometry",
    "imu/data": "sensor_msgs/Imu",
    "imu/data_raw": "sensor_msgs/Imu",
    "imu/mag": "sensor_msgs/MagneticField",
    "global_position/global": "sensor_msgs/NavSatFix",
    "global_position/raw/fix": "sensor_msgs/NavSatFix",
    "global_position/rel_alt": "std_msgs/Float64",
    "global_position/compass_hdg": "std_msgs/Float64",
    "home_position/home": "mavros_msgs/HomePosition",
    "setpoint_raw/local": "mavros_msgs/PositionTarget",
    "setpoint_raw/attitude": "mavros_msgs/AttitudeTarget",
    "setpoint_position/local": "geometry_msgs/PoseStamped",
    "setpoint_velocity/cmd_vel": "geometry_msgs/TwistStamped",
    "setpoint_velocity/cmd_vel_unstamped": "geometry_msgs/Twist",
}


@pytest.fixture(scope="module")
def stack(graph: Graph, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Stack]:
    wait_for_ports()
    stack = Stack(graph, tmp_path_factory.mktemp("stack"))
    try:
        stack.launch("multi_vehicle.launch", f"vehicles:={FLEET}", "rows:=2", "speed:=0", "participants:=2")
        poll(lambda: _fleet_is_set(graph), "roslaunch sets its parameters")
        stack.run("communication", "xtdrone_control", "multirotor_communication.py", "iris", "all")
        stack.wait(lambda: stack.pose(0) and stack.time > 0.0, "the simulation runs", wall=START_LIMIT)
        for i in range(2):
            stack.wait_state(i)
        yield stack
    finally:
        stack.stop()


def _fleet_is_set(graph: Graph) -> bool:
    import rosgraph

    return bool(rosgraph.Master("/system_tests").hasParam("/lockstep/uri"))


@pytest.fixture
def flying(stack: Stack) -> list[tuple[float, float, float]]:
    """Two vehicles that hold their positions in OFFBOARD; return the positions, m ENU."""
    return [stack.fly(i, HEIGHT) for i in range(2)]


def ear(stack: Stack, topic: str, kind: type) -> Any:
    """Return the subscription to a topic of iris_1, after its first message."""
    found = stack.graph.hear(f"/iris_1/mavros/{topic}", kind)
    stack.wait(lambda: found.last is not None, f"{topic} comes")
    return found


def stamp(message: Any) -> float:
    return message.header.stamp.to_sec()


def yaw(message: PoseStamped) -> float:
    """Return the heading, rad from east, anticlockwise."""
    q = message.pose.orientation
    return math.atan2(2.0 * (q.w * q.z + q.x * q.y), 1.0 - 2.0 * (q.y * q.y + q.z * q.z))


def place_enu(latitude: float, longitude: float) -> tuple[float, float]:
    """Return metres east and north of the datum."""
    east = math.radians(longitude - DATUM[1]) * EARTH * math.cos(math.radians(DATUM[0]))
    return east, math.radians(latitude - DATUM[0]) * EARTH


class Station:
    """pymavlink's own ground station on a vehicle's GCS port."""

    def __init__(self, index: int) -> None:
        self.target = index + 1
        self.link = mavutil.mavlink_connection(f"udpout:127.0.0.1:{GCS_PORT + index}", source_system=255)
        self.link.mav.heartbeat_send(mavlink.MAV_TYPE_GCS, mavlink.MAV_AUTOPILOT_INVALID, 0, 0, 0)

    def next(self, kind: str, **fields: Any) -> Any:
        """Return the next message of a kind whose fields have these values."""
        while True:
            message = self.link.recv_match(type=kind, blocking=True, timeout=WALL_LIMIT)
            assert message is not None, f"no {kind} with {fields}"
            if all(getattr(message, name) == value for name, value in fields.items()):
                return message

    def parameters(self) -> set[str]:
        """Return the names of all parameters; those whose datagrams are lost are requested again, as stations do."""
        self.link.mav.param_request_list_send(self.target, 1)
        first = self.next("PARAM_VALUE")
        names = {first.param_index: first.param_id}
        while missing := set(range(first.param_count)) - set(names):
            message = self.link.recv_match(type="PARAM_VALUE", blocking=True, timeout=2.0)
            if message is None:
                for index in sorted(missing)[:20]:
                    self.link.mav.param_request_read_send(self.target, 1, b"", index)
            elif message.param_index < first.param_count:
                names[message.param_index] = message.param_id
        return set(names.values())


@pytest.fixture
def station(stack: Stack) -> Iterator[Station]:
    opened = Station(1)
    yield opened
    opened.link.close()


# ---- on the ground


def test_topics_have_mavros_names_and_types(stack: Stack) -> None:
    import rosgraph

    types = dict(rosgraph.Master("/system_tests").getTopicTypes())
    for vehicle in stack.vehicles:
        found = {name: types.get(f"/{vehicle.name}/mavros/{name}") for name in TOPICS}
        assert found == TOPICS


def test_rates_in_simulated_time_are_mavros_ones(stack: Stack) -> None:
    wanted = {
        "local_position/pose": (PoseStamped, 30.0),
        "local_position/velocity_local": (TwistStamped, 30.0),
        "imu/data": (Imu, 50.0),
    }
    ears = {topic: ear(stack, topic, kind) for topic, (kind, _) in wanted.items()}
    counts = {topic: len(found.messages) for topic, found in ears.items()}
    stack.pass_time(6.0)
    for topic, found in ears.items():
        stamps = [stamp(message) for message in found.since(counts[topic])]
        steps = [b - a for a, b in pairwise(stamps)]
        rate = wanted[topic][1]
        assert len(steps) / (stamps[-1] - stamps[0]) == pytest.approx(rate, rel=0.01), topic
        assert min(steps) > 0.5 / rate, topic
        assert max(steps) < 1.5 / rate, topic


def test_on_the_ground_it_stands_where_it_was_put(stack: Stack) -> None:
    pose = ear(stack, "local_position/pose", PoseStamped)
    assert pose.last.header.frame_id == "map"
    p = pose.last.pose.position
    assert (p.x, p.y) == pytest.approx(SPAWN[1], abs=1.0)
    assert p.z == pytest.approx(0.0, abs=1.0)
    state = stack.state(1)
    assert (state.connected, state.armed, state.mode) == (True, False, "AUTO.LOITER")
    assert ear(stack, "extended_state", ExtendedState).last.landed_state == ExtendedState.LANDED_STATE_ON_GROUND
    force = ear(stack, "imu/data", Imu).last.linear_acceleration
    assert force.z == pytest.approx(9.81, abs=0.5)


def test_the_battery_is_plausible(stack: Stack) -> None:
    battery = ear(stack, "battery", BatteryState).last
    assert battery.present
    assert 0.0 < battery.percentage <= 1.0
    assert 9.0 < battery.voltage < 26.0
    assert sum(battery.cell_voltage) == pytest.approx(battery.voltage)
    assert battery.current == 1.0  # PX4's simulator does not measure it: its -1 A is negated by MAVROS


def test_home_is_the_datum_and_the_offset(stack: Stack) -> None:
    home = ear(stack, "home_position/home", HomePosition).last
    assert place_enu(home.geo.latitude, home.geo.longitude) == pytest.approx(SPAWN[1], abs=1.5)
    assert home.geo.altitude == pytest.approx(DATUM[2] + GEOID, abs=3.0)
    assert (home.position.x, home.position.y) == pytest.approx(SPAWN[1], abs=1.0)


def test_a_real_client_on_the_ground_stations_port(stack: Stack, station: Station) -> None:
    heartbeat = station.next("HEARTBEAT", system_status=mavlink.MAV_STATE_STANDBY)  # once it has started
    assert heartbeat.get_srcSystem() == 2
    assert heartbeat.get_srcComponent() == mavlink.MAV_COMP_ID_AUTOPILOT1
    assert heartbeat.type == mavlink.MAV_TYPE_QUADROTOR
    assert heartbeat.autopilot == mavlink.MAV_AUTOPILOT_PX4
    assert heartbeat.mavlink_version == 3
    assert heartbeat.base_mode & mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
    assert not heartbeat.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED
    assert mavutil.mode_string_v10(heartbeat) == "LOITER"  # pymavlink's own reading of PX4's custom mode


def test_a_real_client_lists_and_sets_parameters(stack: Stack, station: Station) -> None:
    names = station.parameters()
    assert {"MPC_XY_VEL_MAX", "COM_OF_LOSS_T", "MIS_TAKEOFF_ALT", "MAV_SYS_ID"} <= names
    for value in (3.5, 2.5):
        station.link.mav.param_set_send(2, 1, b"MIS_TAKEOFF_ALT", value, mavlink.MAV_PARAM_TYPE_REAL32)
        assert station.next("PARAM_VALUE", param_id="MIS_TAKEOFF_ALT").param_value == pytest.approx(value)


def test_a_real_client_gets_acks_and_messages(stack: Stack, station: Station) -> None:
    send = station.link.mav.command_long_send
    request = mavlink.MAV_CMD_REQUEST_MESSAGE
    send(2, 1, request, 0, mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION, 0, 0, 0, 0, 0, 0)
    assert station.next("AUTOPILOT_VERSION").capabilities & mavlink.MAV_PROTOCOL_CAPABILITY_MAVLINK2
    assert station.next("COMMAND_ACK", command=request).result == mavlink.MAV_RESULT_ACCEPTED
    send(2, 1, 31010, 0, 0, 0, 0, 0, 0, 0, 0)
    assert station.next("COMMAND_ACK", command=31010).result == mavlink.MAV_RESULT_UNSUPPORTED
    interval = mavlink.MAV_CMD_SET_MESSAGE_INTERVAL
    send(2, 1, interval, 0, mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED, 1e5, 0, 0, 0, 0, 0)
    assert station.next("COMMAND_ACK", command=interval).result == mavlink.MAV_RESULT_ACCEPTED
    times = [station.next("LOCAL_POSITION_NED").time_boot_ms for _ in range(6)]
    assert times[-1] - times[2] == pytest.approx(300, abs=8)
    send(2, 1, interval, 0, mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED, 0, 0, 0, 0, 0, 0)  # the default again


# ---- in flight


class Typed:
    """A MAVROS program as a user types it, against iris_0's MAVROS; it runs in this process, already a node."""

    def __init__(self, capsys: pytest.CaptureFixture[str]) -> None:
        self._capsys = capsys

    def __call__(self, program: Any, line: str) -> str:
        """Return the program's output."""
        self._capsys.readouterr()
        execute(program.parser(), ["-n", "iris_0/mavros", *line.split()])
        return str(self._capsys.readouterr().out)

    def fails(self, program: Any, line: str) -> str:
        """Return the program's error message."""
        with pytest.raises(ProgramError) as error:
            self(program, line)
        return str(error.value)


@pytest.fixture
def typed(capsys: pytest.CaptureFixture[str]) -> Typed:
    return Typed(capsys)


@pytest.fixture
def unhurried(stack: Stack) -> Iterator[None]:
    """Run at real time, so that programs that depend on wall time get the processors."""
    stack.graph.call("/simulator/set_speed", SetSpeed, speed=1.0)
    yield
    stack.graph.call("/simulator/set_speed", SetSpeed, speed=0.0)


@pytest.mark.usefixtures("unhurried")
def test_mavros_s_programs_read_and_write_parameters(stack: Stack, typed: Typed, tmp_path: Path) -> None:
    before = typed(mavparam, "get MPC_XY_VEL_MAX")
    assert typed(mavparam, "set MPC_XY_VEL_MAX 7.5") == "7.5\n"
    assert typed(mavparam, "set NAV_RCL_ACT 1") == "1\n"
    for name in ("all.txt", "all.parm"):
        assert "Parameters received: " in typed(mavparam, f"-v dump {tmp_path / name}")
        values = parameter_formats.read((tmp_path / name).read_text(), name)
        assert (len(values) > 500, values["MPC_XY_VEL_MAX"], values["NAV_RCL_ACT"]) == (True, 7.5, 1)
    assert typed(mavparam, f"set MPC_XY_VEL_MAX {before}") == before
    assert f"Parameters transfered: {len(values)}\n" in typed(mavparam, f"-v load {tmp_path / 'all.txt'}")
    assert typed(mavparam, "get MPC_XY_VEL_MAX") == "7.5\n"
    (tmp_path / "some.parm").write_text(f"MPC_XY_VEL_MAX {before}\nNO_SUCH_NAME 1\n")
    assert typed.fails(mavparam, f"load {tmp_path / 'some.parm'}") == (
        "1 of 2 parameters were not accepted: NO_SUCH_NAME does not exist"
    )
    assert typed(mavparam, "get MPC_XY_VEL_MAX") == before
    assert "no such parameter" in typed.fails(mavparam, "get NO_SUCH_NAME")
    assert "'7,5' is not allowed" in typed.fails(mavparam, "set MPC_XY_VEL_MAX 7,5")
    assert "No such file" in typed.fails(mavparam, f"load {tmp_path / 'none'}")


def test_mavros_s_programs_carry_missions(stack: Stack, typed: Typed, tmp_path: Path) -> None:
    takeoff = PlanItem(22, 3, (0.0, 0.0, 0.0, math.nan), DATUM[0], DATUM[1], 10.0)
    points = [PlanItem(16, 3, (float(i), 0.0, 0.0, 0.0), DATUM[0] + i * 1e-4, DATUM[1], 10.0) for i in (1, 2)]
    rows = [Row(item, i == 0) for i, item in enumerate((takeoff, *points))]
    mine, theirs = tmp_path / "mine.waypoints", tmp_path / "theirs.waypoints"
    mine.write_text(waypoint_file.write(rows))
    assert typed(mavwp, f"-v load {mine}") == "Waypoints transfered: 3\n"
    typed(mavwp, f"dump {theirs}")
    found = waypoint_file.read(theirs.read_text(), "theirs")
    assert [row.item.command for row in found] == [22, 16, 16]
    assert [row.item.x for row in found] == pytest.approx([row.item.x for row in rows], abs=1e-7)
    assert typed(mavwp, "-v set 2") == "Command ACK: 0\nSet current done.\n"
    assert "WAYPOINT (16)" in typed(mavwp, "show")
    assert len(typed(mavwp, "show -p").splitlines()) == 7  # names, three items, three rules
    assert typed(mavwp, f"-v load -p {mine}").startswith("Home: latitude 47.39")
    assert "has not accepted the mission" in typed.fails(mavwp, f"load -s 1 {mine}")
    assert typed(mavwp, "-v clear").endswith("Waypoints cleared\n")
    assert typed(mavwp, "-v pull") == "Waypoints received: 0\n"


def test_mavros_s_programs_command(stack: Stack, typed: Typed, monkeypatch: pytest.MonkeyPatch) -> None:
    assert typed(mavsys, "--wait mode -c auto.loiter") == "Mode changed.\n"
    assert "mode AUTO.NOWHERE is unknown to MAVROS" in typed.fails(mavsys, "mode -c auto.nowhere")
    assert typed(mavsys, "rate --position 5 --stream-id 10 5") == ""
    assert typed(mavsys, "-v message_interval --id 32 --rate 0") == "Command ACK: 0\n"
    assert "a value is not allowed" in typed.fails(mavsys, "rate --all 70000")
    assert typed(mavcmd, "-v long 511 32 0 0 0 0 0 0") == "Command ACK: 0\n"
    assert "MAV_RESULT 3 (unsupported)" in typed.fails(mavcmd, "long 31000 0 0 0 0 0 0 0")
    assert typed(mavcmd, "-v sethome -c 0 0 0") == "Command ACK: 0\n"
    assert typed(mavsafety, "-v arm") == "Command ACK: 0\n"
    stack.wait_state(0, armed=True)
    assert typed(mavsafety, "-v kill") == "Command ACK: 0\n"
    stack.wait_state(0, armed=False)
    monkeypatch.setattr(mavsafety, "_SUBSCRIBER_LIMIT", 0.0)
    assert "no MAVROS subscribes to it" in typed.fails(mavsafety, "safetyarea -p1 0 0 0 -p2 9 9 9")


@pytest.mark.usefixtures("unhurried")
def test_mavros_s_programs_are_found_by_their_names(stack: Stack) -> None:
    """Each is run once, all at once; one addresses a MAVROS that does not exist."""
    folder = REPOSITORY / "src/xtdrone_mavros/mavros"
    lines = {
        "mavsys": "-n iris_0/mavros message_interval --id 32 --rate 0",
        "mavcmd": "-n /iris_0/mavros long 511 32 0 0 0 0 0 0",
        "mavparam": "-n iris_0/mavros get SYS_AUTOSTART",
        "mavwp": "-n iris_0/mavros dump -",
        "mavsafety": "arm",
    }
    start = {name: [sys.executable, str(folder / name)] for name in lines} | {"mavwp": ["rosrun", "mavros", "mavwp"]}
    programs = {name: stack.start(name, [*start[name], *line.split()]) for name, line in lines.items()}
    codes = {name: program.end() for name, program in programs.items()}
    assert codes == dict.fromkeys(lines, 0) | {"mavsafety": 1}, {n: p.output for n, p in programs.items()}
    assert programs["mavparam"].output.strip().isdigit()
    assert programs["mavwp"].output.split() == ["QGC", "WPL", "120"]
    assert programs["mavsafety"].output == (
        "mavsafety: service /mavros/cmd/arming is not offered; name a MAVROS by -n: iris_0/mavros, iris_1/mavros\n"
    )


def test_taking_off_is_told_by_texts_and_states(stack: Stack, station: Station) -> None:
    texts = stack.graph.hear("/iris_1/mavros/statustext/recv", StatusText)
    stack.fly(1, HEIGHT)
    for words in ("Armed by external command", "Takeoff detected"):
        stack.wait(lambda: any(words in text.text for text in texts.messages), f"{words!r} is told")  # noqa: B023
    extended = ear(stack, "extended_state", ExtendedState)
    stack.wait(lambda: extended.last.landed_state == ExtendedState.LANDED_STATE_IN_AIR, "it is in the air")
    heartbeat = station.next("HEARTBEAT")
    while not heartbeat.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED:  # earlier messages are still in the socket
        heartbeat = station.next("HEARTBEAT")
    assert heartbeat.system_status == mavlink.MAV_STATE_ACTIVE
    assert mavutil.mode_string_v10(heartbeat) == "OFFBOARD"


def test_global_position_is_the_datum_and_the_offset(stack: Stack, flying: list[tuple[float, float, float]]) -> None:
    stack.pass_time(1.0)
    fix = ear(stack, "global_position/global", NavSatFix).last
    assert place_enu(fix.latitude, fix.longitude) == pytest.approx(flying[1][:2], abs=1.5)
    assert fix.altitude - DATUM[2] - GEOID == pytest.approx(HEIGHT, abs=1.5)
    assert ear(stack, "global_position/rel_alt", Float64).last.data == pytest.approx(HEIGHT, abs=1.0)


def test_east_is_x_north_is_y_and_left_is_positive(stack: Stack, flying: list[tuple[float, float, float]]) -> None:
    pose = ear(stack, "local_position/pose", PoseStamped)
    begin = pose.last.pose.position
    north, east = Twist(), Twist()
    east.linear.x, north.linear.y = 1.0, 1.0
    stack.graph.say("/xtdrone/iris_1/cmd_vel_enu", east)
    stack.wait(lambda: pose.last.pose.position.x > begin.x + 2.0, "it flies east")
    assert pose.last.pose.position.y == pytest.approx(begin.y, abs=0.4)
    stack.graph.say("/xtdrone/iris_1/cmd_vel_enu", north)
    stack.wait(lambda: pose.last.pose.position.y > begin.y + 2.0, "it flies north")
    # the two topics are not published at the same moment; the vehicle no longer moves east
    stack.wait(lambda: abs(stack.pose(1).position.x - pose.last.pose.position.x) < 0.7, "the truth is the same")

    left = Twist()
    left.angular.z = 0.5
    before = yaw(pose.last)
    stack.graph.say("/xtdrone/iris_1/cmd_vel_enu", left)
    stack.wait(lambda: math.remainder(yaw(pose.last) - before, math.tau) > 1.0, "it turns left")

    forward = Twist()
    forward.linear.x = 1.0
    stack.graph.say("/xtdrone/iris_1/cmd_vel_flu", forward)
    local = ear(stack, "local_position/velocity_local", TwistStamped)
    body = ear(stack, "local_position/velocity_body", TwistStamped)
    stack.pass_time(3.0)
    heading, v = yaw(pose.last), local.last.twist.linear
    assert body.last.twist.linear.x == pytest.approx(1.0, abs=0.2)
    assert body.last.twist.linear.y == pytest.approx(0.0, abs=0.2)
    assert (v.x, v.y) == pytest.approx((math.cos(heading), math.sin(heading)), abs=0.25)
    stack.command(1, "HOVER")


def test_services_fly_too(stack: Stack, flying: list[tuple[float, float, float]]) -> None:
    call = stack.graph.call
    assert call("/iris_1/mavros/cmd/set_home", CommandHome, current_gps=True).success
    assert call("/iris_1/mavros/set_mode", SetMode, custom_mode="AUTO.LOITER").mode_sent
    stack.wait_state(1, mode="AUTO.LOITER")
    land = call("/iris_1/mavros/cmd/land", CommandTOL)
    assert (land.success, land.result) == (True, mavlink.MAV_RESULT_ACCEPTED)
    stack.wait_state(1, mode="AUTO.LAND")
    stack.wait_landed(1)
    extended = ear(stack, "extended_state", ExtendedState)
    stack.wait(lambda: extended.last.landed_state == ExtendedState.LANDED_STATE_ON_GROUND, "it has landed")

    stack.graph.call("/iris_1/mavros/set_mode", SetMode, custom_mode="AUTO.TAKEOFF")
    arm = call("/iris_1/mavros/cmd/arming", CommandBool, value=True)
    assert (arm.success, arm.result) == (True, mavlink.MAV_RESULT_ACCEPTED)
    stack.wait(lambda: stack.height(1) > 1.0, "it takes off")
    stack.wait_state(1, mode="AUTO.LOITER")
    # as a real PX4: it accepts the altitude NAV_MC_ALT_RAD (0.8 m) below MIS_TAKEOFF_ALT (2.5 m), and stays there
    assert stack.height(1) == pytest.approx(1.7, abs=0.4)


def test_commands_land_both(stack: Stack) -> None:
    for i in range(2):
        stack.command(i, "AUTO.LAND")
    for i in range(2):
        stack.wait_landed(i, sim=60.0)


# ---- the end


def test_a_dead_part_ends_the_launch_and_leaves_nothing(stack: Stack, graph: Graph) -> None:
    """MAVROS is required: without it roslaunch shuts the simulator down in order, and a participant ends by itself."""
    import rosgraph

    os.kill(stack.pid("mavros_node.py"), signal.SIGKILL)
    launch, communication = stack.programs["roslaunch"], stack.programs["communication"]
    launch.end()
    assert "REQUIRED process [mavros" in launch.output
    assert "exit code -9" in launch.output
    assert "SIGKILL" not in launch.output  # no other node was killed
    assert communication.end() == 0
    assert "the simulation has ended" in communication.output
    poll(lambda: not stack.processes(), "all processes of the launch have ended")
    assert not rosgraph.Master("/system_tests").hasParam("/lockstep/uri")
