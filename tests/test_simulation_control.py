"""Speed, pause, step and reset of a running simulation, as its users see it.

One system serves all tests of this file, which run in file order. It has one vehicle, MAVROS, the
communication node and a participant of the tests' own, which flies the same flight after each start (meddler.py).
"""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from conftest import REPOSITORY, WALL_LIMIT, Graph, Program, Stack, poll, wait_for_ports

pytest.importorskip("rospy")

from gazebo_msgs.msg import ODEPhysics
from gazebo_msgs.srv import GetLinkState, GetPhysicsProperties, GetWorldProperties, SetPhysicsProperties
from geometry_msgs.msg import Vector3
from mavros_msgs.msg import StatusText
from mavros_msgs.srv import CommandBool, SetMode
from pymavlink import mavutil
from pymavlink.dialects.v20 import common as mavlink
from rospy import Duration, Time
from std_msgs.msg import Float64, String
from std_srvs.srv import Empty, Trigger
from xtdrone_msgs.msg import SimulationStatus
from xtdrone_msgs.srv import GetStatus, SetSpeed, Step

FLEET = "iris:1"
HEIGHT = 3.0  # m
GCS_PORT = 18570
G = 9.80665
NAMES = {"/mavros", "/communication", "/meddler"}

# a ground station that runs by wall time
STATION = f"""
import time
from pymavlink import mavutil
link = mavutil.mavlink_connection("udpout:127.0.0.1:{GCS_PORT}", source_system=255)
while True:
    link.mav.heartbeat_send(6, 8, 0, 0, 0)
    end = time.monotonic() + 0.2
    while time.monotonic() < end:
        message = link.recv_match(type="HEARTBEAT", blocking=True, timeout=0.1)
        if message:
            print("heard", flush=True)
"""


@pytest.fixture(scope="module")
def stack(graph: Graph, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Stack]:
    """The system, started paused."""
    wait_for_ports(FLEET)
    stack = Stack(graph, tmp_path_factory.mktemp("control"), FLEET)
    try:
        stack.launch(
            "multi_vehicle.launch",
            f"vehicles:={FLEET}",
            "rows:=1",
            "speed:=0",
            "participants:=3",
            "paused:=true",
            "hang_limit:=20",
        )
        poll(lambda: _has_simulator(graph), "roslaunch starts a simulator")
        stack.run("communication", "xtdrone_control", "multirotor_communication.py", "iris", "all")
        meddler = str(Path(__file__).with_name("meddler.py"))
        stack.start("meddler", [sys.executable, meddler, "__name:=meddler", "_fly:=true"])
        yield stack
    finally:
        stack.stop()


def _has_simulator(graph: Graph) -> bool:
    import rosgraph

    return bool(rosgraph.Master("/system_tests").hasParam("/lockstep/uri"))


def status(stack: Stack) -> SimulationStatus:
    return stack.graph.call("/simulator/get_status", GetStatus).status


def now(stack: Stack) -> float:
    """Return the simulator's own simulated time, s."""
    return status(stack).sim_time.to_sec()


def pause(stack: Stack) -> None:
    assert stack.graph.call("/simulator/pause", Trigger).success


def resume(stack: Stack) -> None:
    assert stack.graph.call("/simulator/resume", Trigger).success


def step(stack: Stack, **goal: Any) -> Any:
    return stack.graph.call("/simulator/step", Step, **goal)


def passes(stack: Stack, seconds: float = 1.0) -> None:
    """Wait until the simulator's own time has advanced."""
    until = now(stack) + seconds
    poll(lambda: now(stack) >= until, f"{seconds} s pass")


def meddle(stack: Stack, service: str, kind: str, **fields: Any) -> dict[str, Any]:
    """Have the participant call a service in its turn; return its report."""
    done = stack.graph.hear("/meddler/done", String)
    poll(lambda: done._subscriber.get_num_connections(), "the participant is heard")
    count = len(done.messages)
    stack.graph.say("/meddler/do", String(json.dumps({"service": service, "type": kind, "fields": fields})))
    poll(lambda: len(done.messages) > count, f"{service} is answered")
    return json.loads(done.messages[count].data)


def flight(stack: Stack, count: int) -> dict[str, Any]:
    """Return the participant's report of flight number ``count``, from 0."""
    told = stack.graph.hear("/meddler/flight", String)
    poll(lambda: len(told.messages) > count, f"flight {count} is told of")
    return json.loads(told.messages[count].data)


def sim(stack: Stack, *arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run ``xtdrone sim``."""
    command = [sys.executable, "-m", "xtdrone_interaction", "sim", *arguments]
    surroundings = {**os.environ, **stack.graph.environment, **environment}
    return subprocess.run(command, env=surroundings, capture_output=True, text=True, timeout=WALL_LIMIT, check=False)


# ---- the start


def test_it_starts_paused(stack: Stack) -> None:
    poll(lambda: status(stack).reason == "paused", "all have joined")
    found = status(stack)
    assert found.paused
    assert set(found.participants) == NAMES
    assert (found.sim_time.to_sec(), found.tick) == (0.0, 0)


def test_ticks_are_counted(stack: Stack) -> None:
    times = [step(stack, ticks=1).sim_time.to_nsec() // 1_000_000 for _ in range(4)]
    assert times == [20, 36, 40, 60]  # MAVROS at 50 Hz, the others at 30 Hz, on steps of 4 ms
    answer = step(stack, ticks=5)
    assert (answer.success, answer.ticks) == (True, 5)
    assert status(stack).tick == 9


def test_steps_to_a_time(stack: Stack) -> None:
    answer = step(stack, until=Time(0, 500_000_001))
    assert (answer.success, answer.sim_time.to_nsec()) == (True, 520_000_000)
    begin = answer.sim_time
    answer = step(stack, duration=Duration(0, 105_000_000))
    assert (answer.sim_time - begin).to_nsec() == 116_000_000  # 0.62 s is a tick, the next is at 0.636 s
    assert now(stack) == answer.sim_time.to_sec()


def test_impossible_steps_are_rejected(stack: Stack) -> None:
    for goal, words in (
        ({"until": Time(0, 1)}, "until: 0.000 s is not allowed, the simulated time is already 0.636 s"),
        ({"duration": Duration(-1, 0)}, "duration: -1 s is not allowed"),
        ({"ticks": 1, "until": Time(9, 0)}, "only one of them"),
    ):
        answer = step(stack, **goal)
        assert not answer.success
        assert words in answer.message
    assert now(stack) == 0.636


def test_the_first_flight(stack: Stack) -> None:
    resume(stack)
    assert flight(stack, 0)["height"] > 1.0


# ---- pause


def test_a_pause_holds_everything_and_everything_answers(stack: Stack) -> None:
    place = stack.fly(0, HEIGHT)
    texts = stack.graph.hear("/iris_0/mavros/statustext/recv", StatusText)
    states = stack.graph.hear("/gazebo/model_states", type(stack._states.last))
    link = mavutil.mavlink_connection(f"udpout:127.0.0.1:{GCS_PORT}", source_system=255)
    link.mav.heartbeat_send(mavlink.MAV_TYPE_GCS, mavlink.MAV_AUTOPILOT_INVALID, 0, 0, 0)
    assert link.recv_match(type="ATTITUDE", blocking=True, timeout=WALL_LIMIT) is not None
    pause(stack)
    before, said = now(stack), len(texts.messages)
    poll(lambda: stack.time == before, "what was published before the pause is heard")
    while link.recv_match() is not None:
        pass
    # three seconds of wall time, by the ground station's heartbeats; messages in transit have arrived by the first
    for beats in range(3):
        beat = link.recv_match(type="HEARTBEAT", blocking=True, timeout=WALL_LIMIT)
        assert beat.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED
        if beats == 0:
            seen = len(states.messages)
    assert link.recv_match(type="ATTITUDE", blocking=False) is None
    link.mav.param_request_read_send(1, 1, b"MPC_XY_P", -1)
    assert link.recv_match(type="PARAM_VALUE", blocking=True, timeout=WALL_LIMIT).param_id == "MPC_XY_P"
    link.close()
    assert stack.graph.call("/iris_0/mavros/set_mode", SetMode, custom_mode="OFFBOARD").mode_sent
    assert stack.graph.call("/iris_0/mavros/cmd/arming", CommandBool, value=True).success
    assert now(stack) == before
    assert len(states.messages) == seen
    resume(stack)
    passes(stack, 3.0)
    stack.wait_state(0, mode="OFFBOARD", armed=True)
    assert stack.settled(0, place)
    assert not [text for text in texts.since(said) if "ailsafe" in text.text]


def test_gazebos_services_do_the_same(stack: Stack) -> None:
    stack.graph.call("/gazebo/pause_physics", Empty)
    assert status(stack).paused
    assert stack.graph.call("/gazebo/get_physics_properties", GetPhysicsProperties).pause
    world = stack.graph.call("/gazebo/get_world_properties", GetWorldProperties)
    assert world.sim_time == pytest.approx(now(stack), abs=1e-9)
    assert world.model_names == ["ground_plane", "iris_0"]
    stack.graph.call("/gazebo/unpause_physics", Empty)
    assert not status(stack).paused


def test_the_status_reports_changes(stack: Stack) -> None:
    told = stack.graph.hear("/simulator/status", SimulationStatus)
    poll(lambda: told.last, "the status is latched")
    for change, value in ((pause, True), (resume, False)):
        count = len(told.messages)
        change(stack)
        poll(lambda: [s for s in told.since(count) if s.paused is value], "the change is told")  # noqa: B023


# ---- speed


def test_speed_is_kept(stack: Stack) -> None:
    assert stack.graph.call("/simulator/set_speed", SetSpeed, speed=0.5).success
    told = stack.graph.hear("/simulator/status", SimulationStatus)
    # the first factors still average over the time before
    count = len(told.messages)
    poll(lambda: len(told.messages) >= count + 4, "the status comes once a second")
    for found in told.since(count + 2):
        assert found.speed == 0.5
        assert 0.0 < found.measured_speed < 0.75  # 0.2 s of lag are made up for, possibly within one second
    stack.graph.say("/simulator/speed", Float64(0.0))
    poll(lambda: status(stack).speed == 0.0, "the topic sets the speed")


def physics(**changes: Any) -> dict[str, Any]:
    return {
        "time_step": 0.004,
        "max_update_rate": 0.0,
        "gravity": Vector3(0.0, 0.0, -G),
        "ode_config": ODEPhysics(),
        **changes,
    }


def test_physics_properties_set_the_speed(stack: Stack) -> None:
    call = stack.graph.call
    assert call("/gazebo/set_physics_properties", SetPhysicsProperties, **physics(max_update_rate=5000.0)).success
    assert status(stack).speed == pytest.approx(20.0)
    found = call("/gazebo/get_physics_properties", GetPhysicsProperties)
    assert (found.time_step, found.max_update_rate, found.gravity.z) == pytest.approx((0.004, 5000.0, -G))
    assert call("/gazebo/set_physics_properties", SetPhysicsProperties, **physics()).success
    assert status(stack).speed == 0.0


def test_invalid_values_are_reported(stack: Stack) -> None:
    call = stack.graph.call
    for speed in (0.009, -1.0, float("nan"), float("inf")):
        answer = call("/simulator/set_speed", SetSpeed, speed=speed)
        assert not answer.success
        assert f"speed: {speed} is not allowed, 0 (unlimited) or at least 0.01" in answer.message
    for change, words in (
        ({"time_step": 0.001}, "time_step: 0.001 s is not allowed, it is always 0.004 s"),
        ({"max_update_rate": 1.0}, "max_update_rate: 1 Hz is not allowed, 0 (unlimited) or at least 2.5 Hz"),
        ({"gravity": Vector3(0.0, 0.0, -1.62)}, "gravity: (0, 0, -1.62) m/s^2 is not allowed"),
    ):
        answer = call("/gazebo/set_physics_properties", SetPhysicsProperties, **physics(**change))
        assert not answer.success
        assert words in answer.status_message
    stack.graph.say("/simulator/speed", Float64(-3.0))
    passes(stack, 1.0)
    assert status(stack).speed == 0.0


# ---- a participant in its own turn


def test_a_participant_can_pause_in_its_turn(stack: Stack) -> None:
    told = meddle(stack, "/simulator/pause", "std_srvs/Trigger")
    assert told["before"] == told["after"]
    poll(lambda: status(stack).reason == "paused", "the tick has ended")
    assert now(stack) == told["before"]
    resume(stack)


def test_a_participant_cannot_step_in_its_turn(stack: Stack) -> None:
    told = meddle(stack, "/simulator/step", "xtdrone_msgs/Step")
    assert told["said"]["success"] == "False"
    assert "/meddler takes part in the lockstep and its turn is not over" in told["said"]["message"]
    passes(stack)


def test_the_participant_that_holds_time_is_reported(stack: Stack) -> None:
    process = stack.programs["meddler"].process
    process.send_signal(signal.SIGSTOP)
    try:
        poll(lambda: "/meddler" in status(stack).waiting_for, "the participant is waited for")
        found = status(stack)
        assert "waiting for /meddler" in found.reason
        assert stack.graph.call("/simulator/set_speed", SetSpeed, speed=0.0).success  # the pace changes at once
        poll(lambda: status(stack).waiting.to_sec() > 5.0, "it goes on")
        assert found.sim_time == status(stack).sim_time
    finally:
        process.send_signal(signal.SIGCONT)
    passes(stack)
    assert "/meddler" in status(stack).participants


# ---- others


def test_a_ground_station_that_hangs_is_no_matter(stack: Stack) -> None:
    stack.fly(0, HEIGHT)
    station = stack.start("station", [sys.executable, "-c", STATION])
    stack.log_has("station", "heard")
    station.process.send_signal(signal.SIGSTOP)
    passes(stack, 20.0)
    stack.wait_state(0, mode="OFFBOARD", armed=True)
    station.process.send_signal(signal.SIGCONT)
    heard = len(station.output)
    stack.log_has("station", "heard", since=heard)
    station.kill()


def _second(stack: Stack, name: str) -> Program:
    """Start another simulator, with a log apart from that of the node of the same name."""
    program = str(REPOSITORY / "src" / "xtdrone_sim" / "nodes" / "simulator.py")
    return stack.start(f"second_{name}", [sys.executable, program, f"__name:={name}"])


@pytest.mark.parametrize("name", ["simulator", "another"])
def test_a_second_simulator_is_rejected(stack: Stack, name: str) -> None:
    second = _second(stack, name)
    assert second.end() == 1
    assert f"a simulator is already running on the ROS master {stack.graph.uri}" in second.output
    assert "rosnode kill" in second.output
    passes(stack)
    assert set(status(stack).participants) == NAMES


def test_a_simulator_with_the_name_of_another_node_is_rejected(stack: Stack) -> None:
    import rospy

    uri = rospy.get_param("/lockstep/uri")
    rospy.delete_param("/lockstep/uri")
    try:
        second = _second(stack, "communication")
        assert second.end() == 1
    finally:
        rospy.set_param("/lockstep/uri", uri)
    assert "the node name /communication is taken" in second.output
    resume(stack)  # the system was started paused, and this test may be the first
    passes(stack)
    assert set(status(stack).participants) == NAMES


# ---- reset


def test_reset_world_puts_the_vehicle_back(stack: Stack) -> None:
    stack.fly(0, HEIGHT)
    pause(stack)
    before = now(stack)
    stack.graph.call("/gazebo/reset_world", Empty)
    assert now(stack) >= before
    assert step(stack, duration=Duration(0, 100_000_000)).success  # too short to fall
    found = stack.graph.call("/gazebo/get_link_state", GetLinkState, link_name="iris_0::base_link")
    assert found.link_state.pose.position.z < 0.2
    resume(stack)
    stack.wait_state(0, mode="AUTO.LOITER", armed=False)
    stack.pass_time(2.0)  # after the reboot, its position is valid after a second
    place = stack.fly(0, HEIGHT)
    assert place[:2] == (0.0, 3.0)


def test_reset_simulation_starts_from_nothing(stack: Stack) -> None:
    # flight 1 begins here, in the air and at full speed; flight 2 is after a reset by a participant
    stack.graph.call("/gazebo/reset_simulation", Empty)
    first, second = flight(stack, 0), flight(stack, 1)
    assert second == first  # to the last bit


def test_a_participant_can_reset_in_its_turn(stack: Stack) -> None:
    told = meddle(stack, "/gazebo/reset_simulation", "std_srvs/Empty")
    assert "error" not in told["said"]
    assert told["before"] == told["after"] > 0.0  # it sees the effect in its next turn
    assert flight(stack, 2) == flight(stack, 0)


def test_a_reset_holds_a_paused_world(stack: Stack) -> None:
    pause(stack)
    stack.graph.call("/gazebo/reset_simulation", Empty)
    assert (now(stack), status(stack).paused) == (0.0, True)
    assert stack.graph.call("/gazebo/get_world_properties", GetWorldProperties).sim_time == 0.0
    resume(stack)
    assert flight(stack, 3) == flight(stack, 0)
    stack.wait(lambda: stack.time > 10.0, "the clock goes on from 0")
    stack.wait_state(0, mode="OFFBOARD", armed=True)
    stack.command(0, "AUTO.LAND")
    stack.wait_state(0, armed=False, sim=60.0)


# ---- the command line


def test_the_command_line(stack: Stack) -> None:
    assert "paused at" in sim(stack, "pause").stdout
    found = sim(stack, "status")
    assert found.returncode == 0
    assert f"master       {stack.graph.uri}" in found.stdout
    assert "state        paused" in found.stdout
    assert "3 participants" in found.stdout
    before = now(stack)
    assert sim(stack, "step", "3").stdout.startswith("3 ticks")
    assert now(stack) > before
    sim(stack, "step", "--for", "0.5")
    assert now(stack) >= before + 0.5
    assert "speed 50 at" in sim(stack, "speed", "50").stdout
    assert "time continues" in sim(stack, "reset", "world").stdout
    assert now(stack) > before
    assert "simulated time is 0" in sim(stack, "reset").stdout
    assert now(stack) == 0.0
    assert "resumed at 0.000 s" in sim(stack, "resume").stdout
    passes(stack)


def test_the_command_line_rejects(stack: Stack) -> None:
    for arguments, words in (
        (["step", "--until", "0.001"], "until: 0.001 s is not allowed"),
        (["reset", "everything"], "name: 'everything' is not in the simulation; there are iris_0"),
    ):
        done = sim(stack, *arguments)
        assert (done.returncode, done.stdout) == (1, "")
        assert words in done.stderr
    for arguments, words in (
        (["speed", "0.001"], "FACTOR: '0.001' is not allowed"),
        (["speed", "fast"], "FACTOR: 'fast' is not allowed"),
        (["step", "0"], "TICKS: '0' is not allowed"),
        (["step", "--for", "-1"], "--for: '-1' is not allowed"),
        (["status", "--master", "here"], "master: 'here' is not allowed"),
    ):
        done = sim(stack, *arguments)
        assert done.returncode == 2
        assert words in done.stderr


def test_the_command_line_finds_a_flight(stack: Stack, tmp_path: Path) -> None:
    from xtdrone_interaction.simulation_services import SimError, choose_master

    nobody = "http://127.0.0.1:1"
    for name, uri in (("old", nobody), ("new", stack.graph.uri), ("newest", nobody)):
        (tmp_path / name).mkdir()
        (tmp_path / name / "master").write_text(uri + "\n")
    assert choose_master("", nobody, [tmp_path]) == (stack.graph.uri, f"flight {tmp_path / 'new'}")
    assert choose_master("", stack.graph.uri, [tmp_path]) == (stack.graph.uri, "")
    with pytest.raises(SimError, match=re.escape(f"no ROS master answers at {nobody}, and no flight")):
        choose_master("", nobody, [])
    lost = sim(stack, "pause", "--master", "1")
    assert lost.returncode == 1
    assert "none answers at http://127.0.0.1:1" in lost.stderr


# ---- the end


def test_the_end_leaves_no_caller_waiting(stack: Stack) -> None:
    pause(stack)
    resume(stack)
    assert stack.graph.call("/simulator/set_speed", SetSpeed, speed=0.05).success
    waiting = subprocess.Popen(
        [sys.executable, "-m", "xtdrone_interaction", "sim", "step", "--for", "1000"],
        env={**os.environ, **stack.graph.environment},
        stderr=subprocess.PIPE,
        text=True,
    )
    poll(lambda: status(stack).stepping, "the step is under way")
    launch = stack.programs["roslaunch"]
    launch.process.send_signal(signal.SIGINT)
    _, words = waiting.communicate(timeout=WALL_LIMIT)
    assert waiting.returncode == 1
    assert "simulator" in words
    launch.end()
