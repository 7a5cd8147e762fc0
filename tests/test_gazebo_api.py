"""Gazebo's ROS API as upstream's programs use it: plain rospy, in a world with people, walls and loose objects."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import pytest
from conftest import START_LIMIT, Ear, Graph, Stack, poll, wait_for_ports

pytest.importorskip("rospy")

import genpy
import rospy
from gazebo_msgs import srv
from gazebo_msgs.msg import LinkStates, ModelState, ModelStates
from geometry_msgs.msg import Point, Pose, Quaternion, Twist, Vector3, Wrench
from sensor_msgs.msg import JointState
from std_srvs.srv import Empty
from xtdrone_msgs.msg import SceneModels, SceneState
from xtdrone_msgs.srv import SetWind, Step

FLEET = "iris:2,typhoon_h480:1"
CUBE = "<geometry><box><size>1 1 1</size></box></geometry>"
BODY = f"<collision name='c'>{CUBE}</collision><visual name='v'>{CUBE}</visual>"
MASS = "<inertial><mass>4</mass><inertia><ixx>0.7</ixx><iyy>0.7</iyy><izz>0.7</izz></inertia></inertial>"
WORLD = f"""<?xml version="1.0"?>
<sdf version="1.6">
  <world name="yard">
    <gravity>0 0 -9.8</gravity><gravity>0 0 -9.8</gravity>
    <include><uri>model://sun</uri></include>
    <model name="wall"><static>1</static><pose>20 0 1 0 0 0</pose>
      <link name="link"><collision name="c"><geometry><polyline>
        <point>0 0</point><point>1 0</point><point>1 3</point><point>0 3</point><height>2</height>
      </polyline></geometry></collision></link>
    </model>
    <model name="crate"><pose>-10 5 2 0 0 0</pose><link name="link">{MASS}{BODY}</link></model>
    <model name="house"><static>1</static><pose>30 9 0 0 0 0</pose>
      <link name="link"><visual name="v"><geometry><mesh><uri>model://house/house.dae</uri></mesh></geometry></visual></link>
    </model>
    <model name="door"><pose>0 30 1 0 0 0</pose>
      <link name="frame">{MASS}{BODY}</link>
      <link name="leaf"><pose>2 0 0 0 0 0</pose>{MASS}{BODY}</link>
      <joint name="j" type="fixed"><parent>world</parent><child>frame</child></joint>
      <joint name="hinge" type="revolute"><parent>frame</parent><child>leaf</child><pose>-1 0 0 0 0 0</pose>
        <axis><xyz>0 0 1</xyz><limit><upper>0.8</upper></limit></axis></joint>
    </model>
    <actor name="actor_0"><pose>5 5 0 0 0 0</pose></actor>
    <actor name="actor_1"><script><trajectory id="0" type="walking">
      <waypoint><time>0</time><pose>0 -9 0 0 0 0</pose></waypoint>
      <waypoint><time>160</time><pose>9 -9 0 0 0 0</pose></waypoint>
      <waypoint><time>160</time><pose>9 -9 0 0 0 1.57</pose></waypoint>
      <waypoint><time>161</time><pose>9 -9 0 0 0 1.57</pose></waypoint>
    </trajectory></script></actor>
  </world>
</sdf>
"""
MODELS = ["wall", "crate", "house", "door", "door::leaf"]
BOX = f"<sdf version='1.6'><model name='any'><link name='link'>{MASS}{BODY}</link></model></sdf>"
PILLAR = BOX.replace("<link", "<static>1</static><link")
URDF = """<robot name="r"><link name="base"><inertial><mass value="2"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0"
 iyz="0"/></inertial><collision><geometry><sphere radius="0.4"/></geometry></collision></link></robot>"""


@pytest.fixture(scope="module")
def stack(graph: Graph, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Stack]:
    """A simulator alone, as fast as possible."""
    wait_for_ports(FLEET)
    folder = tmp_path_factory.mktemp("gazebo")
    (folder / "yard.world").write_text(WORLD)
    stack = Stack(graph, folder, FLEET)
    try:
        stack.run(
            "simulator", "xtdrone_sim", "simulator.py", f"_world:={folder / 'yard.world'}", f"_fleet:={FLEET}",
            "_speed:=0", "_link_states_rate:=250", "_model_states_rate:=250",
        )  # fmt: skip
        states = graph.hear("/gazebo/model_states", ModelStates)
        poll(lambda: states.messages, "the simulator says where models are", START_LIMIT)
        yield stack
    finally:
        stack.stop()


def call(stack: Stack, name: str, kind: type, **fields: Any) -> Any:
    return stack.graph.call(f"/gazebo/{name}", kind, **fields)


def state_of(stack: Stack, name: str, frame: str = "") -> Any:
    answer = call(stack, "get_model_state", srv.GetModelState, model_name=name, relative_entity_name=frame)
    assert answer.success, answer.status_message
    return answer


def step(stack: Stack) -> float:
    """Advance by 20 ms of simulated time; return the time then, s."""
    return float(stack.graph.call("/simulator/step", Step, duration=genpy.Duration(0, 20_000_000)).sim_time.to_sec())


def at(x: float, y: float, z: float, yaw: float = 0.0) -> Pose:
    return Pose(Point(x, y, z), Quaternion(0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2)))


def place(pose: Pose) -> tuple[float, float, float]:
    return (pose.position.x, pose.position.y, pose.position.z)


def put(stack: Stack, name: str, pose: Pose, frame: str = "", twist: Twist | None = None) -> Any:
    state = ModelState(name, pose, twist or Twist(), frame)
    return call(stack, "set_model_state", srv.SetModelState, model_state=state)


def test_the_world_is_there_and_its_loose_crate_has_fallen(stack: Stack) -> None:
    states = stack.graph.hear("/gazebo/model_states", ModelStates)
    fleet = ["iris_0", "iris_1", "typhoon_h480_0"]
    names = ["ground_plane", *fleet, *MODELS, "actor_0", "actor_1"]
    assert states.last.name == names
    stack.wait(lambda: states.last.pose[5].position.z < 0.51, "the crate lies")
    assert place(state_of(stack, "crate").pose)[:2] == pytest.approx((-10.0, 5.0), abs=0.05)
    assert place(state_of(stack, "actor_0", "ground_plane").pose) == (5.0, 5.0, 0.0)
    output = stack.programs["simulator"].output
    for words in ("<gravity> occurs a second time", "'model://house/house.dae' is not found: the shape is"):
        assert words in output
    listed = call(stack, "get_world_properties", srv.GetWorldProperties)
    assert listed.model_names == names


def test_states_and_links_come_at_250_hz(stack: Stack) -> None:
    links = stack.graph.hear("/gazebo/link_states", LinkStates)
    states = stack.graph.hear("/gazebo/model_states", ModelStates)
    poll(lambda: links.messages, "link states")

    def marked(ear: Ear, name: str) -> int:
        return sum(abs(m.pose[m.name.index(name)].position.y - 7.0) < 0.5 for m in ear.messages[-500:])

    call(stack, "pause_physics", Empty)
    try:
        begin = step(stack)
        assert put(stack, "crate", at(-10, 7, 0.5)).success  # marks the messages from now on
        for _ in range(50):  # few at a time: rospy drops messages of a publisher that is faster than its subscriber
            end = step(stack)
        wanted = round((end - begin) / 0.004)
        for ear, name in ((states, "crate"), (links, "crate::link")):
            poll(lambda ear=ear, name=name: marked(ear, name) >= wanted, "the messages of the steps")
            assert marked(ear, name) <= wanted + 5  # a tick may have been ready when the crate was placed
    finally:
        call(stack, "unpause_physics", Empty)
    names = links.last.name
    assert {"iris_0::base_link", "crate::link", "wall::link", "ground_plane::link"} <= set(names)
    assert links.last.pose[names.index("crate::link")].position.z == pytest.approx(0.5, abs=0.01)


def test_the_ground_station_knows_the_names(
    stack: Stack, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from xtdrone_interaction.gcs_commands.gcs_cli import main
    from xtdrone_interaction.simulation_services import running_fleet

    monkeypatch.setenv("ROS_MASTER_URI", stack.graph.uri)
    monkeypatch.chdir(stack.folder)  # flights of the workspace are listed, too
    assert running_fleet(0) == FLEET
    assert main(["status", "--once", "--vehicle", "iris_1", "typhoon_h480_0"]) == 0
    output = capsys.readouterr().out
    assert "iris_1" in output
    assert "typhoon_h480_0" in output
    assert "iris_0" not in output


def test_reference_frames(stack: Stack) -> None:
    for frame in ("", "world", "map", "ground_plane", "ground_plane::link"):
        assert place(state_of(stack, "wall", frame).pose) == (20.0, 0.0, 1.0)
    assert put(stack, "actor_0", at(5.0, 5.0, 0.0, math.pi / 2)).success
    assert put(stack, "wall", at(2.0, 1.0, 1.0), "actor_0").success
    assert place(state_of(stack, "wall").pose) == pytest.approx((4.0, 7.0, 1.0))
    assert place(state_of(stack, "wall", "actor_0").pose) == pytest.approx((2.0, 1.0, 1.0))
    seen = call(stack, "get_link_state", srv.GetLinkState, link_name="wall::link", reference_frame="crate::link")
    assert seen.success
    assert place(seen.link_state.pose)[0] == pytest.approx(14.0, abs=0.05)
    assert put(stack, "wall", at(20.0, 0.0, 1.0)).success


def test_spawn_get_properties_push_and_delete(stack: Stack) -> None:
    spawn = dict(model_xml=BOX, robot_namespace="/box", initial_pose=at(3.0, -20.0, 40.0), reference_frame="world")
    answer = call(stack, "spawn_sdf_model", srv.SpawnModel, model_name="box_1", **spawn)
    assert answer.success, answer.status_message
    again = call(stack, "spawn_sdf_model", srv.SpawnModel, model_name="box_1", **spawn)
    assert not again.success
    assert "'box_1' already exists" in again.status_message
    models = stack.graph.hear("/xtdrone/models", SceneModels)
    stack.wait(lambda: models.last and "box_1" in models.last.sdf, "cameras are told")
    scenes = stack.graph.hear("/xtdrone/scene", SceneState)
    stack.wait(lambda: scenes.last and "box_1::link" in scenes.last.links, "cameras see where it is")
    known = call(stack, "get_model_properties", srv.GetModelProperties, model_name="box_1")
    assert (known.success, known.is_static, known.body_names) == (True, False, ["link"])
    mass = call(stack, "get_link_properties", srv.GetLinkProperties, link_name="box_1::link")
    assert (mass.success, mass.mass, mass.ixx, mass.gravity_mode) == (True, 4.0, 0.7, True)

    call(stack, "pause_physics", Empty)
    assert put(stack, "box_1", at(3.0, -20.0, 80.0)).success
    push = dict(wrench=Wrench(force=Vector3(8.0, 0.0, 0.0)), duration=genpy.Duration(0, 700_000_000))
    answer = call(stack, "apply_body_wrench", srv.ApplyBodyWrench, body_name="box_1::link", **push)
    assert answer.success, answer.status_message
    stack.graph.call("/simulator/step", Step, duration=genpy.Duration(1, 500_000_000))  # paused after it, in free fall
    assert state_of(stack, "box_1").twist.linear.x == pytest.approx(8.0 * 0.7 / 4.0, rel=1e-6)
    call(stack, "unpause_physics", Empty)
    assert call(stack, "delete_model", srv.DeleteModel, model_name="box_1").success
    assert not call(stack, "delete_model", srv.DeleteModel, model_name="box_1").success
    assert call(stack, "spawn_urdf_model", srv.SpawnModel, model_name="ball", **{**spawn, "model_xml": URDF}).success
    stack.wait(lambda: state_of(stack, "ball").pose.position.z < 0.6, "the ball has fallen")
    assert call(stack, "delete_model", srv.DeleteModel, model_name="ball").success


def test_a_wrench_on_a_vehicle_gives_the_acceleration_of_its_mass(stack: Stack) -> None:
    mass = call(stack, "get_link_properties", srv.GetLinkProperties, link_name="iris_0::base_link").mass
    call(stack, "pause_physics", Empty)
    assert put(stack, "iris_0", at(0.0, 40.0, 60.0)).success
    push = dict(wrench=Wrench(force=Vector3(0.0, 3.0, 0.0)), duration=genpy.Duration(0, 402_000_000))
    later = dict(wrench=Wrench(force=Vector3(100.0, 0.0, 0.0)), duration=genpy.Duration(-1))
    assert call(stack, "apply_body_wrench", srv.ApplyBodyWrench, body_name="iris_0::base_link", **push).success
    assert call(stack, "apply_body_wrench", srv.ApplyBodyWrench, body_name="iris_1", **later).success
    call(stack, "clear_body_wrenches", srv.BodyRequest, body_name="iris_1")
    stack.graph.call("/simulator/step", Step, duration=genpy.Duration(1))  # paused after it, in free fall
    state = state_of(stack, "iris_0")
    call(stack, "unpause_physics", Empty)
    assert state.twist.linear.y == pytest.approx(3.0 * 0.402 / mass, rel=1e-6)
    assert state.twist.linear.x == 0.0
    assert put(stack, "iris_0", at(0.0, 0.0, 0.1)).success


def test_a_swarm_driven_without_autopilots(stack: Stack) -> None:
    """Positions are set as by upstream's control_gazebo_vehicles.py: 20 Hz, twists and orientations unset."""
    for number in (0, 1):
        answer = call(
            stack, "spawn_sdf_model", srv.SpawnModel, model_name=f"drone_{number}", model_xml=BOX, robot_namespace="",
            initial_pose=Pose(), reference_frame="",
        )  # fmt: skip
        assert answer.success, answer.status_message
    names = ["iris_0", "iris_1", "drone_0", "drone_1"]
    message = ModelStates(
        names, [Pose(position=Point(5.0 * k, 30.0, 3.0)) for k in range(4)], [Twist() for _ in range(4)]
    )
    states = stack.graph.hear("/gazebo/model_states", ModelStates)
    publisher = rospy.Publisher("gazebo/set_model_states", ModelStates, queue_size=1)
    poll(publisher.get_num_connections, "the simulator listens")
    call(stack, "pause_physics", Empty)
    first = 0
    for step in range(40):
        for pose in message.pose:
            pose.position.x += 0.025
        publisher.publish(message)
        stack.graph.call("/simulator/step", Step, duration=genpy.Duration(0, 50_000_000))
        first = len(states.messages) if step == 5 else first
    call(stack, "unpause_physics", Empty)
    driven = [one for one in states.since(first) if one.pose[one.name.index("drone_0")].position.x < 10.95]
    assert len(driven) > 100
    for one in driven:
        for name in names:
            assert one.pose[one.name.index(name)].position.z == 3.0
    last = states.last
    assert last.pose[last.name.index("drone_1")].position.x == pytest.approx(16.0, abs=0.1)
    stack.wait(lambda: all(state_of(stack, name).pose.position.z < 0.6 for name in names), "they fall in the end")
    publisher.unregister()


def test_joints_of_gimbal_and_gear(stack: Stack) -> None:
    joints = stack.graph.hear("/typhoon_h480_0/joint_states", JointState)
    stack.wait(lambda: joints.last, "joints are published")
    gimbal = joints.last.name[0]
    call(stack, "pause_physics", Empty)
    seen = len(joints.messages)
    answer = call(stack, "set_model_configuration", srv.SetModelConfiguration, model_name="typhoon_h480_0",
                  joint_names=[gimbal], joint_positions=[0.5])  # fmt: skip
    assert answer.success, answer.status_message
    call(stack, "unpause_physics", Empty)
    stack.wait(lambda: any(0.2 < message.position[0] <= 0.5 for message in joints.since(seen)), "the joint was there")
    answer = call(stack, "set_model_configuration", srv.SetModelConfiguration, model_name="iris_0", joint_names=["x"],
                  joint_positions=[0.5])  # fmt: skip
    assert not answer.success
    assert "'x' cannot be set; joints that can are none" in answer.status_message


BAD_SDF = {
    "": "not an XML file: no element found",
    "<sdf version='1.6'><world name='w'/></sdf>": "has 0 <model>, one is needed",
    BOX.replace("<size>1 1 1</size>", "<size>1 nan 1</size>"): "'1 nan 1' is not allowed",
    BOX.replace("<size>1 1 1</size>", "<size>1e9 1 1</size>"): "a shape 1e+09 m long is not allowed, 0.001 to 10000 m",
    BOX.replace(CUBE, "<geometry><mesh><uri>file:///etc/passwd</uri></mesh></geometry>"): "is not allowed in a request",
    BOX.replace("</sdf>", " " * (1 << 20) + "</sdf>"): "characters are not allowed, at most 1048576",
    BOX.replace("</link>", "".join(f"<visual name='v{k}'>{CUBE}</visual>" for k in range(300)) + "</link>"): "1 to 256",
    "<!DOCTYPE x [<!ENTITY a 'aaaa'>]><sdf>&a;</sdf>": "<!ENTITY a> is not allowed",
}


def test_a_door_is_pushed_to_its_limit_and_deleted_with_its_frame(stack: Stack) -> None:
    leaf = state_of(stack, "door::leaf")
    assert place(leaf.pose) == pytest.approx((2.0, 30.0, 1.0), abs=1e-3)
    refused = put(stack, "door::leaf", at(5.0, 5.0, 1.0))
    assert "is attached by its joint 'door::hinge'" in refused.status_message
    push = Wrench(force=Vector3(0.0, 40.0, 0.0))
    answer = call(stack, "apply_body_wrench", srv.ApplyBodyWrench, body_name="door::leaf", wrench=push,
                  duration=genpy.Duration(3))  # fmt: skip
    assert answer.success, answer.status_message
    stack.pass_time(2.0)
    angle = 2.0 * math.atan2(*(getattr(state_of(stack, "door::leaf").pose.orientation, axis) for axis in "zw"))
    assert angle == pytest.approx(0.8, abs=0.01)
    assert state_of(stack, "door").pose.orientation.w == 1.0
    assert call(stack, "delete_model", srv.DeleteModel, model_name="door").success
    gone = call(stack, "get_model_state", srv.GetModelState, model_name="door::leaf", relative_entity_name="")
    assert not gone.success


def test_the_wind_is_set_by_service_and_a_wrong_one_is_refused(stack: Stack) -> None:
    for wind, success, words in (
        (Vector3(3.0, -1.0, 0.0), True, "the wind is (3, -1, 0) m/s"),
        (Vector3(math.nan, 0.0, 0.0), False, "wind: (nan, 0, 0) m/s is not allowed, at most 100 m/s"),
    ):
        answer = stack.graph.call("/simulator/set_wind", SetWind, velocity=wind)
        assert (answer.success, words in answer.message) == (success, True)


@pytest.mark.parametrize("number", range(len(BAD_SDF)))
def test_bad_models_are_refused(stack: Stack, number: int) -> None:
    text, words = list(BAD_SDF.items())[number]
    answer = call(stack, "spawn_sdf_model", srv.SpawnModel, model_name="bad", model_xml=text, robot_namespace="",
                  initial_pose=at(0.0, 0.0, 9.0), reference_frame="")  # fmt: skip
    assert not answer.success
    assert words in answer.status_message


def test_bad_requests_are_refused_with_a_sentence(stack: Stack) -> None:
    nan = math.nan
    bad_turn = Pose(Point(0.0, 0.0, 1.0), Quaternion(0.0, 0.0, 0.0, 3.0))
    wind = Wrench(force=Vector3(nan, 0.0, 0.0))
    spawn = dict(model_xml=PILLAR, robot_namespace="", initial_pose=at(0.0, 0.0, 9.0), reference_frame="")
    for answer, words in (
        (put(stack, "iris_0", at(nan, 0.0, 0.0)), "position: (nan, 0, 0) is not allowed, finite numbers"),
        (put(stack, "iris_0", at(1e9, 0.0, 0.0)), "position: (1e+09, 0, 0) is not allowed"),
        (put(stack, "iris_0", bad_turn), "a quaternion of length 1"),
        (put(stack, "mars", at(0.0, 0.0, 0.0)), "model_name: 'mars' does not exist; there are iris_0, iris_1"),
        (put(stack, "crate", at(0.0, 0.0, 0.0), "mars"), "reference_frame: 'mars' does not exist"),
        (
            call(stack, "get_model_state", srv.GetModelState, model_name="", relative_entity_name=""),
            "'' does not exist",
        ),
        (call(stack, "delete_model", srv.DeleteModel, model_name="iris_1"), "'iris_1' is a vehicle with an autopilot"),
        (call(stack, "delete_model", srv.DeleteModel, model_name="ground_plane"), "the ground always exists"),
        (call(stack, "apply_body_wrench", srv.ApplyBodyWrench, body_name="iris_0", wrench=wind), "wrench: force: (nan"),
        (call(stack, "apply_body_wrench", srv.ApplyBodyWrench, body_name="wall::link"), "'wall::link' does not move"),
        (call(stack, "spawn_sdf_model", srv.SpawnModel, model_name="a/b", **spawn), "'a/b' is not allowed, 1 to 100"),
        (call(stack, "spawn_sdf_model", srv.SpawnModel, model_name="world", **spawn), "'world' is not allowed"),
        (call(stack, "set_link_properties", srv.SetLinkProperties), "/gazebo/set_link_properties is not supported"),
        (call(stack, "apply_joint_effort", srv.ApplyJointEffort), "joints have no efforts here"),
        (call(stack, "delete_light", srv.DeleteLight), "the world has one sun"),
    ):
        assert not answer.success
        assert words in answer.status_message
    with pytest.raises(rospy.ServiceException, match="joints have no efforts here"):
        call(stack, "clear_joint_forces", srv.JointRequest, joint_name="x")
    stack.graph.say("/gazebo/set_model_states", ModelStates(["iris_0"], [], []))
    stack.graph.say("/gazebo/set_model_state", ModelState("mars", at(0.0, 0.0, 0.0), Twist(), ""))
    stack.log_has("simulator", "1 names, 0 poses and 0 twists are not allowed", "/gazebo/set_model_state of")
    stack.pass_time(0.5)


def test_people_are_deleted_and_a_reset_brings_back_the_world(stack: Stack) -> None:
    states = stack.graph.hear("/gazebo/model_states", ModelStates)
    for name in ("actor_0", "wall"):
        assert call(stack, "delete_model", srv.DeleteModel, model_name=name).success
    stack.wait(lambda: not {"actor_0", "wall"} & set(states.last.name), "both are gone")
    assert "drone_0" in states.last.name
    assert not call(stack, "get_model_state", srv.GetModelState, model_name="actor_0").success
    models = stack.graph.hear("/xtdrone/models", SceneModels)
    stack.wait(lambda: models.last.deleted == ["wall", "door", "door::leaf", "actor_0"], "cameras are told")
    call(stack, "reset_world", Empty)
    stack.wait(lambda: states.last.name[-7:] == [*MODELS, "actor_0", "actor_1"], "the world is back")
    assert place(state_of(stack, "wall").pose) == (20.0, 0.0, 1.0)
    stack.wait(lambda: models.last.deleted == [], "cameras are told")
