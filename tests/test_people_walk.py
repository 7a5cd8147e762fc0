"""People of a world in the running simulator: sent to goals, published, put back by a reset."""

from __future__ import annotations

import math
from collections.abc import Iterator

import pytest
from conftest import START_LIMIT, Graph, Stack, poll, wait_for_ports

pytest.importorskip("rospy")

from gazebo_msgs.msg import ModelStates
from gazebo_msgs.srv import GetWorldProperties
from nav_msgs.msg import Odometry
from ros_actor_cmd_pose_plugin_msgs.msg import ActorMotion
from std_srvs.srv import Empty
from xtdrone_msgs.msg import SceneState

from xtdrone_worlds.worlds import people_meshes

FLEET = "iris:1"
WORLD = """<?xml version="1.0"?>
<sdf version="1.6">
  <world name="people">
    <actor name="ann"><skin><filename>bela</filename></skin><pose>1 2 0 0 0 0</pose></actor>
    <actor name="bob"><pose>-4 0 0 0 0 3.14159265</pose></actor>
  </world>
</sdf>
"""


@pytest.fixture(scope="module")
def stack(graph: Graph, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Stack]:
    """A simulator alone, as fast as possible."""
    wait_for_ports(FLEET)
    folder = tmp_path_factory.mktemp("people")
    (folder / "people.world").write_text(WORLD)
    stack = Stack(graph, folder, FLEET)
    try:
        stack.launch(
            "multi_vehicle.launch",
            f"vehicles:={FLEET}",
            "rows:=1",
            "speed:=0",
            "participants:=0",
            "mavros:=false",
            f"world:={folder / 'people.world'}",
        )
        states = graph.hear("/gazebo/model_states", ModelStates)
        poll(lambda: states.messages, "the simulator says where models are", START_LIMIT)
        yield stack
    finally:
        stack.stop()


def places(states: ModelStates) -> dict[str, tuple[float, float, float]]:
    """Return x, y and heading by name."""
    return {
        name: (pose.position.x, pose.position.y, 2.0 * math.atan2(pose.orientation.z, pose.orientation.w))
        for name, pose in zip(states.name, states.pose, strict=True)
    }


def test_told_by_topic_it_turns_and_walks_straight(stack: Stack) -> None:
    states = stack.graph.hear("/gazebo/model_states", ModelStates)
    assert states.last.name == ["ground_plane", "iris_0", "ann", "bob"]
    assert places(states.last)["ann"] == pytest.approx((1.0, 2.0, 0.0))
    scenes = stack.graph.hear("/xtdrone/scene", SceneState)
    poll(lambda: scenes.messages, "the simulator says what cameras see")
    truth = stack.graph.hear("/xtdrone/ann/ground_truth/odom", Odometry)
    poll(lambda: truth.messages, "the simulator says where she truly is")
    first = len(states.messages)
    stack.graph.say("/actor_0/cmd_motion", ActorMotion(4.0, 6.0, 1.0))
    poll(lambda: places(states.last)["ann"][:2] == (4.0, 6.0), "she is there")
    heading = math.atan2(4.0, 3.0)
    for message in states.since(first):
        x, y, yaw = places(message)["ann"]
        share = (x - 1.0) / 3.0
        assert y == pytest.approx(2.0 + 4.0 * share)
        assert yaw == pytest.approx(heading) if share > 0.0 else 0.0 <= yaw <= heading + 1e-9
        assert places(message)["bob"][:2] == (-4.0, 0.0)
    poll(lambda: scenes.last.actor_poses[0].position.y == 6.0, "cameras see her there")
    stride = people_meshes.read("bela").stride
    seen = [(scene.header.stamp.to_sec(), scene.actor_phases[0]) for scene in scenes.messages]
    walked = [(time, phase) for time, phase in seen if phase > 0.0]
    assert seen[-1][1] < 0.0
    way = [
        (m.header.stamp.to_sec(), m.pose.pose.position.x) for m in truth.messages if 1.0 < m.pose.pose.position.x < 4.0
    ]
    for time, x in way:
        assert x - way[0][1] == pytest.approx(0.6 * (time - way[0][0]), abs=1e-6)
    for time, phase in walked:  # at 1 m/s
        assert (phase - walked[0][1]) * stride == pytest.approx(time - walked[0][0], abs=1e-6)
    assert scenes.last.actors == ["ann", "bob"]
    assert stack.graph.call("/gazebo/get_world_properties", GetWorldProperties).model_names[-2:] == ["ann", "bob"]


def test_told_by_the_program_and_put_back_by_a_reset(stack: Stack) -> None:
    states = stack.graph.hear("/gazebo/model_states", ModelStates)
    program = stack.run("control_actor_1", "xtdrone_sim", "control_actor.py", "1", "-6", "0", "2")
    assert program.end() == 0, program.output
    poll(lambda: places(states.last)["bob"][:2] == (-6.0, 0.0), "he is there")
    missing = stack.run("control_actor_7", "xtdrone_sim", "control_actor.py", "7", "0", "0", "1")
    assert missing.end() == 1
    assert "no subscriber of /actor_7/cmd_motion: the world has no person 7" in missing.output
    stack.graph.say("/actor_0/cmd_motion", ActorMotion(math.nan, 0.0, 1.0))
    poll(
        lambda: "ann: x: nan is not allowed" in (stack.folder / "roslaunch.log").read_text(errors="replace"),
        "what is wrong is said",
    )
    stack.graph.call("/gazebo/reset_world", Empty)
    poll(lambda: places(states.last)["bob"][:2] == (-4.0, 0.0), "he is back")
    assert places(states.last)["ann"][:2] == (1.0, 2.0)
