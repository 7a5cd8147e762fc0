"""Pairs of vehicles that coordinate by radio and exchange their positions; without a simulator."""

from __future__ import annotations

import heapq
import itertools
import math
from collections.abc import Callable

import numpy as np
from toy_flight import LIMITS, PERIOD, ToyFlight

from xtdrone_control.network.message_radio import MessageRadio
from xtdrone_control.network.network_options import NetworkOptions
from xtdrone_planning.planner_settings import AgreementSettings
from xtdrone_planning.replanning.swarm_planner import Proposal, SwarmPlanner

RADIUS = LIMITS.radius
LENGTH = 16.0
NO_TRUNKS = np.zeros((0, 3))


class Group:
    """The vehicles."""

    def __init__(
        self, count: int, options: NetworkOptions, swarm: AgreementSettings, seed: int = 0, length: float = LENGTH,
        trunks: np.ndarray = NO_TRUNKS, kind: Callable[..., ToyFlight] = ToyFlight,
    ) -> None:  # fmt: skip
        self.radio = MessageRadio(count, options, seed)
        self.flights = []
        for rank in range(count):
            place = np.array([length * (rank % 2), 2.5 * (rank // 2), 2.0])
            flight = kind(trunks, position=place)
            flight.planner = SwarmPlanner(flight.map.grid, flight.settings, flight.limits, swarm, rank)
            self.flights.append(flight)
        self.goals = [np.array([length - flight.position[0], *flight.position[1:]]) for flight in self.flights]
        self.least = math.inf
        self.states: list[list[str]] = [[] for _ in self.flights]
        """The states of each vehicle, one after the other."""

    def run(self, seconds: float) -> float:
        """Fly until all have arrived; return the time, s."""
        arrivals: list[tuple] = []
        order = itertools.count()
        for turn in range(round(seconds / PERIOD)):
            now = turn * PERIOD
            if turn == 4:
                for flight, goal in zip(self.flights, self.goals, strict=True):
                    flight.planner.set_goal(goal)
            while arrivals and arrivals[0][0] <= now:
                *_, receiver, message = heapq.heappop(arrivals)
                hear(self.flights[receiver].planner, message)
            for rank, flight in enumerate(self.flights):
                flight.step()
                if self.states[rank][-1:] != [flight.planner.state.name]:
                    self.states[rank].append(flight.planner.state.name)
                for message in said(rank, flight.planner) if turn % 2 == 0 else ():
                    for time, receiver in self.radio.send(now, rank, 8000, np.zeros((len(self.flights), 3))):
                        heapq.heappush(arrivals, (time + 1e-3, next(order), receiver, message))
            self.after_turn(now)
            places = np.array([flight.position for flight in self.flights])
            self.least = min([self.least, *(math.dist(a, b) for a, b in itertools.combinations(places, 2))])
            if turn > 20 and all(flight.planner.state.name == "hovering at the goal" for flight in self.flights):
                return now
        return math.inf

    def after_turn(self, now: float) -> None:
        """Act on the setpoints of a turn."""


def said(rank, planner):
    """Return a planner's messages to the others."""
    decided = [] if planner.trajectory is None else [(rank, planner.number, planner.trajectory)]
    return decided + ([] if planner.proposal is None else [planner.proposal])


def hear(planner, message):
    """Pass another planner's messages to a planner."""
    if isinstance(message, Proposal):
        planner.on_proposal(message, RADIUS)
    else:
        planner.on_decided(*message, RADIUS)
