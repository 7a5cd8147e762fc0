"""Navigation with move_base's topics: a UAV with a 2D lidar and a ground robot with a map go through rooms."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from conftest import Graph, Stack, wait_for_ports

pytest.importorskip("rospy")

import actionlib
import rospy
from actionlib_msgs.msg import GoalStatus
from diagnostic_msgs.msg import DiagnosticArray
from gazebo_msgs.msg import ModelStates
from geometry_msgs.msg import PoseStamped
from mavros_msgs.srv import CommandBool, SetMode
from move_base_msgs.msg import MoveBaseAction, MoveBaseGoal
from nav_msgs.msg import OccupancyGrid
from nav_msgs.msg import Path as PathMessage
from nav_msgs.srv import GetPlan
from std_srvs.srv import Empty

from xtdrone_planning.navigation.level_map import LevelMap
from xtdrone_planning.navigation.settings import CostmapSettings
from xtdrone_sim.topics.world_map import FloorPlanSettings, floor_plan
from xtdrone_worlds.worlds.catalogue import load_world

UAV, UGV = "iris_2d_lidar_0", "ugv_0"
WORLD = "indoor:door=2.4,corridor=3,room=7,lintel=2.8,furniture=0.5,length=24,width=16"
BOUNDS = (10.0, -8.0, 48.0, 18.0)
UGV_HOME, IN_WALL = (14.0, 2.0, 0.0), (30.3, 0.5, 0.0)  # the latter between two rooms
UAV_GOAL, UGV_GOAL = (27.5, 11.0, 1.57), (28.0, 0.5, 3.14)
RADII = {UAV: 0.35, UGV: 0.9}  # m, least distance of the middle to walls and furniture
LIMIT = 120.0  # s of simulated time


def goal_at(x: float, y: float, yaw: float) -> MoveBaseGoal:
    goal = MoveBaseGoal()
    pose = goal.target_pose
    pose.header.frame_id = "map"
    pose.pose.position.x, pose.pose.position.y = x, y
    pose.pose.orientation.z, pose.pose.orientation.w = math.sin(0.5 * yaw), math.cos(0.5 * yaw)
    return goal


class Client:
    """A client of actionlib."""

    def __init__(self, stack: Stack, name: str) -> None:
        self.action = actionlib.SimpleActionClient(f"/{name}/move_base", MoveBaseAction)
        stack.wait(lambda: self.action.action_client.wait_for_server(rospy.Duration(0.01)), f"{name}'s server")
        self._stack, self._name = stack, name

    def end(self) -> tuple[int, str]:
        """Return status and text of the goal."""
        ended = (GoalStatus.SUCCEEDED, GoalStatus.ABORTED, GoalStatus.REJECTED, GoalStatus.PREEMPTED)
        self._stack.wait(lambda: self.action.get_state() in ended, f"{self._name}'s goal ends", sim=LIMIT)
        return self.action.get_state(), self.action.get_goal_status_text()

    def go(self, *goal: float) -> None:
        self.action.send_goal(goal_at(*goal))


@pytest.fixture
def stack(graph: Graph, tmp_path: Path) -> Iterator[Stack]:
    wait_for_ports("iris:1")
    graph.forget()
    stack = Stack(graph, tmp_path, "iris_2d_lidar:1")
    for name, value in {
        "/lockstep/wait": True,
        "/use_sim_time": True,
        "/xtdrone/fleet": "iris_2d_lidar:1",
        "/world_map/bounds": list(BOUNDS),
        "/uav": {"height": 1.5},
        "/ugv": {"map_topic": "/map", "scan_topic": "", "radius": 0.95, "inflation": 1.2},
    }.items():  # nodes may start before the launch file has set them
        rospy.set_param(name, value)
    yield stack
    stack.stop()
    graph.forget()


def least_distances(states: list[ModelStates], height: dict[str, float]) -> dict[str, float]:
    """Return the least distance, m, from each vehicle's centre to walls and furniture."""
    least = {}
    for name, low in height.items():
        level = LevelMap(CostmapSettings(cell=0.05, inflation=2.0))
        settings = FloorPlanSettings(bounds=BOUNDS, cell=0.05, low=low, high=low + 0.3)
        level.take(floor_plan(load_world(WORLD), settings), np.array(BOUNDS[:2]), 0.05)
        poses = [message.pose[message.name.index(name)].position for message in states if name in message.name]
        least[name] = min(level.away(np.array([place.x, place.y])) for place in poses)
    return least


def test_a_uav_and_a_robot_go_through_rooms(graph: Graph, stack: Stack) -> None:
    reports = graph.hear("/diagnostics", DiagnosticArray)
    states = graph.hear("/gazebo/model_states", ModelStates)
    plans = graph.hear(f"/{UAV}/move_base/NavfnROS/plan", PathMessage)
    local = graph.hear(f"/{UGV}/move_base/DWAPlannerROS/local_plan", PathMessage)
    costs = graph.hear(f"/{UAV}/move_base/local_costmap/costmap", OccupancyGrid)
    whole = graph.hear(f"/{UAV}/move_base/global_costmap/costmap", OccupancyGrid)
    pose = graph.hear(f"/{UAV}/mavros/local_position/pose", PoseStamped)
    stack.launch(
        "multi_vehicle.launch", "vehicles:=iris_2d_lidar:1", "poses:=[[14,7]]", f"world:={WORLD}", "speed:=0",
        "robots:=[{name: ugv_0, type: ugv, pose: [14, 2, 0]}]", "lidars:=true",
        "participants:=/mavros,/lidars,/uav,/ugv",
    )  # fmt: skip
    stack.run("world_map", "xtdrone_sim", "world_map.py")
    stack.run("uav", "xtdrone_planning", "move_base.py", "iris_2d_lidar", "0")
    stack.run("ugv", "xtdrone_planning", "move_base.py", "ugv", "0")
    uav, ugv = Client(stack, UAV), Client(stack, UGV)

    stack.wait(lambda: pose.messages, "the UAV knows its position")
    uav.go(*UAV_GOAL)
    assert uav.end() == (GoalStatus.REJECTED, "goal: the vehicle is not flying")
    graph.call(f"/{UAV}/mavros/set_mode", SetMode, base_mode=0, custom_mode="AUTO.TAKEOFF")
    stack.wait_state(0, mode="AUTO.TAKEOFF")
    stack.wait(lambda: graph.call(f"/{UAV}/mavros/cmd/arming", CommandBool, value=True).success, "armed")
    stack.wait(lambda: stack.height(0) > 1.5, "the UAV has taken off")
    stack.wait_state(0, mode="AUTO.LOITER")
    begin = len(states.messages)
    uav.go(*UAV_GOAL)
    ugv.go(*UGV_GOAL)
    assert uav.end() == (GoalStatus.SUCCEEDED, "goal reached")
    assert ugv.end() == (GoalStatus.SUCCEEDED, "goal reached")
    for name, goal in ((UAV, UAV_GOAL), (UGV, UGV_GOAL)):
        place = states.last.pose[states.last.name.index(name)].position
        assert math.dist((place.x, place.y), goal[:2]) < 0.4
    assert stack.height(0) == pytest.approx(1.5, abs=0.15)
    distances = least_distances(states.since(begin), {UAV: 1.4, UGV: 0.2})
    assert all(distances[name] > RADII[name] for name in RADII), distances
    assert max(len(plan.poses) for plan in plans.messages) > 50
    assert not plans.last.poses  # reached: rviz shows none
    assert len(local.messages) > 20
    assert {100, 99} <= set(costs.last.data)

    plan = graph.call(f"/{UGV}/move_base/make_plan", GetPlan, goal=goal_at(*UGV_HOME).target_pose, tolerance=0.0).plan
    assert len(plan.poses) > 50
    assert plan.header.frame_id == "map"
    first, last = plan.poses[0].pose.position, plan.poses[-1].pose.position
    assert math.dist((first.x, first.y), UGV_GOAL[:2]) < 0.4
    assert (last.x, last.y) == UGV_HOME[:2]
    wall = goal_at(*IN_WALL).target_pose
    assert not graph.call(f"/{UGV}/move_base/make_plan", GetPlan, goal=wall, tolerance=0.2).plan.poses
    near = graph.call(f"/{UGV}/move_base/make_plan", GetPlan, goal=wall, tolerance=3.0).plan.poses[-1].pose.position
    assert math.dist((near.x, near.y), IN_WALL[:2]) <= 3.0
    wall.header.frame_id = "odom"
    with pytest.raises(rospy.ServiceException, match="goal: frame 'odom' is not allowed, 'map'"):
        graph.call(f"/{UGV}/move_base/make_plan", GetPlan, goal=wall, tolerance=0.0)
    known = [len(message.data) - message.data.count(-1) for message in whole.messages]
    begin = len(whole.messages)
    graph.call(f"/{UAV}/move_base/clear_costmaps", Empty)  # it contains the present view, not the rooms that it passed
    stack.wait(lambda: any(len(m.data) - m.data.count(-1) < 0.8 * known[-1] for m in whole.since(begin)), "forgotten")

    ugv.go(*IN_WALL)
    uav.go(14.0, 7.0, 0.0)
    stack.wait(lambda: uav.action.get_state() == GoalStatus.ACTIVE, "the UAV's goal is pursued")
    uav.action.cancel_goal()
    assert uav.end()[0] == GoalStatus.PREEMPTED
    status, text = ugv.end()
    assert status == GoalStatus.ABORTED
    assert "from an obstacle" in text
    shown = [entry for message in reports.messages for entry in message.status if entry.name == f"{UGV}: navigation"]
    assert any(entry.level == 1 and "recovering: turning" in entry.message for entry in shown)
    stack.wait(lambda: any("goal aborted: the goal is" in e.message for m in reports.messages for e in m.status), "why")

    ugv.action.cancel_all_goals()
    simple = PoseStamped(pose=goal_at(26.0, 5.0, 0.0).target_pose.pose)
    simple.header.frame_id = "odom"
    graph.say(f"/{UGV}/move_base_simple/goal", simple)
    stack.log_has("ugv", "goal: frame 'odom' is not allowed, 'map'; rejected")
