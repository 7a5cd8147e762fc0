"""Tours through nodes: the visiting order for one vehicle, and the division of nodes between two.

Open routes by cheapest insertion and relocation of single nodes, after D. Rosenkrantz et al., An analysis of several
heuristics for the traveling salesman problem, SIAM Journal on Computing 6, 1977. The division minimises the longer of
the two routes, as B. Zhou et al., RACER: rapid collaborative exploration with a decentralized multi-UAV system, IEEE
Transactions on Robotics 39, 2023, by a capacitated routing problem.
"""

from __future__ import annotations

import itertools
import math

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_SUM = 0.2  # weight of the sum of both routes, relative to the longer one
_ROUNDS = 20


def route_length(ways: Array, route: list[int]) -> float:
    """Return the cost of a route; ``ways``, (n, n), holds the cost from node to node."""
    return float(sum(ways[a, b] for a, b in itertools.pairwise(route)))


def division_cost(ways: Array, routes: list[list[int]]) -> float:
    """Return the cost of a division: the longer route plus a fraction of the sum."""
    lengths = [route_length(ways, route) for route in routes]
    return max(lengths) + _SUM * sum(lengths)


def divide(ways: Array, starts: int) -> list[list[int]]:
    """Return routes that together visit all nodes, one from each start.

    Args:
        ways: (n, n) costs; the first ``starts`` nodes are the vehicles. An infinite cost counts as a very large one.
        starts: 1 or 2.
    """
    costs = np.where(np.isfinite(ways), ways, 1e4)
    routes = [[start] for start in range(starts)]
    nodes = sorted(range(starts, len(ways)), key=lambda n: (-float(costs[:starts, n].min()), n))
    for node in nodes:
        _insert(costs, routes, node)
    best = division_cost(costs, routes)
    for _ in range(_ROUNDS):
        before = best
        for node in nodes:
            kept = [list(route) for route in routes]
            for route in routes:
                if node in route:
                    route.remove(node)
            _insert(costs, routes, node)
            now = division_cost(costs, routes)
            if now < best - 1e-9:
                best = now
            else:
                routes = kept
        if best >= before:
            break
    return routes


def _insert(costs: Array, routes: list[list[int]], node: int) -> None:
    """Insert a node where it increases the routes' cost least."""
    lengths = [route_length(costs, route) for route in routes]
    best = (math.inf, 0, 0)
    for r, route in enumerate(routes):
        others = max((length for n, length in enumerate(lengths) if n != r), default=0.0)
        for place in range(1, len(route) + 1):
            more = costs[route[place - 1], node]
            if place < len(route):
                more = more + costs[node, route[place]] - costs[route[place - 1], route[place]]
            length = lengths[r] + float(more)
            best = min(best, (max(length, others) + _SUM * (sum(lengths) + float(more)), r, place))
    routes[best[1]].insert(best[2], node)
