"""The action server of move_base: its goals, one at a time as in ROS's SimpleActionServer, and its topics.

States and their numbers are those of actionlib_msgs/GoalStatus (http://wiki.ros.org/actionlib/DetailedDescription). A
new goal preempts the current one; ended goals remain in the status for ``_KEPT`` s, for clients that connect late.
Debian's actionlib answers in its own threads; here messages are processed and sent in the turns of the lockstep.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import rospy
from actionlib_msgs.msg import GoalID, GoalStatus, GoalStatusArray
from geometry_msgs.msg import PoseStamped
from move_base_msgs.msg import MoveBaseActionFeedback, MoveBaseActionGoal, MoveBaseActionResult

import xtdrone_lockstep as lockstep
from xtdrone_planning.navigation.settings import NavigationGoalError

PENDING, ACTIVE, PREEMPTED, SUCCEEDED, ABORTED, REJECTED = range(6)
RECALLED = 8
_KEPT = 5.0  # s for which ended goals remain in the status
_MOST_ENDED = 100  # ended goals in the status


@dataclass
class ActionGoal:
    """A goal.

    Attributes:
        name: its id.
        stamp: when it was sent, s of ROS time; 0: unknown.
        status: number of actionlib_msgs/GoalStatus.
        text: reason of the status.
        ended: when it ended, s of ROS time; None while it is active.
    """

    name: str
    stamp: float
    status: int = PENDING
    text: str = ""
    ended: float | None = None


class ActionGoals:
    """Goals and their status.

    Attributes:
        goals: the goals listed in the status, oldest first.
        present: the active goal, or None.
    """

    def __init__(self) -> None:
        """Start without goals."""
        self.goals: list[ActionGoal] = []
        self.present: ActionGoal | None = None
        self._ended: list[ActionGoal] = []
        self._cancelled_to = 0.0

    def admits(self, name: str, stamp: float, now: float) -> bool:
        """Return whether a received goal may be accepted; the active goal is unchanged.

        A goal whose id is already in the status is a repetition, and is ignored. One overtaken by its cancel message is
        listed as RECALLED.

        Args:
            name: its id.
            stamp: when it was sent, s of ROS time; 0: unknown.
            now: s of ROS time.
        """
        if any(goal.name == name for goal in self.goals):
            return False
        if 0.0 < stamp <= self._cancelled_to:
            goal = ActionGoal(name, stamp)
            self.goals.append(goal)
            self._end(goal, RECALLED, "cancelled before it was received", now)
            return False
        return True

    def accept(self, name: str, stamp: float, now: float) -> None:
        """Make an admitted goal the active one; the previous one is preempted. See ``admits``."""
        self.end(PREEMPTED, "another goal was received", now)
        self.present = ActionGoal(name, stamp, ACTIVE)
        self.goals.append(self.present)

    def reject(self, name: str, stamp: float, text: str, now: float) -> None:
        """Reject a goal for the reason ``text``; the active goal is unchanged. See ``admits``."""
        goal = ActionGoal(name, stamp)
        self.goals.append(goal)
        self._end(goal, REJECTED, text, now)

    def cancels(self, name: str, stamp: float, now: float) -> bool:
        """Apply a cancel message; return whether the active goal is cancelled.

        Args:
            name: id of the goal to cancel; empty, and ``stamp`` 0: all goals.
            stamp: goals sent up to this time are cancelled too, s of ROS time; 0: none.
            now: s of ROS time.
        """
        self._cancelled_to = max(self._cancelled_to, stamp)
        goal = self.present
        if goal is None:
            return False
        return (not name and stamp == 0.0) or goal.name == name or 0.0 < goal.stamp <= stamp

    def end(self, status: int, text: str, now: float) -> None:
        """End the active goal, if any, with a status and its reason."""
        goal, self.present = self.present, None
        if goal is not None:
            self._end(goal, status, text, now)

    def results(self) -> list[ActionGoal]:
        """Return the goals that have ended since the last call."""
        ended, self._ended = self._ended, []
        return ended

    def list_recent(self, now: float) -> list[ActionGoal]:
        """Return the goals of the status message: the active one, and the most recent ended ones."""
        ended = [goal for goal in self.goals if goal.ended is not None and now - goal.ended <= _KEPT]
        kept = {id(goal) for goal in ended[-_MOST_ENDED:]}
        self.goals = [goal for goal in self.goals if goal is self.present or id(goal) in kept]
        return self.goals

    def _end(self, goal: ActionGoal, status: int, text: str, now: float) -> None:
        goal.status, goal.text, goal.ended = status, text, now
        self._ended.append(goal)


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
            status = GoalStatusArray(status_list=[_status(goal) for goal in self.goals.list_recent(now)])
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
