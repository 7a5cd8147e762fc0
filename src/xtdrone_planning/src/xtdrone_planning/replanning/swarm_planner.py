"""Planner of one vehicle in a group whose vehicles coordinate their trajectories by radio.

A new trajectory is first proposed; it branches off the current one some time ahead. If no conflicting trajectory is
received within this time, the vehicle commits to it; otherwise it is dropped, and the vehicle stays on its committed
trajectory, which ends at rest and is clear of all others. The check during a delay is that of K. Kondo et al., Robust
MADER: decentralized and asynchronous multiagent trajectory planner robust to communication delay, ICRA 2023, after J.
Tordesillas, J. How, MADER, IEEE Transactions on Robotics 38, 2022. Of two conflicting proposals, the earlier one takes
precedence; its vehicle may ignore the later one, whose vehicle receives the earlier one within its own check period.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from xtdrone_planning.mapping.voxel_grid import VoxelGrid
from xtdrone_planning.planner_settings import AgreementSettings, PlannerSettings, TrajectorySettings
from xtdrone_planning.replanning.flight_states import PlannerCommand, Situation
from xtdrone_planning.replanning.planner import LEAST_WAY, Planner
from xtdrone_planning.trajectories.local_trajectory import State, conflict_time, plan_along
from xtdrone_planning.trajectories.moving_vehicles import MovingVehicles
from xtdrone_planning.trajectories.speed_profile import length_of
from xtdrone_planning.trajectories.splines.uniform_spline import UniformSpline

FORGET = 1.5  # s after its start; a proposal without a decision by then was dropped by its vehicle


@dataclass(frozen=True)
class Proposal:
    """A trajectory that a vehicle proposes to fly, unless another vehicle objects.

    Attributes:
        number: counts the vehicle's trajectories.
        spline: the trajectory; until it begins, the vehicle follows its last committed one.
        made: ROS time of its creation, s.
        rank: Rank of the vehicle; of two proposals with the same time, the lower rank takes precedence.
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
        radius: Radius of the vehicle, m.
        number: Number of its committed trajectory, -1: none received.
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


Array = NDArray[np.float64]

_SAME_PLACE = 0.05  # m
_OFF = 0.3  # m that other vehicles may be off their trajectories
_BRAKING = 1.0  # s before an obstacle on the current trajectory, within which the vehicle brakes instead of waiting


class SwarmPlanner(Planner):
    """Plans for one vehicle of a group.

    Attributes:
        rank: number of the vehicle in the fleet.
        proposal: the trajectory open to objections, or None.
        dropped: number of proposals that were dropped.
    """

    def __init__(
        self,
        grid: VoxelGrid,
        settings: PlannerSettings,
        limits: TrajectorySettings,
        swarm: AgreementSettings,
        rank: int,
        timed: Callable[[], AbstractContextManager[None]] = nullcontext,
    ) -> None:
        """Start waiting.

        Args:
            grid, settings, limits, timed: see ``Planner``.
            swarm: settings of the coordination.
            rank: see above.
        """
        self.swarm, self.rank = swarm, rank
        self._known: dict[int, Known] = {}
        super().__init__(grid, settings, limits, timed)

    def restart(self) -> None:
        """Forget everything."""
        super().restart()
        self._known.clear()
        self.proposal: Proposal | None = None
        self.dropped = 0
        self._made = 0
        self._pause_until = -math.inf

    def on_decided(self, rank: int, number: int, spline: UniformSpline, radius: float) -> None:
        """Receive the committed trajectory of another vehicle."""
        self._of(rank).on_decided(number, spline, radius)

    def on_proposal(self, proposal: Proposal, radius: float) -> None:
        """Receive the proposed trajectory of another vehicle."""
        self._of(proposal.rank).on_proposal(proposal, radius)

    def step(self, now: Situation) -> PlannerCommand | None:
        """Decide on the proposal if it is due, then run one cycle."""
        for known in self._known.values():
            known.forget(now.time)
        self._judge(now.time)
        command = super().step(now)
        if self.trajectory is None:
            self.proposal = None
        return command

    @property
    def is_undecided(self) -> bool:
        """Whether a proposal is open to objections."""
        return self.proposal is not None

    def plan(self, now: Situation, start: State) -> bool:
        """Propose a trajectory, unless one is pending; return whether one is pending.

        A proposal starts from the current trajectory. From elsewhere, e.g. after a gust, a trajectory that is clear of
        everything the others may fly begins immediately, and they are informed.
        """
        trajectory = self.trajectory
        if trajectory is None or np.linalg.norm(trajectory.at(now.time)[0] - start.position) > _SAME_PLACE:
            self._abandon()
            return super().plan(now, start)
        if self.proposal is None and now.time < self._pause_until and now.time >= trajectory.end:
            return False  # at rest
        if self.proposal is not None or now.time < self._pause_until:
            return self.conflict(now) > now.time + self.swarm.check + _BRAKING
        begin = now.time + self.swarm.check
        return super().plan(replace(now, time=begin), State(*trajectory.at(begin)))

    def hold(self, position: Array, time: float) -> None:
        """Hover at a position immediately, and inform the others."""
        self._abandon()
        super().hold(position, time)

    def can_brake(self, time: float) -> bool:
        """Return whether braking is clear of all others, who know only the trajectory that it shortens."""
        return math.isinf(self._others(None).conflict_time(self._braking(time), time))

    def brake(self, time: float) -> None:
        """Brake along the current path immediately, and inform the others."""
        self._abandon()
        super().brake(time)

    def stop_from(self, state: State, time: float) -> None:
        """Stop from a state immediately, and inform the others."""
        self._abandon()
        super().stop_from(state, time)

    def places_of_others(self, time: float) -> tuple[Array, Array]:
        """Return the positions (n, 3), m in map, of the others at a ROS time, s, and the radii (n,), m, around them.

        Each vehicle is within its radius of its position, unless it deviates from its trajectory by more than ``_OFF``.
        """
        flown = [(known.decided, known.radius) for known in self._known.values() if known.decided is not None]
        places = np.array([_place_before_or_on(spline, time) for spline, _ in flown]).reshape(-1, 3)
        return places, np.array([radius + _OFF for _, radius in flown])

    def _trajectory_along(self, corners: Array, start: State, time: float) -> UniformSpline | None:
        others = self._others(None)
        found = plan_along(self.grid, corners, start, time, self.limits, others, self.settings.heights)
        return found if found is not None or not len(others) else self._trajectory_round(others, start, time)

    def _trajectory_round(self, others: MovingVehicles, start: State, time: float) -> UniformSpline | None:
        """Return a trajectory on a path around the positions where others come to rest, or None.

        The path on the map may lead through a waiting vehicle, which deforming a trajectory along it cannot avoid.
        """
        clearance = self.limits.clearance(self.grid.resolution)
        self.path = path = self._find_path(start.position, others.near_rest(self.grid, clearance))
        if length_of(path.points) < LEAST_WAY and not path.is_whole:
            return None
        return plan_along(self.grid, path.points, start, time, self.limits, others, self.settings.heights)

    def _fly(self, trajectory: UniformSpline) -> None:
        """Propose trajectories that begin later; fly those that begin immediately."""
        self._made += 1
        if self._planning_ahead(trajectory):
            self.proposal = Proposal(self._made, trajectory, trajectory.start - self.swarm.check, self.rank)
            return
        self.trajectory, self.number = trajectory, self._made

    def _planning_ahead(self, trajectory: UniformSpline) -> bool:
        return self.trajectory is not None and trajectory.start > self._turn_time

    def _judge(self, now: float) -> None:
        self._turn_time = now
        proposal = self.proposal
        if proposal is None:
            return
        if not math.isinf(self._others(proposal).conflict_time(proposal.spline, min(now, proposal.spline.start))):
            self.proposal = None
            self.dropped += 1
            self._pause_until = now + self.swarm.pause * (1 + self.rank % 3) / 3.0
        elif not math.isinf(conflict_time(self.grid, proposal.spline, now, self.limits, unknown=False)):
            self.proposal = None
        elif now >= proposal.spline.start:
            self.trajectory, self.number = proposal.spline, proposal.number
            self.proposal = None
            self._pause_until = now + self.swarm.pause

    def _others(self, against: Proposal | None) -> MovingVehicles:
        """Return the trajectories that others may fly, without proposals that must yield to ``against``."""
        splines: list[UniformSpline] = []
        distances: list[float] = []
        for rank in sorted(self._known):
            known = self._known[rank]
            found = known.trajectories() if against is None else [
                *([] if known.decided is None else [known.decided]),
                *(known.proposals[n].spline for n in sorted(known.proposals) if known.proposals[n].precedes(against)),
            ]  # fmt: skip
            splines += found
            distances += [self.limits.radius + known.radius + self.swarm.separation] * len(found)
        return MovingVehicles(splines, distances)

    def _of(self, rank: int) -> Known:
        return self._known.setdefault(rank, Known())

    def _abandon(self) -> None:
        self.proposal = None


def _place_before_or_on(spline: UniformSpline, time: float) -> Array:
    """Return the position (3,), m in map, at a time, s: before the start, at the initial velocity towards it.

    The trajectory branches off smoothly from the one that the vehicle flies until then, which is not known any more.
    """
    place, velocity, _ = spline.at(time)
    return place - max(0.0, spline.start - time) * velocity
