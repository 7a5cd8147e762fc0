"""``./xtdrone gcs goto --avoid`` passes goals to planners, and reports why it cannot."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator

import pytest
from conftest import WALL_LIMIT, Ear, Graph, poll

pytest.importorskip("rospy")

import rospy
from geometry_msgs.msg import PoseStamped
from mavros_msgs.msg import ExtendedState

FLYING, LANDED = "iris_3d_lidar_0", "iris_3d_lidar_1"


@pytest.fixture
def planner(graph: Graph) -> Iterator[Ear]:
    """Yield the goals of one of two vehicles; this process acts as their planner."""
    graph.forget()
    rospy.set_param("/system_tests/highest", 3.0)
    goals = graph.hear(f"/{FLYING}/planner/goal", PoseStamped)
    graph.hear(f"/{LANDED}/planner/goal", PoseStamped)
    states = []
    for name, landed in ((FLYING, ExtendedState.LANDED_STATE_IN_AIR), (LANDED, ExtendedState.LANDED_STATE_ON_GROUND)):
        states.append(rospy.Publisher(f"/{name}/mavros/extended_state", ExtendedState, latch=True, queue_size=1))
        states[-1].publish(ExtendedState(landed_state=landed))
    yield goals
    for publisher in states:
        publisher.unregister()
    graph.forget()


def goto(graph: Graph, *arguments: str) -> tuple[int, str]:
    command = [sys.executable, "-m", "xtdrone_interaction", "gcs", "goto", *arguments, "--fleet", "iris_3d_lidar:3",
               "--avoid", "--master", str(graph.port)]  # fmt: skip
    done = subprocess.run(
        command,
        env={**os.environ, **graph.environment},
        capture_output=True,
        text=True,
        timeout=WALL_LIMIT,
        check=False,
    )
    return done.returncode, done.stdout + done.stderr


def test_a_goal_reaches_the_planner(graph: Graph, planner: Ear) -> None:
    status, output = goto(graph, "40", "-5.5", "2", "--vehicle", FLYING)
    assert status == 0, output
    assert "its planner flies there" in output
    poll(lambda: planner.messages, "the goal")
    goal = planner.last
    assert goal.header.frame_id == "map"
    assert (goal.pose.position.x, goal.pose.position.y, goal.pose.position.z) == (40.0, -5.5, 2.0)


def test_what_cannot_be_flown_is_rejected_vehicle_by_vehicle(graph: Graph, planner: Ear) -> None:
    status, output = goto(graph, "40", "5", "2", "--spacing", "4", "--vehicle", LANDED, FLYING, "iris_3d_lidar_2")
    assert status == 1
    assert f"{LANDED}: goto: the vehicle is on the ground" in output
    assert f"{FLYING}: goal: height 6.00 is not allowed, 0.8 to 3 m" in output
    assert "iris_3d_lidar_2: no planner; start one" in output
    assert not planner.messages


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--lat", "47", "--lon", "8", "--alt", "500"], "--avoid needs X Y Z"),
        (["1", "2", "3", "--speed", "2"], "excludes --speed"),
    ],
)
def test_options_that_a_planner_does_not_take_are_named(graph: Graph, arguments: list[str], words: str) -> None:
    status, output = goto(graph, *arguments, "--vehicle", FLYING)
    assert status == 2
    assert words in output
