"""The services of move_base, called over a real master: paths on a synthetic map, and rejections."""

from __future__ import annotations

import math

import numpy as np
import pytest
from conftest import Graph

pytest.importorskip("rospy")

import rospy
from geometry_msgs.msg import PoseStamped
from nav_msgs.srv import GetPlan, GetPlanResponse
from std_srvs.srv import Empty

from xtdrone_planning.navigation.level_map import LevelMap
from xtdrone_planning.navigation.move_base_services import MoveBaseServices
from xtdrone_planning.navigation.settings import CostmapSettings

BASE, CELL, SIDE = "/made_0/move_base", 0.1, 200
CLEARANCE = 0.6  # m


def pose(x: float, y: float, frame: str = "map") -> PoseStamped:
    message = PoseStamped()
    message.header.frame_id = frame
    message.pose.position.x, message.pose.position.y = x, y
    return message


def answer(path: np.ndarray) -> GetPlanResponse:
    response = GetPlanResponse()
    response.plan.poses = [pose(x, y) for x, y in path.tolist()]
    return response


def test_plans_and_cleared_costmaps(graph: Graph) -> None:
    level = LevelMap(CostmapSettings())
    where: list[np.ndarray | None] = [None]
    services = MoveBaseServices(BASE, level, lambda: CLEARANCE, lambda: where[0], answer)

    def plan(goal: PoseStamped, start: PoseStamped | None = None, tolerance: float = 0.0) -> list[tuple[float, float]]:
        response = graph.call(
            f"{BASE}/make_plan", GetPlan, start=start or PoseStamped(), goal=goal, tolerance=tolerance
        )
        return [(entry.pose.position.x, entry.pose.position.y) for entry in response.plan.poses]

    def refused(words: str, **request: object) -> None:
        with pytest.raises(rospy.ServiceException, match=words):
            graph.call(f"{BASE}/make_plan", GetPlan, **{"start": pose(1, 1), "goal": pose(5, 5), **request})

    graph.call(f"{BASE}/clear_costmaps", Empty)  # no obstacle to clear yet
    refused("no position of the vehicle has been received", start=PoseStamped())
    refused("no map has been received")
    values = np.zeros((SIDE, SIDE), np.int8)
    values[100] = 100  # a wall at x = 10 m
    level.take(values, np.zeros(2), CELL)
    where[0] = np.array([3.0, 3.0, 1.5])

    path = plan(pose(6.0, 15.0))
    assert path[0] == (3.0, 3.0)
    assert path[-1] == (6.0, 15.0)
    assert plan(pose(6.0, 15.0), pose(1.0, 2.0, "/map"))[0] == (1.0, 2.0)
    assert plan(pose(11.0, 5.0)) == []  # behind the wall
    near = plan(pose(11.0, 5.0), tolerance=2.0)[-1]
    assert math.dist(near, (11.0, 5.0)) <= 2.0
    assert near[0] < 10.0 - CLEARANCE + CELL
    refused("goal: frame 'odom' is not allowed, 'map'", goal=pose(5, 5, "odom"))
    refused(r"goal: \(nan, 5\) is not allowed, finite numbers", goal=pose(math.nan, 5))
    refused(r"start: \(inf, 1\) is not allowed", start=pose(math.inf, 1))
    refused("tolerance: -1 is not allowed, at least 0 and finite, m", tolerance=-1.0)

    with services.lock:
        level.evidence[:, 80] = 350  # obstacles were seen all across
    assert plan(pose(6.0, 15.0)) == []
    graph.call(f"{BASE}/clear_costmaps", Empty)
    assert plan(pose(6.0, 15.0)) == path
    assert plan(pose(11.0, 5.0)) == []  # the wall of the given map stays
