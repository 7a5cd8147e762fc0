"""Topics on which vehicles exchange their planned trajectories.

For each vehicle ``T``; the topics of others come by ``radio.py``:

==============================  =============================  ======================================================
topic                           type                           meaning
==============================  =============================  ======================================================
/T/planner/trajectory           xtdrone_msgs/SplineTrajectory  out: committed trajectory, repeated in case of loss
/T/planner/proposal             xtdrone_msgs/SplineTrajectory  out: proposal, repeated; stamp: time of its creation
/T/radio/planner/trajectory     xtdrone_msgs/SplineTrajectory  in: of all others
/T/radio/planner/proposal       xtdrone_msgs/SplineTrajectory  in
==============================  =============================  ======================================================
"""

from __future__ import annotations

from collections.abc import Sequence

import rospy
from xtdrone_msgs.msg import SplineTrajectory

import xtdrone_lockstep as lockstep
from xtdrone_planning.replanning.swarm_planner import Proposal, SwarmPlanner
from xtdrone_planning.trajectories.splines.uniform_spline import UniformSpline
from xtdrone_planning.trajectories.trajectory_messages import TrajectoryError, spline_message, spline_of

_OFTEN, _SELDOM = 0.1, 0.5  # s between repetitions: of new trajectories and proposals, of older ones
_NEWS = 0.6  # s


class SwarmTopics:
    """ROS topics of one vehicle."""

    def __init__(self, name: str, fleet: Sequence[str], planner: SwarmPlanner, frame: str) -> None:
        """Declare the topics.

        Args:
            name: Name of the vehicle.
            fleet: names of all.
            planner: receives the messages.
            frame: Frame of the points.
        """
        self._name, self._planner, self._frame = name, planner, frame
        self._ranks = {other: rank for rank, other in enumerate(fleet) if other != name}
        self._trajectory = lockstep.Publisher(f"/{name}/planner/trajectory", SplineTrajectory, latch=True)
        self._proposal = lockstep.Publisher(f"/{name}/planner/proposal", SplineTrajectory)
        lockstep.Subscriber(f"/{name}/radio/planner/trajectory", SplineTrajectory, self._on_trajectory)
        lockstep.Subscriber(f"/{name}/radio/planner/proposal", SplineTrajectory, self._on_proposal)
        self.restart()

    def restart(self) -> None:
        """Begin again, because simulated time was reset."""
        self._number = self._proposed = -1
        self._since = self._said = self._asked = -1e9

    def publish(self, stamp: rospy.Time) -> None:
        """Publish the committed and the proposed trajectory, if due."""
        planner, now = self._planner, stamp.to_sec()
        if planner.trajectory is not None:
            if planner.number != self._number:
                self._number, self._since, self._said = planner.number, now, -1e9
            if now - self._said >= (_OFTEN if now - self._since < _NEWS else _SELDOM):
                self._said = now
                self._trajectory.publish(self._message(planner.trajectory, planner.number, stamp))
        proposal = planner.proposal
        if proposal is not None and (proposal.number != self._proposed or now - self._asked >= _OFTEN):
            self._proposed, self._asked = proposal.number, now
            made = rospy.Time.from_sec(proposal.made)
            self._proposal.publish(self._message(proposal.spline, proposal.number, made))

    def _message(self, spline: UniformSpline, number: int, stamp: rospy.Time) -> SplineTrajectory:
        return spline_message(spline, self._name, number, self._planner.limits.radius, stamp, self._frame)

    def _on_trajectory(self, message: SplineTrajectory) -> None:
        if (found := self._heard(message)) is not None:
            rank, spline = found
            self._planner.on_decided(rank, message.id, spline, message.radius)

    def _on_proposal(self, message: SplineTrajectory) -> None:
        if (found := self._heard(message)) is not None:
            rank, spline = found
            proposal = Proposal(message.id, spline, message.header.stamp.to_sec(), rank)
            self._planner.on_proposal(proposal, message.radius)

    def _heard(self, message: SplineTrajectory) -> tuple[int, UniformSpline] | None:
        """Return the sender's rank and its trajectory; warn and return None if the message is invalid."""
        rank = self._ranks.get(message.vehicle)
        if rank is None:
            rospy.logwarn_throttle_identical(5.0, f"{self._name}: {message.vehicle!r} is not in the fleet; ignored")
            return None
        try:
            return rank, spline_of(message, rospy.get_time())
        except TrajectoryError as error:
            rospy.logwarn_throttle_identical(5.0, f"{self._name}: trajectory of {message.vehicle}: {error}; ignored")
            return None
