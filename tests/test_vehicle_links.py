"""The links of a vehicle with a gimbal, as published: scene, Gazebo's topics and service, TF.

One system serves all tests of this file; nothing flies, the gimbal turns.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator

import pytest
from conftest import START_LIMIT, Graph, Stack, wait_for_ports

pytest.importorskip("rospy")

import rospy
from gazebo_msgs.msg import LinkStates
from gazebo_msgs.srv import GetLinkState
from sensor_msgs.msg import JointState
from tf2_msgs.msg import TFMessage
from xtdrone_msgs.msg import SceneState

FLEET = "typhoon_h480:2"
NAME = "typhoon_h480_1"
CAMERA = f"{NAME}::cgo3_camera_link"
PERIOD = rospy.Duration(0, 20_000_000)


@pytest.fixture(scope="module")
def stack(graph: Graph, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Stack]:
    wait_for_ports(FLEET)
    stack = Stack(graph, tmp_path_factory.mktemp("links"), FLEET)
    try:
        stack.launch("multi_vehicle.launch", f"vehicles:={FLEET}", "tf:=true")
        stack.wait(lambda: stack.time > 0.0, "the simulation runs", wall=START_LIMIT)
        yield stack
    finally:
        stack.stop()


def test_the_scene_is_told_at_exact_times(stack: Stack) -> None:
    scene = stack.graph.hear("/xtdrone/scene", SceneState)
    stack.wait(lambda: len(scene.messages) >= 50, "the scene is told")
    stamps = [message.header.stamp for message in scene.messages]
    assert all(stamp.to_nsec() % PERIOD.to_nsec() == 0 for stamp in stamps)
    assert stamps == sorted(set(stamps))
    last = scene.last
    assert last.header.frame_id == "map"
    assert len(last.links) == len(last.poses) == 12
    height = last.poses[last.links.index(f"{NAME}::base_link")].position.z
    assert height == pytest.approx(0.18, abs=0.02), "it stands on its legs"
    assert last.poses[last.links.index(CAMERA)].position.z == pytest.approx(height - 0.122, abs=0.02)


def test_link_states_have_gazebos_entries(stack: Stack) -> None:
    heard = stack.graph.hear("/gazebo/link_states", LinkStates)
    states = stack.wait(lambda: heard.last, "link_states come")
    assert states.name[0] == "ground_plane::link"
    assert {f"typhoon_h480_{i}::{link}" for i in range(2) for link in ("base_link", "cgo3_camera_link")} <= set(
        states.name
    )
    assert len(states.name) == len(states.pose) == len(states.twist)


def test_one_link_seen_from_another(stack: Stack) -> None:
    ask = stack.graph.call
    world = ask("/gazebo/get_link_state", GetLinkState, link_name=CAMERA, reference_frame="ground_plane::link")
    assert world.success
    camera = ask("/gazebo/get_link_state", GetLinkState, link_name=CAMERA, reference_frame=f"{NAME}::base_link")
    assert camera.success
    p = camera.link_state.pose.position
    assert (p.x, p.y, p.z) == pytest.approx((0.041, 0.0, -0.122), abs=1e-3)
    assert camera.link_state.reference_frame == f"{NAME}::base_link"
    refused = ask("/gazebo/get_link_state", GetLinkState, link_name="typhoon_h480_7::base_link", reference_frame="")
    assert not refused.success
    assert "'typhoon_h480_7::base_link' does not exist; there are typhoon_h480_0::base_link" in refused.status_message


def test_joint_states_are_those_of_gimbal_and_legs(stack: Stack) -> None:
    heard = stack.graph.hear(f"/{NAME}/joint_states", JointState)
    joints = stack.wait(lambda: heard.last, "joint_states come")
    gimbal, legs = ("vertical_arm", "horizontal_arm", "camera"), ("left", "right")
    assert joints.name == [*(f"cgo3_{part}_joint" for part in gimbal), *(f"{side}_leg_joint" for side in legs)]
    assert joints.position == pytest.approx([0.0] * 5, abs=0.05)


def test_tf_leads_from_the_map_to_the_optical_frame(stack: Stack) -> None:
    import tf2_ros

    buffer = tf2_ros.Buffer(debug=False)
    ears = {stack.graph.hear("/tf", TFMessage): 0, stack.graph.hear("/tf_static", TFMessage): 0}

    def found() -> bool:
        for (ear, taken), put in zip(ears.items(), (buffer.set_transform, buffer.set_transform_static), strict=True):
            new = ear.since(taken)
            ears[ear] += len(new)
            for transform in [transform for message in new for transform in message.transforms]:
                put(transform, "test")
        return buffer.can_transform("map", f"{NAME}/cgo3_camera_optical_frame", rospy.Time())

    stack.wait(found, "TF knows the camera")
    placed = buffer.lookup_transform("map", f"{NAME}/cgo3_camera_optical_frame", rospy.Time()).transform
    q = placed.rotation
    ahead = (2.0 * (q.x * q.z + q.w * q.y), 2.0 * (q.y * q.z - q.w * q.x), 1.0 - 2.0 * (q.x * q.x + q.y * q.y))
    body = buffer.lookup_transform("map", f"{NAME}/base_link", rospy.Time()).transform.rotation
    heading = math.atan2(2.0 * (body.w * body.z + body.x * body.y), 1.0 - 2.0 * (body.y**2 + body.z**2))
    assert ahead == pytest.approx((math.cos(heading), math.sin(heading), 0.0), abs=0.05)


def test_every_vehicle_has_a_description(stack: Stack) -> None:
    text = rospy.get_param(f"/{NAME}/robot_description")
    links = {link.get("name") for link in ElementTree.fromstring(text).findall("link")}
    assert {"base_link", "cgo3_camera_link", "cgo3_camera_optical_frame"} <= links
