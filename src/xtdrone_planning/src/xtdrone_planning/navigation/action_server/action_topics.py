"""The topics of move_base's action server, on which actionlib's clients send goals.

Debian's actionlib answers in its own threads; here messages are processed and sent in the turns of the lockstep.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import rospy
from actionlib_msgs.msg import GoalID, GoalStatus, GoalStatusArray
from geometry_msgs.msg import PoseStamped
from move_base_msgs.msg import MoveBaseActionFeedback, MoveBaseActionGoal, MoveBaseActionResult

from xtdrone_control import lockstep
from xtdrone_planning.navigation.action_server.action_goals import PREEMPTED, ActionGoal, ActionGoals
from xtdrone_planning.navigation.settings import NavigationGoalError

_STATUS_PERIOD = 0.2  # s


class ActionTopics:
    """The action server ``move_base``.

    Attributes:
        goals: the goals and their status.
    """

    def __init__(self, base: str, begin: Callable[[PoseStamped], None], stop: Callable[[], None]) -> None:
        """Declare the topics.

        Args:
            base: prefix of the topics, as ``/iris_2d_lidar_0/move_base``.
            begin: called with each new goal; raises NavigationGoalError if it is not allowed.
            stop: called when the active goal is cancelled.
        """
        self._begin, self._stop = begin, stop
        self._status = lockstep.Publisher(f"{base}/status", GoalStatusArray, latch=True)
        self._feedback = lockstep.Publisher(f"{base}/feedback", MoveBaseActionFeedback)
        self._result = lockstep.Publisher(f"{base}/result", MoveBaseActionResult)
        lockstep.Subscriber(f"{base}/goal", MoveBaseActionGoal, self._on_goal)
        lockstep.Subscriber(f"{base}/cancel", GoalID, self._on_cancel)
        self._count = 0
        self.restart()

    def restart(self) -> None:
        """Forget all goals, because simulated time was reset."""
        self.goals = ActionGoals()
        self._sent = -math.inf

    def take(self, pose: PoseStamped) -> None:
        """Accept a goal from another topic, as move_base does with ``move_base_simple/goal``."""
        self._count += 1
        now = rospy.get_time()
        self._accept(f"move_base_simple-{self._count}-{now:.3f}", 0.0, pose)

    def _on_goal(self, message: MoveBaseActionGoal) -> None:
        goal, now = message.goal_id, rospy.get_time()
        stamp = goal.stamp.to_sec()
        self._accept(goal.id or f"move_base-{stamp:.9f}-{now:.3f}", stamp, message.goal.target_pose)

    def _accept(self, name: str, stamp: float, pose: PoseStamped) -> None:
        now = rospy.get_time()
        if not self.goals.admits(name, stamp, now):
            return  # rejected before the vehicle acts on it: the active goal continues
        try:
            self._begin(pose)
        except NavigationGoalError as error:
            rospy.logwarn(f"move_base: {error}; rejected")
            self.goals.reject(name, stamp, str(error), now)
            return
        self.goals.accept(name, stamp, now)

    def _on_cancel(self, message: GoalID) -> None:
        now = rospy.get_time()
        if self.goals.cancels(message.id, message.stamp.to_sec(), now):
            self._stop()
            self.goals.end(PREEMPTED, "cancelled", now)

    def publish(self, base: PoseStamped | None, stamp: rospy.Time) -> None:
        """Publish results, feedback and, five times a second or after a result, the status.

        Args:
            base: pose of the vehicle in map; None: unknown, no feedback is published.
            stamp: the current time.
        """
        now, results = stamp.to_sec(), self.goals.results()
        if results or now - self._sent >= _STATUS_PERIOD:
            self._sent = now
            status = GoalStatusArray(status_list=[_status(goal) for goal in self.goals.listed(now)])
            status.header.stamp = stamp
            self._status.publish(status)
        for goal in results:
            result = MoveBaseActionResult(status=_status(goal))
            result.header.stamp = stamp
            self._result.publish(result)
        present = self.goals.present
        if base is not None and present is not None and self._feedback.get_num_connections():
            feedback = MoveBaseActionFeedback(status=_status(present))
            feedback.header.stamp, feedback.feedback.base_position = stamp, base
            self._feedback.publish(feedback)


def _status(goal: ActionGoal) -> GoalStatus:
    return GoalStatus(GoalID(rospy.Time.from_sec(goal.stamp), goal.name), goal.status, goal.text)
