"""The simplified simulator on the ROS graph: flights as the full one flies them, services, reset, repeatability."""

from __future__ import annotations

import json
import math
import signal
import sys
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import START_LIMIT, Ear, Graph, Stack, poll

pytest.importorskip("rospy")

import rosgraph
import rospy
import swarm_script
from gazebo_msgs.msg import ModelStates
from geometry_msgs.msg import PoseStamped, Twist, TwistStamped, Vector3
from mavros_msgs.msg import ExtendedState, PositionTarget, State
from mavros_msgs.srv import CommandBool, CommandTOL, SetMode
from nav_msgs.msg import Odometry
from std_msgs.msg import Float64MultiArray, String
from std_srvs.srv import Empty, Trigger

from xtdrone_swarm.simplified.simplified_node import main, read_settings
from xtdrone_swarm.swarm import Swarm

FLIGHT_LIMIT = 300.0  # s of wall time


def start(graph: Graph, folder: Path, count: int, *parameters: str) -> Stack:
    """Start the simulator alone and wait for it; messages of another one's vehicles are discarded."""
    graph.forget()
    stack = Stack(graph, folder, f"iris:{count}")
    stack.run("simulator", "xtdrone_swarm", "simplified_simulator", "iris", str(count), *parameters)
    poll(
        lambda: rosgraph.Master("/system_tests").hasParam("/lockstep/uri"),
        "the simulator offers its lockstep",
        START_LIMIT,
    )
    return stack


# ---- the formation flight


def fly(graph: Graph, folder: Path, *arguments: str) -> list[dict[str, Any]]:
    """Fly the formation flight of four vehicles to its end; return its events."""
    folder.mkdir()
    stack = Stack(graph, folder, "iris:4")
    try:
        launch = stack.launch(
            "formation.launch", "simulator:=simplified", "n:=4", "patterns:=cube", "processes:=shared", "speed:=0",
            f"out:={folder}", "bag:=none", f"digest:={folder}/digest", *arguments,
        )  # fmt: skip
        launch.end(FLIGHT_LIMIT)
        events = [json.loads(line) for line in (folder / "events.jsonl").read_text().splitlines()]
        assert (events[-1]["event"], events[-1]["unsettled"]) == ("done", [])
        return events
    finally:
        stack.stop()
        graph.forget()


def digests(folder: Path, until_us: int) -> dict[tuple[str, int], Any]:
    """Return each participant's digest of each second."""
    lines = [json.loads(line) for line in (folder / "digest").read_text().splitlines()]
    return {(line["name"], line["time"]): line["topics"] for line in lines if line["time"] <= until_us}


@pytest.mark.timeout(2 * FLIGHT_LIMIT + 60.0)
def test_the_formation_flight_is_flown_and_is_the_same_again(graph: Graph, tmp_path: Path) -> None:
    folders = [tmp_path / "first", tmp_path / "second"]
    events = [fly(graph, folder, "communication:=true") for folder in folders]
    end_us = int(events[0][-1]["time"] * 1e6)
    first, second = (digests(folder, end_us) for folder in folders)
    assert len({name for name, _ in first}) == 5
    assert first == second


@pytest.mark.timeout(FLIGHT_LIMIT + 60.0)
def test_the_formation_flight_needs_no_communication_nodes(graph: Graph, tmp_path: Path) -> None:
    """That it is the same again follows from the test below: it equals a computation without ROS."""
    folder = tmp_path / "flight"
    end_us = int(fly(graph, folder, "communication:=false")[-1]["time"] * 1e6)
    assert len({name for name, _ in digests(folder, end_us)}) == 4


@pytest.mark.timeout(2 * START_LIMIT + 60.0)
def test_it_is_the_flight_of_the_swarm_without_ros_to_the_last_bit(graph: Graph, tmp_path: Path) -> None:
    count = 5
    stack = start(graph, tmp_path, count, "_airborne:=true", "_hover_speed:=0.001", "_speed:=0", "_participants:=3")
    try:
        graph_master = rosgraph.Master("/system_tests")
        graph_master.setParam("/xtdrone/swarm_topic", "/xtdrone/swarm")
        stack.run("leader", "xtdrone_coordination", "leader.py", "iris", str(count))
        stack.run("followers", "xtdrone_coordination", "follower_consensus.py", "iris", "all", str(count), "vel")
        file = tmp_path / "positions.npy"
        script = str(Path(__file__).with_name("swarm_script.py"))
        stack.start("script", [sys.executable, script, str(file), "__name:=script"])
        done = graph.hear("/script/done", String)
        poll(lambda: done.last, "the script is over", START_LIMIT)
    finally:
        stack.stop()
        graph_master.deleteParam("/xtdrone/swarm_topic")
    flown = np.load(file)
    assert flown.shape == (swarm_script.TURNS, count, 3)
    np.testing.assert_array_equal(flown, scripted(count))


def scripted(count: int) -> np.ndarray:
    """Fly the script without ROS: messages of one turn are received in the next.

    The simulator's first tick, at 20 ms, comes before the first turn of a swarm, and nothing happens in it.
    """
    swarm = Swarm(count, record=False)
    rows = [swarm.positions.copy()]
    for turn in range(2, swarm_script.TURNS + 1):
        said = turn - 1
        if said in swarm_script.PATTERNS:
            swarm.choose(swarm_script.PATTERNS[said])
        if said == swarm_script.STEERED.start:
            swarm.steer(*swarm_script.COURSE)
        elif said == swarm_script.STEERED.stop:
            swarm.steer((0.0, 0.0, 0.0))
        swarm.step()
        rows.append(swarm.positions.copy())
    assert np.ptp(np.array(rows), axis=0).max() > 1.0
    return np.array(rows)


# ---- bad values


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        (["iris"], "2 arguments are needed"),
        (["plane", "3"], "'plane' is no multirotor"),
        (["iris", "0"], "1 to 250"),
        (["iris", "251"], "1 to 250"),
    ],
)
def test_invalid_arguments_are_reported(
    arguments: list[str], word: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["simplified_simulator", *arguments])
    assert main() == 2
    assert word in capsys.readouterr().err


@pytest.mark.parametrize(
    ("name", "value", "word"),
    [
        ("model", "third-order", "third-order"),
        ("order", 3, "from 0 to 2"),
        ("places", [[0, 0, 0]], "3 places"),
        ("places", "here", "3 places"),
        ("setpoint_timeout", -1.0, "setpoint_timeout"),
    ],
)
def test_invalid_parameters_are_reported(graph: Graph, name: str, value: Any, word: str) -> None:
    rospy.set_param(f"~{name}", value)
    try:
        with pytest.raises(ValueError, match=word):
            read_settings("iris", 3)
    finally:
        rospy.delete_param(f"~{name}")


def test_a_bad_parameter_ends_the_node(graph: Graph, tmp_path: Path) -> None:
    graph.forget_parameters()
    stack = Stack(graph, tmp_path, "iris:3")
    program = stack.run("simulator", "xtdrone_swarm", "simplified_simulator", "iris", "3", "_hover_speed:=-1.0")
    assert program.end() == 1
    assert "hover_speed" in program.output


def test_a_vehicle_whose_communication_node_dies_holds(graph: Graph, tmp_path: Path) -> None:
    """Its last velocity must not last for ever: PX4 leaves OFFBOARD after a second, and so does this simulator."""
    parameters = ["_airborne:=true", "_speed:=0", "_participants:=communication"]
    stack = start(graph, tmp_path, 2, *parameters)
    try:
        stack.run("communication", "xtdrone_control", "multirotor_communication.py", "iris", "all")

        def flies() -> bool:
            """Send the command repeatedly: the simulator subscribes too, and may be the first to be connected."""
            graph.say("/xtdrone/iris_1/cmd_vel_enu", Twist(linear=Vector3(x=2.0)))
            return bool(pose_of(stack, 1).last) and place(stack, 1)[0] > 10.0

        stack.wait(flies, "iris_1 flies east")
        stack.wait_state(1, mode="OFFBOARD", armed=True)
        stack.programs["communication"].kill()
        stack.wait_state(1, mode="POSCTL", armed=True)
        assert "iris_1: no setpoint for 1 s: POSCTL" in stack.programs["simulator"].output
        stack.pass_time(5.0)
        before = place(stack, 1)
        stack.pass_time(5.0)
        assert math.dist(place(stack, 1), before) < 0.05
    finally:
        stack.stop()


# ---- one simulator, by hand


@pytest.fixture(scope="module")
def stack(graph: Graph, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Stack]:
    # Tests send a setpoint once: its rate depends on wall time.
    stack = start(graph, tmp_path_factory.mktemp("simplified"), 3, "_speed:=10", "_setpoint_timeout:=0")
    try:
        for index in range(3):
            pose = pose_of(stack, index)
            stack.wait(lambda pose=pose: pose.last, f"iris_{index} says where it is")
        yield stack
    finally:
        stack.stop()


def place(stack: Stack, index: int) -> tuple[float, float, float]:
    p = pose_of(stack, index).last.pose.position
    return p.x, p.y, p.z


def pose_of(stack: Stack, index: int) -> Ear:
    return stack.graph.hear(f"/iris_{index}/mavros/local_position/pose", PoseStamped)


def test_topics_are_mavros_ones(stack: Stack) -> None:
    pose = pose_of(stack, 1)
    velocity = stack.graph.hear("/iris_1/mavros/local_position/velocity_local", TwistStamped)
    state = stack.graph.hear("/iris_1/mavros/state", State)
    extended = stack.graph.hear("/iris_1/mavros/extended_state", ExtendedState)
    swarm = stack.graph.hear("/xtdrone/swarm", Float64MultiArray)
    states = stack.graph.hear("/gazebo/model_states", ModelStates)
    truth = stack.graph.hear("/xtdrone/iris_1/ground_truth/odom", Odometry)
    stack.wait(
        lambda: (
            len(pose.messages) > 62
            and len(state.messages) > 1
            and all(ear.last for ear in (velocity, extended, swarm, states, truth))
        ),
        "all topics come",
    )
    stamps = [message.header.stamp.to_nsec() // 1000 for message in pose.messages[1:]]  # except for the first tick
    assert 1.99 < (stamps[60] - stamps[0]) * 1e-6 < 2.01  # 30 Hz
    assert all(stamp % 4000 == 0 for stamp in stamps)
    assert (pose.last.header.frame_id, velocity.last.header.frame_id) == ("map", "base_link")
    assert (state.last.mode, state.last.armed, state.last.connected) == ("AUTO.LOITER", False, True)
    assert extended.last.landed_state == ExtendedState.LANDED_STATE_ON_GROUND
    assert len(swarm.last.data) == 18
    assert states.last.name == ["ground_plane", "iris_0", "iris_1", "iris_2"]
    assert (truth.last.header.frame_id, truth.last.child_frame_id) == ("map", "iris_1/base_link")
    assert truth.last.header.stamp.to_nsec() % 20_000_000 == 0  # 50 Hz
    assert truth.last.pose.pose in [message.pose[2] for message in states.messages]


def test_services_takeoff_and_land(stack: Stack) -> None:
    assert stack.graph.call("/iris_0/mavros/cmd/takeoff", CommandTOL).success
    assert stack.graph.call("/iris_0/mavros/cmd/arming", CommandBool, value=True).success
    stack.wait_state(0, mode="AUTO.LOITER", armed=True)
    stack.wait(lambda: place(stack, 0)[2] > 2.0, "iris_0 is up")
    refused = stack.graph.call("/iris_0/mavros/cmd/arming", CommandBool, value=False)
    assert (refused.success, refused.result) == (False, 1)
    assert not stack.graph.call("/iris_0/mavros/set_mode", SetMode, custom_mode="NO_MODE").mode_sent
    assert stack.graph.call("/iris_0/mavros/set_mode", SetMode, custom_mode="AUTO.LAND").mode_sent
    stack.wait_landed(0)


def test_commands_of_free_riders_are_flown(stack: Stack) -> None:
    assert stack.fly(1, 4.0)[2] == 4.0  # cmd_pose_enu, OFFBOARD and ARM
    stack.command(1, "AUTO.LAND")
    stack.wait_landed(1)


def test_setpoints_precede_commands_and_unsupported_ones_are_reported(stack: Stack) -> None:
    target = PositionTarget(coordinate_frame=PositionTarget.FRAME_LOCAL_OFFSET_NED, type_mask=0b100111111000)
    topic = "/iris_2/mavros/setpoint_raw/local"
    stack.graph.say(topic, target)
    log = stack.programs["simulator"]
    poll(lambda: "coordinate_frame 7 is not supported" in log.output, "the frame is refused")
    target.coordinate_frame = 0  # left unset
    target.position.x, target.position.y, target.position.z = 5.0, 6.0, 7.0
    target.yaw = 1.0
    target.type_mask = 0b100111111000
    stack.graph.say(topic, target)
    stack.graph.call("/iris_2/mavros/set_mode", SetMode, custom_mode="OFFBOARD")
    stack.command(2, "AUTO.LAND")  # without effect: the vehicle has setpoints
    stack.graph.call("/iris_2/mavros/cmd/arming", CommandBool, value=True)
    stack.wait(lambda: math.dist(place(stack, 2), (5.0, 6.0, 7.0)) < 0.2, "iris_2 is at its setpoint")
    stack.wait_state(2, mode="OFFBOARD", armed=True)
    assert "coordinate_frame is 0, unset; it counts as 1 (LOCAL_NED)" in log.output
    q = pose_of(stack, 2).last.pose.orientation
    assert 2.0 * math.atan2(q.z, q.w) == pytest.approx(1.0, abs=0.02)


def test_pause_and_reset(stack: Stack) -> None:
    assert stack.graph.call("/simulator/pause", Trigger).success
    before = stack.graph.call("/simulator/get_status", _status()).status.sim_time
    stack.graph.call("/gazebo/reset_simulation", Empty)
    assert stack.graph.call("/simulator/get_status", _status()).status.sim_time.to_sec() == 0.0 < before.to_sec()
    assert stack.graph.call("/simulator/resume", Trigger).success
    poses = pose_of(stack, 2)

    def goes_back() -> bool:
        stamps = [message.header.stamp for message in poses.messages]
        return any(later < earlier for earlier, later in pairwise(stamps))

    poll(goes_back, "poses come from the beginning")
    assert place(stack, 2) == (0.0, 6.0, 0.0)
    stack.wait_state(2, mode="AUTO.LOITER", armed=False)


def _status() -> type:
    from xtdrone_msgs.srv import GetStatus

    return GetStatus


def test_a_second_one_is_rejected_and_the_first_completes(stack: Stack) -> None:
    second = stack.run("second", "xtdrone_swarm", "simplified_simulator", "iris", "3")
    assert second.end() == 1
    assert "a simulator is already running" in second.output
    first = stack.programs["simulator"]
    assert first.alive
    first.process.send_signal(signal.SIGINT)
    assert first.end() == 0
    assert not rosgraph.Master("/system_tests").hasParam("/lockstep/uri")
