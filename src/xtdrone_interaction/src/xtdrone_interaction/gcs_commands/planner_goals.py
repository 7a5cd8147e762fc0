"""Goals for the planners of vehicles, over ROS: ``xtdrone gcs goto --avoid``."""

from __future__ import annotations

import os
import threading
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from xtdrone_common.settings import SettingError
from xtdrone_interaction import simulation_services
from xtdrone_interaction.gcs.vehicle_addresses import GcsError
from xtdrone_planning.planner_settings import GoalError, PlannerSettings

_CONNECTIONS = 5.0  # s of wall time for the connections to the planners
_REPORT = 3.0  # s of wall time for a report of the vehicle

Goal = tuple[float, float, float]


def send_goals(goals: Mapping[str, Goal], master: str = "") -> dict[str, GcsError | None]:
    """Hand goals to the vehicles' planners (``planner.py``), which avoid the obstacles that the sensors see.

    Args:
        goals: x, y, z by name of the vehicle, m in map.
        master: port or URI of the ROS master; empty: the environment's, or that of the newest flight of this workspace.

    Returns:
        Per vehicle None, or the reason why it does not fly there.

    Raises:
        GcsError: there is no simulation on a ROS master.
        argparse.ArgumentTypeError: ``master`` is neither.
    """
    try:
        given = simulation_services.master_uri(master) if master else ""
        uri, _ = simulation_services.choose_master(
            given, os.environ.get("ROS_MASTER_URI", ""), [simulation_services.RUNS]
        )
    except simulation_services.SimError as error:
        raise GcsError(str(error)) from error
    os.environ["ROS_MASTER_URI"] = uri

    from xtdrone_common.programs.plain_node import init_plain_node

    try:
        subscribers = _subscribers()
    except OSError as error:
        raise GcsError(f"master: none answers at {uri}: {error}") from error
    init_plain_node("xtdrone_gcs", anonymous=True, disable_signals=True)
    return {name: _send(name, goal, subscribers.get(f"/{name}/planner/goal", [])) for name, goal in goals.items()}


def _subscribers() -> dict[str, list[str]]:
    import rosgraph

    _, subscribers, _ = rosgraph.Master("/xtdrone_gcs").getSystemState()
    return dict(subscribers)


def _send(name: str, goal: Goal, planners: Sequence[str]) -> GcsError | None:
    """Send a goal to one vehicle; return why it cannot be flown."""
    import rospy
    from geometry_msgs.msg import PoseStamped
    from mavros_msgs.msg import ExtendedState

    if not planners:
        return GcsError(f"{name}: no planner; start one: rosrun xtdrone_planning planner.py {_arguments(name)}")
    try:
        _settings_of(planners[0]).check_goal(np.array(goal))
        landed = rospy.wait_for_message(f"/{name}/mavros/extended_state", ExtendedState, _REPORT).landed_state
    except (GoalError, SettingError) as error:
        return GcsError(f"{name}: {error}")
    except rospy.ROSException:
        return GcsError(f"{name}: no report on /{name}/mavros/extended_state")
    if landed == ExtendedState.LANDED_STATE_ON_GROUND:
        return GcsError(f"{name}: goto: the vehicle is on the ground")
    message = PoseStamped()
    message.header.stamp, message.header.frame_id = rospy.Time.now(), "map"
    place = message.pose.position
    place.x, place.y, place.z = goal
    message.pose.orientation.w = 1.0
    connected = threading.Event()
    listener = rospy.SubscribeListener()
    listener.peer_subscribe = lambda *_: connected.set()
    topic = f"/{name}/planner/goal"
    publisher = rospy.Publisher(topic, PoseStamped, listener, queue_size=1, latch=True)
    if not connected.wait(_CONNECTIONS):
        return GcsError(f"{name}: {planners[0]} does not connect")
    publisher.publish(message)
    return None


def _settings_of(planner: str) -> PlannerSettings:
    """Return the settings of a running planner, by the name of its node."""
    import rospy

    def get(name: str, default: Any) -> Any:
        return rospy.get_param(f"{planner}/{name.removeprefix('~')}", default)

    return PlannerSettings.from_parameters(get, names=("lowest", "highest"))


def _arguments(name: str) -> str:
    kind, _, index = name.rpartition("_")
    return f"{kind} {index}"
