"""Benchmark of the simplified simulator: vehicles, leader, followers with consensus and avoidance, without ROS.

``python -m xtdrone_swarm.benchmark --vehicles 9 100 1000`` prints a table; ``--json FILE`` writes it.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from pathlib import Path
from typing import Any

from xtdrone_swarm.swarm import Swarm

PATTERNS = ("cube", "triangle")
_PERIOD = 10.0  # s from one pattern to the next
_WARM_UP = 1.0  # s of simulated time: compilation, neighbour tables
_PIECE = 0.5  # s of simulated time between two looks at the clock


def measure(count: int, seconds: float, repeats: int = 3, **options: Any) -> dict[str, Any]:
    """Return speed figures of a swarm on one core that flies from pattern to pattern while its leader moves.

    The assignment of a new pattern is not counted: it is made once, not in every turn.

    Args:
        count: number of vehicles, at least 2.
        seconds: least time of one measurement, of this process on its core.
        repeats: measurements; the median counts.
        options: for :class:`Swarm`.

    Returns:
        vehicles, real_time_factor, microseconds_per_vehicle_turn (a turn is 1/30 s).
    """
    swarm = Swarm(count, **{"altitude": 1000.0, "record": False, **options})
    swarm.choose(PATTERNS[0])
    swarm.steer((0.3, 0.1, 0.0), 0.05)
    swarm.run(_WARM_UP)
    factor = statistics.median(_factor(swarm, seconds) for _ in range(repeats))
    return {
        "vehicles": count,
        "real_time_factor": factor,
        "microseconds_per_vehicle_turn": 1e6 / (30.0 * count * factor),
    }


def _factor(swarm: Swarm, seconds: float) -> float:
    """Return simulated seconds per second of the processor."""
    flown = spent = 0.0
    changed = swarm.time
    while spent < seconds:
        if swarm.time - changed >= _PERIOD:
            changed = swarm.time
            swarm.choose(PATTERNS[PATTERNS.index(swarm.leader.pattern) - 1])
        before, start = swarm.time, time.process_time()
        swarm.run(_PIECE)
        spent += time.process_time() - start
        flown += swarm.time - before
    return flown / spent


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--vehicles", type=int, nargs="+", default=[9, 100, 1000], help="swarm sizes, at least 2")
    parser.add_argument("--seconds", type=float, default=2.0, help="least processor time of one measurement, s")
    parser.add_argument("--json", type=Path, help="write the figures here")
    arguments = parser.parse_args()
    if min(arguments.vehicles) < 2 or not arguments.seconds > 0.0:
        parser.error("vehicles: at least 2 each; seconds: above 0")
    print(f"{'vehicles':>8} {'real-time factor':>17} {'us/vehicle-turn':>16}")
    results = []
    for count in arguments.vehicles:
        result = measure(count, arguments.seconds)
        results.append(result)
        print(
            f"{count:8d} {result['real_time_factor']:16.1f}x {result['microseconds_per_vehicle_turn']:16.2f}",
            flush=True,
        )
    if arguments.json:
        arguments.json.write_text(json.dumps(results, indent=1) + "\n")


if __name__ == "__main__":
    main()
