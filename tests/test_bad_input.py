"""Bad input from users to the running system: clear messages, and the vehicles fly on.

One system of two vehicles serves all tests of this file, which run in file order: before takeoff,
in flight, and at last its nodes are killed one after the other.
"""

from __future__ import annotations

import math
import os
import random
import socket
import struct
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from conftest import FLEET, REPOSITORY, START_LIMIT, WALL_LIMIT, Graph, Program, Stack, poll, wait_for_ports

pytest.importorskip("rospy")

from geometry_msgs.msg import Pose, PoseStamped, Twist, TwistStamped
from mavros_msgs.msg import AttitudeTarget, PositionTarget, State
from mavros_msgs.srv import CommandBool, CommandLong, CommandTOL, SetMode
from pymavlink import mavutil
from pymavlink.dialects.v20 import common as mavlink
from std_msgs.msg import String

OFFBOARD_PORT, GCS_PORT = 34580, 18570
HEIGHT = 4.0  # m
NAN, INF = math.nan, math.inf
SINK_LIMIT = 1.0  # m/s; failsafe and landing descend at MPC_LAND_SPEED, 0.7 m/s
TILT_LIMIT = math.radians(20.0)

POSITION = 0b110111111000  # SET_POSITION_TARGET_LOCAL_NED.type_mask: position only
VELOCITY = 0b110111000111
YAW = 0b101111111000  # position and yaw

PROGRAMS = {
    "simulator": ("xtdrone_sim/nodes/simulator.py",),
    "mavros": ("xtdrone_mavros/nodes/mavros_node.py",),
    "communication": ("xtdrone_control/nodes/multirotor_communication.py", "iris", "0"),
    "leader": ("xtdrone_coordination/nodes/leader.py", "iris", "6"),
    "follower": ("xtdrone_coordination/nodes/follower.py", "iris", "1", "6"),
    "follower_consensus": ("xtdrone_coordination/nodes/follower_consensus.py", "iris", "1", "6", "vel"),
    "avoid": ("xtdrone_coordination/nodes/avoid.py", "iris", "6", "vel"),
    "director": ("xtdrone_interaction/nodes/formation_director.py",),
}


def node(*arguments: str, **environment: str) -> subprocess.Popen[str]:
    """Start a program of the workspace on its own."""
    path, *rest = arguments
    return subprocess.Popen(
        [sys.executable, str(REPOSITORY / "src" / path), *rest],
        env={**os.environ, **environment},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


def ended(process: subprocess.Popen[str]) -> tuple[int, str]:
    """Return exit status and output of a program that ends on its own."""
    try:
        output, _ = process.communicate(timeout=WALL_LIMIT)
    except subprocess.TimeoutExpired:
        process.kill()
        output, _ = process.communicate()
        pytest.fail(f"it does not end: {output}")
    return process.returncode, output


# ---- before any node runs


@pytest.fixture(scope="module")
def without_master() -> dict[str, subprocess.Popen[str]]:
    """Every program, started without a master."""
    return {name: node(*command, ROS_MASTER_URI="http://127.0.0.1:1") for name, command in PROGRAMS.items()}


@pytest.mark.parametrize("name", PROGRAMS)
def test_a_missing_master_is_reported(without_master: dict[str, subprocess.Popen[str]], name: str) -> None:
    status, output = ended(without_master[name])
    assert status == 1, output
    assert "no ROS master" in output
    assert "http://127.0.0.1:1" in output
    assert "Traceback" not in output


def _taken(port: int) -> socket.socket:
    holder = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    holder.bind(("127.0.0.1", port))
    return holder


@pytest.mark.parametrize(
    ("port", "node_name", "words"),
    [
        (GCS_PORT + 1, "simulator", "iris_1 ground-station link: UDP port 18571 cannot be bound"),
        (24540, "mavros", "iris_0: UDP port 24540 cannot be bound"),
    ],
)
def test_an_occupied_port_ends_the_launch(graph: Graph, tmp_path: Path, port: int, node_name: str, words: str) -> None:
    wait_for_ports()
    stack = Stack(graph, tmp_path)
    try:
        with _taken(port):
            launch = stack.launch("multi_vehicle.launch", f"vehicles:={FLEET}", "rows:=2", "speed:=0")
            launch.end()
        assert words in launch.output
        assert f"process[{node_name}" in launch.output
        assert "exit code 1" in launch.output
        poll(lambda: not stack.processes(), "all processes of the launch have ended")
    finally:
        stack.stop()
        graph.forget()


@pytest.fixture(scope="module")
def refused_simulators(graph: Graph) -> dict[str, subprocess.Popen[str]]:
    """Simulators with bad values, all at once; test_settings.py covers the other values."""
    values = {"type": "_fleet:=helicopter:2", "world": "_world:=mars", "speed": "_speed:=0.001"}
    return {
        name: node(PROGRAMS["simulator"][0], value, f"__name:=refused_simulator_{i}", **graph.environment)
        for i, (name, value) in enumerate(values.items())
    }


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("type", ("'helicopter'", "iris")),
        ("world", ("'mars'", "empty")),
        ("speed", ("speed: 0.001 is not allowed", "at least 0.01")),
    ],
)
def test_a_bad_value_ends_the_simulator(
    refused_simulators: dict[str, subprocess.Popen[str]], name: str, words: tuple[str, ...]
) -> None:
    status, output = ended(refused_simulators[name])
    assert status == 1, output
    for word in words:
        assert word in output
    assert "Traceback" not in output


@pytest.fixture(scope="module")
def refused_directors(graph: Graph, tmp_path_factory: pytest.TempPathFactory) -> dict[str, tuple[int, str]]:
    """Directors with bad values, all at once; their exit status and output."""
    import rospy

    folder = tmp_path_factory.mktemp("patterns")
    (folder / "size.yaml").write_text("2: {row: [[1, 0, 0], [2, 0, 0]]}")
    (folder / "number.yaml").write_text("2: {row: [[1, north, 0]]}")
    (folder / "broken.yaml").write_text("2: {row: [\n")
    (folder / "mapping.yaml").write_text("2: {row: {x: 1}}")
    values = {
        "unknown": ("_patterns:=cube,cubee",),
        "empty": ("_patterns:=cube,,",),
        "device": ("_patterns:=cloud:/dev/zero",),
        "size": ("_patterns:=row", f"_pattern_file:={folder}/size.yaml"),
        "number": ("_patterns:=row", f"_pattern_file:={folder}/number.yaml"),
        "broken": (f"_pattern_file:={folder}/broken.yaml",),
        "mapping": (f"_pattern_file:={folder}/mapping.yaml",),
        "no file": ("_pattern_file:=5",),
        "clearance": ("_clearance:=high",),
        "out": ("_out:=/proc/none",),
    }
    rospy.set_param("/xtdrone/fleet", FLEET)
    try:
        directors = {
            name: node(PROGRAMS["director"][0], *arguments, f"__name:=refused_director_{i}", **graph.environment)
            for i, (name, arguments) in enumerate(values.items())
        }
        return {name: ended(director) for name, director in directors.items()}
    finally:
        graph.forget_parameters()


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("unknown", "pattern 'cubee' is unknown for 2 vehicles; there are: origin, "),
        ("empty", "patterns: 'cube,,' is not allowed, comma-separated names"),
        ("device", "cloud /dev/zero: it is not a regular file"),
        ("size", "size.yaml: size 2 x 3, but 2 vehicles need 1 x 3"),
        ("number", "number.yaml: rows must be three numbers each"),
        ("broken", "broken.yaml is not YAML: line 2, column 1: "),
        ("mapping", "mapping.yaml: rows must be three numbers each"),
        ("no file", "pattern file 5: No such file or directory"),
        ("clearance", "clearance: 'high' is not allowed, at least 0 m"),
        ("out", "out: /proc/none: No such file or directory"),
    ],
)
def test_a_bad_value_ends_the_director_with_one_line(
    refused_directors: dict[str, tuple[int, str]], name: str, words: str
) -> None:
    status, output = refused_directors[name]
    assert status == 1, output
    assert words in output
    assert "Traceback" not in output
    assert len([line for line in output.splitlines() if line.strip()]) == 1, output


# ---- the running system


@pytest.fixture(scope="module")
def stack(graph: Graph, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Stack]:
    """Two vehicles with all nodes of a formation, each in its own process."""
    import rospy

    wait_for_ports()
    rospy.set_param("/xtdrone/fleet", FLEET)
    rospy.set_param("/use_sim_time", True)
    rospy.set_param("/lockstep/wait", True)
    stack = Stack(graph, tmp_path_factory.mktemp("bad_input"))
    try:
        stack.run("simulator", "xtdrone_sim", "simulator.py", "_rows:=2", "_speed:=0", "_participants:=4")
        stack.run("mavros", "xtdrone_mavros", "mavros_node.py")
        for i in range(2):
            stack.run(
                f"communication_{i}", "xtdrone_control", "multirotor_communication.py", "iris", str(i),
                "_cmd_timeout:=1.0", "_hover_speed:=0.001",
            )  # fmt: skip
        stack.run("leader", "xtdrone_coordination", "leader.py", "iris", "2")
        stack.wait(lambda: stack.pose(0) and stack.time > 0.0, "the simulation runs", wall=START_LIMIT)
        yield stack
    finally:
        stack.stop()


class Gcs:
    """An independent ground station on one of a vehicle's ports."""

    def __init__(self, stack: Stack, port: int, target: int) -> None:
        self._stack = stack
        self.target = target
        self.link = mavutil.mavlink_connection(f"udpout:127.0.0.1:{port}", source_system=255, dialect="common")
        self.link.mav.heartbeat_send(mavlink.MAV_TYPE_GCS, mavlink.MAV_AUTOPILOT_INVALID, 0, 0, 0)

    def command(self, number: int, *params: float) -> Any:
        """Send COMMAND_LONG and return its ack's result."""
        values = (*params, *(0.0,) * (7 - len(params)))
        self.drain()
        self.link.mav.command_long_send(self.target, 1, number, 0, *values)
        return self.ack(number)

    def drain(self) -> None:
        """Read pending datagrams: a socket that telemetry has filled at full speed has no room for an answer."""
        for _ in range(2000):  # more than the buffer holds
            if self.link.recv_match() is None:
                return

    def ack(self, number: int) -> int:
        def acknowledged() -> bool:
            found = self.link.recv_match(type="COMMAND_ACK", blocking=True, timeout=WALL_LIMIT)
            assert found is not None, f"no ack for command {number}"
            return found.command == number and self._keep(found)

        while not acknowledged():
            pass
        return self._last.result

    def _keep(self, message: Any) -> bool:
        self._last = message
        return True

    def close(self) -> None:
        self.link.close()


@pytest.fixture
def gcs(stack: Stack) -> Iterator[Callable[[int], Gcs]]:
    """Return a function that opens a ground station on a vehicle's GCS port."""
    opened = []

    def open_one(index: int) -> Gcs:
        opened.append(Gcs(stack, GCS_PORT + index, index + 1))
        return opened[-1]

    yield open_one
    for entry in opened:
        entry.close()


@pytest.fixture
def flying(stack: Stack) -> list[tuple[float, float, float]]:
    """Two vehicles that hold their positions in OFFBOARD; return the positions, m ENU."""
    places = [stack.fly(i, HEIGHT) for i in range(2)]
    stack.safety.reset()
    return places


def check_undisturbed(stack: Stack, places: list[tuple[float, float, float]], seconds: float = 2.0) -> None:
    """Check that both vehicles hold their positions."""
    stack.pass_time(seconds)
    for i, place in enumerate(places):
        assert stack.settled(i, place), (i, place, stack.pose(i))
        assert stack.state(i).mode == "OFFBOARD"
        assert stack.state(i).armed
    check_safe(stack)


def check_safe(stack: Stack) -> None:
    for name in stack.safety.names:
        assert stack.safety.sink[name] < SINK_LIMIT, (name, stack.safety.sink)
        assert stack.safety.tilt[name] < TILT_LIMIT, (name, stack.safety.tilt)


# ---- on the ground


@pytest.fixture(scope="module")
def refused(stack: Stack) -> dict[str, subprocess.Popen[str]]:
    """Programs with bad values, started beside the running system."""
    simulator, mavros = PROGRAMS["simulator"][0], PROGRAMS["mavros"][0]
    communication, leader = PROGRAMS["communication"][0], PROGRAMS["leader"][0]
    wrong_size = stack.folder / "size.yaml"
    wrong_size.write_text("2:\n  mine: [[1, 0, 0], [2, 0, 0]]\n")
    commands = {
        "second simulator": (simulator,),
        "mavros too many": (mavros, "_fleet:=iris:10000"),
        "mavros's port": (mavros,),
        "communication type": (communication, "helicopter", "0"),
        "communication id": (communication, "iris", "2"),
        "leader number": (leader, "iris", "10000"),
        "pattern size": (leader, "iris", "2", f"_patterns:={wrong_size}"),
    }
    environment = stack.graph.environment
    return {
        name: node(*command, f"__name:=refused_{i}", **environment)
        for i, (name, command) in enumerate(commands.items())
    }


@pytest.mark.parametrize(
    ("name", "status", "words"),
    [
        ("second simulator", 1, ("a simulator is already running on the ROS master", "rosnode kill /simulator")),
        ("mavros too many", 1, ("10000 of type 'iris'", "1 to 250")),
        ("mavros's port", 1, ("iris_0", "UDP port 24540")),
        ("communication type", 2, ("'helicopter'", "iris")),
        ("communication id", 2, ("2 is out of range, 0 to 1",)),
        ("leader number", 2, ("'10000' is not allowed, 1 to 250",)),
        ("pattern size", 2, ("pattern 'mine'", "size 2 x 3", "1 x 3")),
    ],
)
def test_a_bad_value_is_rejected_beside_a_running_system(
    stack: Stack, refused: dict[str, subprocess.Popen[str]], name: str, status: int, words: tuple[str, ...]
) -> None:
    code, output = ended(refused[name])
    assert code == status, output
    for word in words:
        assert word in output
    assert "Traceback" not in output
    assert all(program.alive for program in stack.programs.values())


def test_an_unknown_mode_is_rejected_by_the_service(stack: Stack) -> None:
    answer = stack.graph.call("/iris_0/mavros/set_mode", SetMode, custom_mode="OFFBORD")
    assert not answer.mode_sent
    stack.log_has("mavros", "mode 'OFFBORD' is not known; allowed are", "OFFBOARD", "AUTO.LAND")


def test_an_unknown_command_is_rejected_with_what_is_allowed(stack: Stack) -> None:
    stack.command(0, "FLY")
    stack.log_has("communication_0", "FLY refused by mavros/set_mode", "no command (ARM, DISARM, HOVER)", "AUTO.LAND")


def test_an_unsupported_mode_is_rejected(stack: Stack) -> None:
    stack.command(0, "AUTO.RTGS")
    stack.log_has("mavros", "iris_0: FCU: Unsupported auto mode", "the autopilot refused AUTO.RTGS, result 1")
    stack.wait_state(0, mode="AUTO.LOITER")


def test_unknown_patterns_and_invalid_steering_are_rejected_by_the_leader(stack: Stack) -> None:
    stack.graph.say("/xtdrone/leader/cmd", String(data="star"))
    stack.log_has("leader", "'star' is not a pattern of 2 vehicles (", "cube")
    for name in ("cloud:/etc/passwd", "cloud:/dev/zero", "text:A:font=/etc/shadow"):
        stack.graph.say("/xtdrone/leader/cmd", String(data=name))
        stack.log_has("leader", f"{name.rpartition(':')[2].removeprefix('font=')}: no file may be read")
    assert "root:" not in stack.programs["leader"].output
    broken = Twist()
    broken.linear.x = NAN
    stack.graph.say("/xtdrone/leader/cmd_vel_flu", broken)
    stack.log_has("communication_0", "cmd_vel_flu: linear.x is nan; message ignored")


def test_arming_in_offboard_requires_a_setpoint_stream(stack: Stack, gcs: Callable[[int], Gcs]) -> None:
    """A stream exists here, so the test requests a mode that does not allow arming; only an event has the reason."""
    station = gcs(1)
    assert station.command(mavlink.MAV_CMD_DO_SET_MODE, 1.0, 4.0, 6.0) == mavlink.MAV_RESULT_ACCEPTED  # AUTO.LAND
    assert station.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1.0) == mavlink.MAV_RESULT_TEMPORARILY_REJECTED
    stack.wait_state(1, mode="AUTO.LAND")
    answer = stack.graph.call("/iris_1/mavros/cmd/arming", CommandBool, value=True)
    assert (answer.success, answer.result) == (False, mavlink.MAV_RESULT_TEMPORARILY_REJECTED)
    stack.log_has("mavros", "iris_1: FCU: Arming denied: Mode not suitable for arming")
    arm = mavlink.MAV_CMD_COMPONENT_ARM_DISARM
    station.link.mav.command_long_send(2, 1, arm, 0, 2.0, *(0.0,) * 6)  # neither arm nor disarm: PX4 does not reply
    stack.log_has("mavros", "iris_1: FCU: Unsupported ARM_DISARM param: 2.000")
    assert station.command(mavlink.MAV_CMD_DO_SET_MODE, 1.0, 4.0, 3.0) == mavlink.MAV_RESULT_ACCEPTED  # AUTO.LOITER


def test_unknown_commands_are_answered(stack: Stack, gcs: Callable[[int], Gcs]) -> None:
    station = gcs(1)
    assert station.command(31010) == mavlink.MAV_RESULT_UNSUPPORTED
    answer = stack.graph.call("/iris_1/mavros/cmd/command", CommandLong, command=31010)
    assert (answer.success, answer.result) == (False, mavlink.MAV_RESULT_UNSUPPORTED)
    answer = stack.graph.call("/iris_1/mavros/cmd/takeoff", CommandTOL, altitude=INF, latitude=47.4, longitude=8.5)
    assert (answer.success, answer.result) == (False, mavlink.MAV_RESULT_DENIED)


# ---- in flight


def test_arming_twice_changes_nothing_and_disarming_in_the_air_is_rejected(
    stack: Stack, flying: list[tuple[float, float, float]], gcs: Callable[[int], Gcs]
) -> None:
    station = gcs(0)
    assert station.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1.0) == mavlink.MAV_RESULT_ACCEPTED
    assert station.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 0.0) == mavlink.MAV_RESULT_TEMPORARILY_REJECTED
    answer = stack.graph.call("/iris_0/mavros/cmd/arming", CommandBool, value=False)
    assert (answer.success, answer.result) == (False, mavlink.MAV_RESULT_TEMPORARILY_REJECTED)
    stack.log_has("mavros", "iris_0: FCU: Disarming denied! Not landed")
    stack.command(0, "DISARM")
    stack.log_has("communication_0", "DISARM refused by mavros/cmd/arming (MAV_RESULT 1)")
    check_undisturbed(stack, flying)


def _with(message: Any, field: str, value: float) -> Any:
    *path, name = field.split(".")
    target = message
    for part in path:
        target = getattr(target, part)
    setattr(target, name, value)
    return message


def _target(mask: int, field: str, value: float) -> PositionTarget:
    return _with(PositionTarget(coordinate_frame=1, type_mask=mask), field, value)


def _broken_topics() -> dict[str, tuple[Any, str, str]]:
    """Return topic to message, the program that must report it, and its text."""
    attitude = AttitudeTarget(type_mask=AttitudeTarget.IGNORE_ATTITUDE, thrust=0.5)
    return {
        "/iris_0/mavros/setpoint_raw/local": (_target(POSITION, "position.y", NAN), "mavros", "position.y is nan"),
        "/iris_1/mavros/setpoint_raw/local": (_target(VELOCITY, "velocity.z", -INF), "mavros", "velocity.z is -inf"),
        "/iris_0/mavros/setpoint_raw/attitude": (_with(attitude, "body_rate.x", NAN), "mavros", "body_rate.x is nan"),
        "/iris_0/mavros/setpoint_position/local": (
            _with(PoseStamped(), "pose.position.z", INF), "mavros", "pose.position.z is inf"),
        "/iris_0/mavros/setpoint_velocity/cmd_vel": (
            _with(TwistStamped(), "twist.linear.x", NAN), "mavros", "linear.x is nan"),
        "/iris_0/mavros/setpoint_velocity/cmd_vel_unstamped": (
            _with(Twist(), "angular.z", INF), "mavros", "angular.z is inf"),
        "/xtdrone/iris_0/cmd_vel_enu": (_with(Twist(), "linear.y", NAN), "communication_0", "linear.y is nan"),
        "/xtdrone/iris_0/cmd_vel_flu": (_with(Twist(), "angular.z", NAN), "communication_0", "angular.z is nan"),
        "/xtdrone/iris_0/cmd_accel_enu": (_with(Twist(), "linear.z", INF), "communication_0", "linear.z is inf"),
        "/xtdrone/iris_0/cmd_pose_enu": (_with(Pose(), "position.x", 1e30), "communication_0", "position.x is 1e+30"),
        "/xtdrone/iris_0/cmd_pose_flu": (
            _with(Pose(), "orientation.w", NAN), "communication_0", "orientation.w is nan"),
        "/xtdrone/leader/cmd_vel_flu": (_with(Twist(), "linear.z", -INF), "communication_0", "linear.z is -inf"),
    }  # fmt: skip


def test_non_finite_setpoints_are_rejected_on_every_topic(
    stack: Stack, flying: list[tuple[float, float, float]]
) -> None:
    sizes = {name: len(program.output) for name, program in stack.programs.items()}
    for topic, (message, _, _) in _broken_topics().items():
        stack.graph.say(topic, message)
    for topic, (_, program, words) in _broken_topics().items():
        named = "/xtdrone/iris_0/cmd_vel_flu" if "leader" in topic else topic
        stack.log_has(program, f"{named}: {words}", since=sizes[program])
    check_undisturbed(stack, flying)


@pytest.mark.parametrize("port", [OFFBOARD_PORT, GCS_PORT], ids=["offboard", "ground-station"])
def test_non_finite_setpoints_are_rejected_over_mavlink(
    stack: Stack, flying: list[tuple[float, float, float]], port: int
) -> None:
    size, told = (len(stack.programs[name].output) for name in ("simulator", "mavros"))
    station = Gcs(stack, port, 1)
    send = station.link.mav.set_position_target_local_ned_send
    for value in (NAN, INF, -INF):
        send(0, 1, 1, 1, POSITION, value, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0)
        send(0, 1, 1, 1, VELOCITY, 0, 0, 0, 0, 0, value, 0, 0, 0, 0, 0)
        send(0, 1, 1, 1, YAW, 0, 0, 0, 0, 0, 0, 0, 0, 0, value, 0)
        send(0, 1, 1, 8, VELOCITY, 0, 0, 0, value, 0, 0, 0, 0, 0, 0, 0)
        station.link.mav.set_attitude_target_send(0, 1, 1, 0, [value, 0, 0, 0], 0, 0, 0, 0.5)
        station.link.mav.set_attitude_target_send(0, 1, 1, 0, [1, 0, 0, 0], 0, 0, 0, value)
        station.link.mav.set_position_target_global_int_send(0, 1, 1, 6, POSITION, 0, 0, value, *(0,) * 8)
    send(0, 1, 1, 77, POSITION, *(0,) * 11)  # there is no such frame
    stack.log_has("simulator", "setpoint cannot be flown", "setpoint rejected: attitude has norm", since=size)
    stack.log_has("mavros", "iris_0: FCU: SET_POSITION_TARGET_LOCAL_NED coordinate frame 77 unsupported", since=told)
    check_undisturbed(stack, flying)
    station.close()


def _malformed() -> list[bytes]:
    """Return datagrams that are not MAVLink, or truncated."""
    chance = random.Random(1)
    good = mavlink.MAVLink(None, srcSystem=255, srcComponent=190)
    frame = mavlink.MAVLink_command_long_message(1, 1, 400, 0, 0, 21196, 0, 0, 0, 0, 0).pack(good)  # forced disarm
    datagrams = [b"", b"\x00", b"\xfd", b"\xfe" * 300, frame[:-1], frame[:5], frame[1:]]
    datagrams.append(frame[:-2] + bytes(b ^ 0xFF for b in frame[-2:]))  # wrong checksum
    datagrams.append(frame[:10] + b"\xff" + frame[11:])
    datagrams += [bytes(chance.randrange(256) for _ in range(chance.randrange(1, 400))) for _ in range(50)]
    datagrams += [b"\xfd" + struct.pack("B", n) + bytes(n) for n in (0, 9, 255)]
    return datagrams


def test_malformed_mavlink_and_other_systems_messages_change_nothing(
    stack: Stack, flying: list[tuple[float, float, float]]
) -> None:
    size = len(stack.programs["simulator"].output)
    poses = stack.graph.hear("/iris_0/mavros/local_position/pose", PoseStamped)
    stack.wait(lambda: poses.last, "poses come")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
        for port in (OFFBOARD_PORT, GCS_PORT):
            for datagram in _malformed():
                stranger.sendto(datagram, ("127.0.0.1", port))
    for port in (OFFBOARD_PORT, GCS_PORT):
        other = Gcs(stack, port, 7)
        other.link.mav.command_long_send(7, 1, mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 0, 0, 21196, 0, 0, 0, 0, 0)
        other.link.mav.set_position_target_local_ned_send(0, 7, 1, 1, POSITION, 99, 99, 99, *(0,) * 8)
        other.close()
    stack.log_has("simulator", "iris_0 offboard link: bad MAVLink ignored", "iris_0 ground-station link", since=size)
    stack.log_has("simulator", "message for system 7 ignored, this is system 1", since=size)
    before = len(poses.messages)
    check_undisturbed(stack, flying, 4.0)
    stamps = [message.header.stamp.to_sec() for message in poses.since(before)]
    assert len(stamps) > 60
    rate = (len(stamps) - 1) / (stamps[-1] - stamps[0])
    assert rate == pytest.approx(30.0, rel=0.1)  # MAVROS still receives the telemetry


# ---- nodes that die, in flight


def test_a_killed_leader_and_follower_leave_the_others_flying(
    stack: Stack, flying: list[tuple[float, float, float]]
) -> None:
    follower = stack.run("follower_1", "xtdrone_coordination", "follower_consensus.py", "iris", "1", "2", "vel")
    commands = stack.graph.hear("/xtdrone/iris_1/cmd_vel_enu", Twist)
    stack.graph.say("/xtdrone/leader/cmd", String(data="cube"))
    stack.wait(lambda: len(commands.messages) > 30, "the follower steers")
    follower.kill()
    stack.log_has("simulator", "follower_1")
    stack.log_has("communication_1", "no velocity or acceleration for 1.0 s: HOVER")
    stack.programs["leader"].kill()
    stack.log_has("simulator", "leader")
    stack.pass_time(4.0)  # it hovers where the follower stopped publishing, and must first fly back
    pose = stack.pose(1).position
    places = [flying[0], (pose.x, pose.y, pose.z)]
    check_undisturbed(stack, places, 3.0)


def test_arming_again_in_the_air_saves_a_vehicle(stack: Stack, flying: list[tuple[float, float, float]]) -> None:
    """A vehicle disarmed by force in the air is armed again by the same datagram, so that nothing comes between.

    PX4 too skips the checks within 5 s of a disarming in the air.
    """
    size = len(stack.programs["mavros"].output)
    packer = mavlink.MAVLink(None, srcSystem=255, srcComponent=190)
    arm = mavlink.MAV_CMD_COMPONENT_ARM_DISARM
    cut = mavlink.MAVLink_command_long_message(2, 1, arm, 0, 0, 21196, 0, 0, 0, 0, 0).pack(packer)
    again = mavlink.MAVLink_command_long_message(2, 1, arm, 0, 1, 0, 0, 0, 0, 0, 0).pack(packer)
    station = Gcs(stack, GCS_PORT + 1, 2)
    station.drain()
    station.link.write(cut + again)
    assert station.ack(arm) == mavlink.MAV_RESULT_ACCEPTED
    assert station.ack(arm) == mavlink.MAV_RESULT_ACCEPTED
    stack.log_has("mavros", "iris_1: FCU: Disarmed by", "iris_1: FCU: Armed by", since=size)
    check_undisturbed(stack, flying)
    station.close()


def test_a_setpoint_stream_that_stops_ends_in_a_soft_landing(
    stack: Stack, flying: list[tuple[float, float, float]]
) -> None:
    states = stack.graph.hear("/iris_1/mavros/state", State)
    count = len(states.messages)
    stack.programs["communication_1"].kill()
    stack.log_has("simulator", "communication_1")
    # The failsafe's mode may last less than half a wall second, so every message counts and not only the latest.
    stack.wait(lambda: any(state.mode == "POSCTL" for state in states.since(count)), "iris_1 was in POSCTL", sim=INF)
    stack.log_has("mavros", "iris_1: FCU: Failsafe activated", "Failsafe: position control: No offboard signal")
    stack.wait_landed(1)
    assert stack.settled(1, (flying[1][0], flying[1][1], 0.1), 1.0)
    check_safe(stack)
    assert stack.settled(0, flying[0])
    assert stack.state(0).mode == "OFFBOARD"


def test_a_killed_mavros_ends_in_a_soft_landing(stack: Stack) -> None:
    place = stack.fly(0, HEIGHT)
    stack.safety.reset()
    station = Gcs(stack, GCS_PORT, 1)
    stack.programs["mavros"].kill()
    stack.log_has("simulator", "mavros")
    stack.wait(lambda: stack.height(0) < 0.15, "iris_0 has landed")
    stack.pass_time(5.0)
    while True:
        heartbeat = station.link.recv_match(type="HEARTBEAT", blocking=True, timeout=WALL_LIMIT)
        assert heartbeat is not None
        if not heartbeat.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED:
            break
    check_safe(stack)
    assert stack.settled(0, (place[0], place[1], 0.1), 1.0)
    assert stack.programs["communication_0"].alive
    station.close()


def test_a_killed_simulator_ends_all_others(stack: Stack) -> None:
    back = stack.run("mavros", "xtdrone_mavros", "mavros_node.py")
    states = stack.graph.hear("/iris_0/mavros/state", State)
    count = len(states.messages)
    # simulated time runs fast while the program starts
    stack.wait(lambda: any(s.connected for s in states.since(count)), "mavros is back", sim=INF)
    stack.programs["simulator"].kill()
    for program in (back, stack.programs["communication_0"]):
        check_ended_without_simulator(program)


def check_ended_without_simulator(program: Program) -> None:
    status = program.end()
    assert "the simulator at tcp://" in program.output
    assert "is gone" in program.output
    assert status == 1
    assert "Traceback" not in program.output
