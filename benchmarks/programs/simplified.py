"""Benchmark of the simplified simulator: vehicles, leader, followers with consensus and avoidance, without ROS.

``python -m benchmarks.programs.simplified --vehicles 9 100 1000`` prints a table; ``--json FILE`` writes it.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import time
from collections.abc import Iterator
from typing import Any

from benchmarks.programs.program_frame import Column, Row, run
from xtdrone_swarm.swarm import Swarm

PATTERNS = ("cube", "triangle")
_PERIOD = 10.0  # s from one pattern to the next
_WARM_UP = 1.0  # s of simulated time: compilation, neighbour tables
_PIECE = 0.5  # s of simulated time between two readings of the clock


def measure(count: int, seconds: float, repeats: int = 3, **options: Any) -> dict[str, Any]:
    """Return speed figures of a swarm on one core that flies from pattern to pattern while its leader moves.

    The assignment of a new pattern is excluded: it is made once per pattern, not in every cycle.

    Args:
        count: number of vehicles, at least 2.
        seconds: minimum processor time of one measurement.
        repeats: number of measurements, of which the median is returned.
        options: for :class:`Swarm`.

    Returns:
        vehicles, real_time_factor, microseconds_per_vehicle_turn (a turn is a control cycle of 1/30 s).
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


COLUMNS = (
    Column("vehicles", "{vehicles}"),
    Column("real-time factor", "{real_time_factor:.1f}x"),
    Column("us/vehicle-turn", "{microseconds_per_vehicle_turn:.2f}"),
)


def main() -> int:
    """Measure the swarm sizes of the command line and return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--vehicles", type=int, nargs="+", default=[9, 100, 1000], help="swarm sizes, at least 2")
    parser.add_argument("--seconds", type=float, default=2.0, help="minimum processor time of one measurement, s")
    return run(parser, _cases, COLUMNS)


def _cases(arguments: argparse.Namespace) -> Iterator[Row]:
    if min(arguments.vehicles) < 2 or not arguments.seconds > 0.0:
        raise ValueError("vehicles: at least 2 each; seconds: above 0")
    for count in arguments.vehicles:
        yield measure(count, arguments.seconds)


if __name__ == "__main__":
    sys.exit(main())
