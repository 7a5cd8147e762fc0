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

    Attributes:
        radius: of the vehicle, m.
        number: of its committed trajectory, -1: none received.
        decided: its committed trajectory.
        proposals: undecided ones, by number.
    """

    radius: float
    number: int = -1
    decided: UniformSpline | None = None
    proposals: dict[int, Proposal] = field(default_factory=dict)

    def on_decided(self, number: int, spline: UniformSpline) -> None:
        """Store the trajectory that the vehicle flies; an older one that arrives late is ignored."""
        if number >= self.number:
            self.number, self.decided = number, spline
            self.proposals = {n: entry for n, entry in self.proposals.items() if n > number}

    def on_proposal(self, proposal: Proposal) -> None:
        """Store a proposal, unless it is already decided."""
        if proposal.number > self.number:
            self.proposals[proposal.number] = proposal

    def forget(self, now: float) -> None:
        """Discard dropped proposals."""
        self.proposals = {n: entry for n, entry in self.proposals.items() if now <= entry.spline.start + FORGET}

    def trajectories(self) -> list[UniformSpline]:
        """Return all trajectories that the vehicle may fly."""
        decided = [] if self.decided is None else [self.decided]
        return decided + [self.proposals[n].spline for n in sorted(self.proposals)]
