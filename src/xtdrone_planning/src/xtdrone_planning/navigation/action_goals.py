"""The goals of an action server, without ROS: one goal at a time, as ROS's SimpleActionServer.

States and their numbers are those of actionlib_msgs/GoalStatus (http://wiki.ros.org/actionlib/DetailedDescription). A
new goal preempts the present one; ended goals remain in the status for some seconds, for clients that are late.
"""

from __future__ import annotations

from dataclasses import dataclass

PENDING, ACTIVE, PREEMPTED, SUCCEEDED, ABORTED, REJECTED = range(6)
RECALLED = 8
_KEPT = 5.0  # s that ended goals remain in the status
_MOST = 100  # goals in the status


@dataclass
class ActionGoal:
    """A goal.

    Attributes:
        name: its id.
        stamp: when it was sent, s.
        status: see above.
        text: why.
        ended: when, s of ROS time; None while it is pursued.
    """

    name: str
    stamp: float
    status: int = PENDING
    text: str = ""
    ended: float | None = None


class ActionGoals:
    """Goals and their status.

    Attributes:
        goals: all that the status lists, oldest first.
        present: the goal that is pursued, None without one.
    """

    def __init__(self) -> None:
        """Start without goals."""
        self.goals: list[ActionGoal] = []
        self.present: ActionGoal | None = None
        self._ended: list[ActionGoal] = []
        self._cancelled_to = 0.0

    def accept(self, name: str, stamp: float, now: float) -> ActionGoal:
        """Make a goal the present one, in place of the last; an id that is pursued or has ended is not repeated.

        Args:
            name: its id.
            stamp: when it was sent, s; 0: unknown.
            now: s of ROS time.

        Returns:
            The goal; not ACTIVE if it was cancelled before it came, or its id is known.
        """
        known = next((goal for goal in self.goals if goal.name == name), None)
        if known is not None:
            return ActionGoal(name, stamp, known.status)
        goal = ActionGoal(name, stamp)
        self.goals.append(goal)
        if 0.0 < stamp <= self._cancelled_to:
            self._end(goal, RECALLED, "cancelled before it was received", now)
            return goal
        self.end(PREEMPTED, "another goal was received", now)
        goal.status, self.present = ACTIVE, goal
        return goal

    def reject(self, name: str, stamp: float, text: str, now: float) -> None:
        """Refuse a goal; the present one stays."""
        goal = ActionGoal(name, stamp)
        self.goals.append(goal)
        self._end(goal, REJECTED, text, now)

    def cancels(self, name: str, stamp: float, now: float) -> bool:
        """Apply a cancel message; return whether the present goal is cancelled.

        Args:
            name: id; empty, and ``stamp`` 0: all goals.
            stamp: goals sent up to then are cancelled, too, s.
            now: s of ROS time.
        """
        self._cancelled_to = max(self._cancelled_to, stamp)
        goal = self.present
        if goal is None:
            return False
        return (not name and stamp == 0.0) or goal.name == name or 0.0 < goal.stamp <= stamp

    def end(self, status: int, text: str, now: float) -> None:
        """End the present goal, if there is one."""
        if self.present is not None:
            goal, self.present = self.present, None
            self._end(goal, status, text, now)

    def results(self) -> list[ActionGoal]:
        """Return the goals that have ended since the last call."""
        ended, self._ended = self._ended, []
        return ended

    def listed(self, now: float) -> list[ActionGoal]:
        """Return the goals of the status message, without those that ended long ago."""
        self.goals = [goal for goal in self.goals if goal.ended is None or now - goal.ended <= _KEPT][-_MOST:]
        return self.goals

    def _end(self, goal: ActionGoal, status: int, text: str, now: float) -> None:
        goal.status, goal.text, goal.ended = status, text, now
        self._ended.append(goal)
