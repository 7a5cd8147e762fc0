"""Benchmark of the air: the cost of each effect on vehicles that circle at 10 m, and of the world's wind; without ROS.

``python -m benchmarks.programs.effects --vehicles 1 30 --effect dryden downwash`` prints a table; ``--json FILE``
writes it. The cost of an effect is the median time of its call, its kernel and the addition of its wrench included. The
real-time factor is that of the whole flight: with any effect each step is computed on its own, without spans of several
steps.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.programs import core
from benchmarks.programs.program_frame import Column, Row, run
from xtdrone_common.fleet import parse_fleet
from xtdrone_sim.air import AIR
from xtdrone_sim.effects import Effect, Effects

NONE, WIND = "none", "wind"
EFFECTS = (NONE, WIND, *AIR)
"""The measurable cases: no effect, the world's constant wind, and the effects by their names."""

_WIND = (4.0, 3.0, 0.0)  # m/s
_FAR = 1000.0  # m, half a side of the region of wind, in which all vehicles are


def _uniform(now: float, positions: NDArray[np.float64]) -> tuple[float, float, float]:
    return _WIND


_ARGUMENTS: dict[str, dict[str, Any]] = {
    "wind_region": {"low": (-_FAR, -_FAR, -1.0), "high": (_FAR, _FAR, _FAR), "wind": _WIND},
    "wind_field": {"function": _uniform},
}


def measure(vehicles: int, effect: str, seconds: float) -> dict[str, Any]:
    """Measure one effect on ``vehicles`` iris.

    Args:
        vehicles: their number.
        effect: of ``EFFECTS``.
        seconds: minimum wall time of the measurement, above 0.

    Returns:
        vehicles, effect, effect_microseconds (of the effect alone, per vehicle and step; 0 for none and the world's
        wind, which has no call of its own), microseconds_per_vehicle_step (of the whole flight), real_time_factor.
    """
    made: list[Effect] = [AIR[effect](**_ARGUMENTS.get(effect, {}))] if effect in AIR else []
    simulation = core.flying(vehicles, made)
    if effect == WIND:
        simulation.set_wind(_WIND)
    durations: list[int] = []
    if simulation.effects is not None:
        simulation.effects.apply = _timed(simulation.effects, durations)  # type: ignore[assignment, method-assign]
    rate = core.speed_of(simulation, seconds)
    simulation.close()
    return {
        "vehicles": vehicles,
        "effect": effect,
        "effect_microseconds": 1e-3 * statistics.median(durations) / vehicles if durations else 0.0,
        "microseconds_per_vehicle_step": simulation.step_us / (rate * vehicles),
        "real_time_factor": rate,
    }


def _timed(effects: Effects, durations: list[int]) -> Callable[[NDArray[np.int32]], None]:
    """Return ``effects.apply`` that adds its wall time, ns, to ``durations``."""
    apply = effects.apply

    def timed(armed: NDArray[np.int32]) -> None:
        start = time.perf_counter_ns()
        apply(armed)
        durations.append(time.perf_counter_ns() - start)

    return timed


COLUMNS = (
    Column("vehicles", "{vehicles}"),
    Column("effect", "{effect:>14}"),
    Column("effect us/vehicle-step", "{effect_microseconds:.2f}"),
    Column("us/vehicle-step", "{microseconds_per_vehicle_step:.2f}"),
    Column("real-time factor", "{real_time_factor:.1f}x"),
)


def main() -> int:
    """Measure the fleet sizes and effects of the command line and return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--vehicles", type=int, nargs="+", default=[1, 6, 30], help="fleet sizes, 1 to 250")
    parser.add_argument("--effect", choices=EFFECTS, nargs="+", default=list(EFFECTS))
    parser.add_argument("--seconds", type=float, default=3.0, help="minimum wall time of one measurement, s")
    return run(parser, _cases, COLUMNS)


def _cases(arguments: argparse.Namespace) -> Iterator[Row]:
    for count in arguments.vehicles:
        parse_fleet(f"iris:{count}")
    for count in arguments.vehicles:
        for effect in arguments.effect:
            yield measure(count, effect, arguments.seconds)


if __name__ == "__main__":
    sys.exit(main())
