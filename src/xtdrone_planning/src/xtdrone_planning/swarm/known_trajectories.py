"""What a vehicle has heard of the trajectories of others."""

from __future__ import annotations

from dataclasses import dataclass, field

from xtdrone_planning.trajectories.splines.uniform_spline import UniformSpline

FORGET = 1.5  # s after its start; a proposal of which no decision was heard until then was dropped by its vehicle


@dataclass(frozen=True)
class Proposal:
    """A trajectory that a vehicle wants to fly, unless another objects.

    Attributes:
        number: counts the vehicle's trajectories.
        spline: the trajectory; until it begins the vehicle follows the one that it has decided on.
        made: ROS time of its making, s.
        rank: of the vehicle: of two proposals of the same time that of the lower one counts.
    """

    number: int
    spline: UniformSpline
    made: float
    rank: int

    def precedes(self, other: Proposal) -> bool:
        """Return whether this one counts, if both cannot be flown."""
        return (self.made, self.rank) < (other.made, other.rank)


@dataclass
class Known:
    """What was heard of one vehicle.

    Attributes:
        radius: of the vehicle, m.
        number: of the trajectory that it has decided on, -1: none was heard.
        decided: this trajectory.
        proposals: those of which no decision was heard, by number.
    """

    radius: float
    number: int = -1
    decided: UniformSpline | None = None
    proposals: dict[int, Proposal] = field(default_factory=dict)

    def on_decided(self, number: int, spline: UniformSpline) -> None:
        """Store the trajectory that the vehicle flies; an older one, overtaken on its way, is ignored."""
        if number >= self.number:
            self.number, self.decided = number, spline
            self.proposals = {n: entry for n, entry in self.proposals.items() if n > number}

    def on_proposal(self, proposal: Proposal) -> None:
        """Store a proposal, unless it has been decided on."""
        if proposal.number > self.number:
            self.proposals[proposal.number] = proposal

    def forget(self, now: float) -> None:
        """Forget proposals that were dropped."""
        self.proposals = {n: entry for n, entry in self.proposals.items() if now <= entry.spline.start + FORGET}

    def trajectories(self) -> list[UniformSpline]:
        """Return every trajectory that the vehicle may fly."""
        decided = [] if self.decided is None else [self.decided]
        return decided + [self.proposals[n].spline for n in sorted(self.proposals)]
