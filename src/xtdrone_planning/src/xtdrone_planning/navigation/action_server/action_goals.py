"""Goals of an action server, without ROS: one goal at a time, as in ROS's SimpleActionServer.

States and their numbers are those of actionlib_msgs/GoalStatus (http://wiki.ros.org/actionlib/DetailedDescription). A
new goal preempts the current one; ended goals remain in the status for ``_KEPT`` s, for clients that connect late.
"""

from __future__ import annotations

from dataclasses import dataclass

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

    def listed(self, now: float) -> list[ActionGoal]:
        """Return the goals of the status message: the active one, and the most recent ended ones."""
        ended = [goal for goal in self.goals if goal.ended is not None and now - goal.ended <= _KEPT]
        kept = {id(goal) for goal in ended[-_MOST_ENDED:]}
        self.goals = [goal for goal in self.goals if goal is self.present or id(goal) in kept]
        return self.goals

    def _end(self, goal: ActionGoal, status: int, text: str, now: float) -> None:
        goal.status, goal.text, goal.ended = status, text, now
        self._ended.append(goal)
