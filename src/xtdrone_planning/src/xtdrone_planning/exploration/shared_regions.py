"""Distributed division of a floor's regions among vehicles, by messages that may be delayed or lost.

Each vehicle broadcasts its regions twice a second. From time to time it proposes to another vehicle a new division of
the regions of both; the other accepts if its own regions have not changed since, and both apply the division (the
pairwise interaction of RACER, B. Zhou et al., IEEE Transactions on Robotics 39, 2023). A lost message may leave regions
with two owners, until their next proposal, or with none: the first vehicle of the fleet that is still heard takes
these. A vehicle silent for too long counts as lost, and its regions have no owner.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

STATE, PROPOSAL, ACCEPTANCE, REFUSAL = 0, 1, 2, 3

_PERIOD = 0.5  # s between two messages about the vehicle's own regions
_PAUSE, _IDLE_PAUSE = 2.0, 0.5  # s between two proposals: with regions of its own, and without
_PATIENCE = 1.5  # s to wait for an answer
_ORPHANED = 2.0  # s without an owner after which a region is taken

Place = tuple[float, float]
Regions = frozenset[int]
Divide = Callable[[Place, Regions, Regions], tuple[Regions, Regions]]
"""Maps (position of the other vehicle, own regions, its regions) to (own regions, its regions) after a division."""


@dataclass(frozen=True)
class Share:
    """A message.

    Attributes:
        vehicle: sender.
        kind: STATE, PROPOSAL, ACCEPTANCE or REFUSAL.
        number: Number of the sender's set of regions (STATE), or of the proposal.
        partner: recipient; empty: all.
        base: Base of a proposal: number of the partner's set on which it is based.
        place: position of the sender, x, y, m in map.
        target: position to which it flies, likewise; its own position if there is none.
        regions: Regions of the sender; in a proposal, those that it would own.
        partner_regions: Partner regions in a proposal, those that the partner would own.
    """

    vehicle: str
    kind: int
    number: int
    partner: str = ""
    base: int = 0
    place: Place = (0.0, 0.0)
    target: Place = (0.0, 0.0)
    regions: Regions = frozenset()
    partner_regions: Regions = frozenset()


@dataclass
class _Other:
    """Knowledge about another vehicle: time of its last message, its last state, and the last proposal to it."""

    heard: float
    state: Share | None = None
    asked: float = -math.inf


class Sharing:
    """The regions of one vehicle.

    Attributes:
        own: its regions.
        number: incremented with each change of its regions.
    """

    def __init__(self, name: str, fleet: Sequence[str], count: int, lost_after: float) -> None:
        """Start: the fleet's first vehicle owns all regions.

        Args:
            name: Name of the vehicle.
            fleet: names of all exploring vehicles.
            count: number of regions.
            lost_after: s, see ``lost``.
        """
        self._name, self._fleet = name, tuple(fleet)
        self._lost_after = lost_after
        self.own: Regions = frozenset(range(count)) if name == self._fleet[0] else frozenset()
        self.number = 0
        self._proposals = 0
        self._others: dict[str, _Other] = {}
        self._pending: tuple[Share, float] | None = None
        self._answers: list[Share] = []
        self._told = self._asked = -math.inf
        self._orphans: dict[int, float] = {}
        self._now = 0.0

    def targets(self) -> list[Place]:
        """Return the targets of the vehicles in contact."""
        return [state.target for other in self._alive() if (state := self._others[other].state) is not None]

    def lost(self) -> list[str]:
        """Return the lost vehicles: those silent for longer than ``lost_after``."""
        return [other for other in self._fleet if other in self._others and other not in self._alive()]

    def _alive(self) -> list[str]:
        others = self._others
        return [name for name in self._fleet if name in others and self._now - others[name].heard <= self._lost_after]

    def hear(self, message: Share, now: float) -> None:
        """Process a message of another vehicle, at ``now``, s."""
        if message.vehicle not in self._fleet or message.vehicle == self._name:
            return
        other = self._others.setdefault(message.vehicle, _Other(now))
        other.heard = now
        if message.kind == STATE:
            if other.state is None or message.number >= other.state.number:
                other.state = message
        elif message.partner == self._name:
            self._regard(message)

    def _regard(self, message: Share) -> None:
        if message.kind == PROPOSAL:
            self._answer(message)
        elif self._pending is not None and message.number == self._pending[0].number:
            if message.kind == ACCEPTANCE:
                self._take(self._pending[0].regions)
            self._pending = None

    def _answer(self, proposal: Share) -> None:
        """Accept a proposal based on the current regions, unless an own proposal to a later vehicle of the fleet is
        pending."""
        has_priority = self._pending is not None and self._rank(self._name) < self._rank(proposal.vehicle)
        accepted = proposal.base == self.number and not has_priority
        if accepted:
            self._pending = None
            self._take(proposal.partner_regions)
        kind = ACCEPTANCE if accepted else REFUSAL
        self._answers.append(Share(self._name, kind, proposal.number, proposal.vehicle))

    def _rank(self, name: str) -> int:
        return self._fleet.index(name)

    def _take(self, regions: Regions) -> None:
        self.own = regions
        self.number += 1

    def step(self, now: float, place: Place, target: Place, active: Regions, divide: Divide) -> list[Share]:
        """Return the messages of this update.

        Args:
            now: s.
            place, target: of this vehicle, x, y, m in map.
            active: regions that are not fully explored.
            divide: see ``Divide``.
        """
        self._now = now
        self._adopt_orphans(active)
        messages, self._answers = self._answers, []
        if self._pending is not None and now - self._pending[1] > _PATIENCE:
            self._pending = None
        proposal = self._proposal(active, divide)
        if proposal is not None:
            self._pending = (proposal, now)
            messages.append(proposal)
        if now - self._told >= _PERIOD - 1e-6:
            self._told = now
            messages.append(Share(self._name, STATE, self.number, "", 0, place, target, self.own))
        return messages

    def _adopt_orphans(self, active: Regions) -> None:
        alive = self._alive()
        owned = set(self.own)
        for other in alive:
            state = self._others[other].state
            owned |= state.regions if state is not None else frozenset()
        self._orphans = {region: self._orphans.get(region, self._now) for region in sorted(active - owned)}
        ripe = {region for region, since in self._orphans.items() if self._now - since >= _ORPHANED}
        if ripe and all(self._rank(self._name) < self._rank(other) for other in alive):
            self._take(self.own | ripe)

    def _proposal(self, active: Regions, divide: Divide) -> Share | None:
        """Return a proposal to the least recently asked vehicle, if one is due and changes the division."""
        pause = _PAUSE if self.own & active else _IDLE_PAUSE
        alive = [other for other in self._alive() if self._others[other].state is not None]
        if self._pending is not None or self._now - self._asked < pause - 1e-6 or not alive:
            return None
        self._asked = self._now
        partner = min(alive, key=lambda other: (self._others[other].asked, self._rank(other)))
        self._others[partner].asked = self._now
        state = self._others[partner].state
        assert state is not None
        mine, theirs = self.own & active, state.regions & active
        if not mine | theirs:
            return None
        new_mine, new_theirs = divide(state.place, mine, theirs)
        if (new_mine, new_theirs) == (mine, theirs):
            return None
        self._proposals += 1
        return Share(
            self._name, PROPOSAL, self._proposals, partner, state.number, regions=new_mine, partner_regions=new_theirs
        )
