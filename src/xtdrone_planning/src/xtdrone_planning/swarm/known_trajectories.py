"""Trajectories of other vehicles as received by radio."""

from __future__ import annotations

from dataclasses import dataclass, field

from xtdrone_planning.trajectories.splines.uniform_spline import UniformSpline

FORGET = 1.5  # s after its start; a proposal without a decision by then was dropped by its vehicle


@dataclass(frozen=True)
class Proposal:
    """A trajectory that a vehicle proposes to fly, unless another vehicle objects.

    Attributes:
        number: counts the vehicle's trajectories.
        spline: the trajectory; until it begins, the vehicle follows its last committed one.
        made: ROS time of its creation, s.
        rank: of the vehicle; of two proposals with the same time, the lower rank takes precedence.
    """

    number: int
    spline: UniformSpline
    made: float
    rank: int

    def precedes(self, other: Proposal) -> bool:
        """Return whether this proposal takes precedence over a conflicting one."""
        return (self.made, self.rank) < (other.made, other.rank)


@dataclass
class Known:
    """Data received from one vehicle.

    The order of its messages is that of their times: its numbers begin again when its planner is restarted.

    Attributes:
        radius: of the vehicle, m.
        number: of its committed trajectory, -1: none received.
        decided: its committed trajectory.
        proposals: undecided ones, by number.
    """

    radius: float = 0.0
    number: int = -1
    decided: UniformSpline | None = None
    proposals: dict[int, Proposal] = field(default_factory=dict)

    def on_decided(self, number: int, spline: UniformSpline, radius: float) -> None:
        """Store the trajectory that the vehicle flies; an older one that arrives late is ignored."""
        if self.decided is not None and spline.start < self.decided.start:
            return
        self.number, self.decided, self.radius = number, spline, radius
        self.proposals = {n: entry for n, entry in self.proposals.items() if self._is_open(entry)}

    def on_proposal(self, proposal: Proposal, radius: float) -> None:
        """Store a proposal, unless it is already decided."""
        if self._is_open(proposal):
            self.proposals[proposal.number], self.radius = proposal, radius

    def _is_open(self, proposal: Proposal) -> bool:
        """Return whether a proposal is later than the committed trajectory: a vehicle proposes one at a time."""
        decided = self.decided
        return decided is None or (proposal.made >= decided.start and proposal.number != self.number)

    def forget(self, now: float) -> None:
        """Discard dropped proposals."""
        self.proposals = {n: entry for n, entry in self.proposals.items() if now <= entry.spline.start + FORGET}

    def trajectories(self) -> list[UniformSpline]:
        """Return all trajectories that the vehicle may fly."""
        decided = [] if self.decided is None else [self.decided]
        return decided + [self.proposals[n].spline for n in sorted(self.proposals)]
