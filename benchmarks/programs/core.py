"""Benchmark of the core: physics, contacts, sensors, estimators, controllers and mode logic, without ROS.

``python -m benchmarks.programs.core --vehicles 1 9 30 100`` prints a table; ``--json FILE`` writes it.
"""

from __future__ import annotations

import argparse
import math
import statistics
import sys
import time
from collections.abc import Iterator, Sequence
from typing import Any

from benchmarks.programs.program_frame import Column, Row, run
from xtdrone_common import modes
from xtdrone_common.fleet import parse_fleet
from xtdrone_sim.effects import Effect
from xtdrone_sim.simulation import Simulation

_ALIGN_US = 2_000_000
_CLIMB_US = 12_000_000
_HEIGHT = 10.0  # m
_SETPOINT_US = 500_000
_UNSET = (math.nan, math.nan, math.nan)


def measure(vehicles: int, seconds: float, repeats: int = 3) -> dict[str, Any]:
    """Return speed figures of ``vehicles`` iris on circles in the air.

    Args:
        vehicles: number of vehicles.
        seconds: minimum wall time of one measurement.
        repeats: number of measurements, of which the median is returned.

    Returns:
        vehicles, real_time_factor, vehicle_steps_per_second, microseconds_per_vehicle_step.
    """
    simulation = flying(vehicles)
    rates = [speed_of(simulation, seconds) for _ in range(repeats)]
    simulation.close()
    rate = statistics.median(rates)
    steps = rate / (simulation.step_us * 1e-6) * vehicles
    return {
        "vehicles": vehicles,
        "real_time_factor": rate,
        "vehicle_steps_per_second": steps,
        "microseconds_per_vehicle_step": 1e6 / steps,
    }


def flying(vehicles: int, effects: Sequence[Effect] = ()) -> Simulation:
    """Return a simulation with ``vehicles`` iris that circle at 10 m in OFFBOARD, under ``effects``."""
    simulation = Simulation(parse_fleet(f"iris:{vehicles}"), rows=max(1, math.isqrt(vehicles)), effects=effects)
    _take_off(simulation)
    return simulation


def _take_off(simulation: Simulation) -> None:
    simulation.run_until(_ALIGN_US)
    for commander in simulation.commanders:
        commander.parameters.set("MIS_TAKEOFF_ALT", _HEIGHT)
        commander.request(modes.AUTO_TAKEOFF)
        commander.arm_disarm(True)
    simulation.run_until(_ALIGN_US + _CLIMB_US)
    _steer(simulation)
    for commander in simulation.commanders:
        commander.request(modes.OFFBOARD)


def _steer(simulation: Simulation) -> None:
    """Give every vehicle the next velocity setpoint of a circle at 1 m/s."""
    phase = simulation.time_us * 1e-6
    velocity = (math.cos(phase), math.sin(phase), 0.0)
    for commander in simulation.commanders:
        commander.offboard.set_trajectory(_UNSET, velocity, _UNSET, math.nan, 0.0)


def speed_of(simulation: Simulation, seconds: float) -> float:
    """Return simulated seconds per wall second while the vehicles circle in OFFBOARD, steered at 2 Hz, PX4's least."""
    start_us, start = simulation.time_us, time.perf_counter()
    while time.perf_counter() - start < seconds:
        _steer(simulation)
        simulation.run_until(simulation.time_us + _SETPOINT_US)
    elapsed = time.perf_counter() - start
    lost = [c.vehicle.name for c in simulation.commanders if not c.armed or c.mode is not modes.OFFBOARD]
    if lost:
        raise RuntimeError(f"not in OFFBOARD any more: {', '.join(lost)}")
    return (simulation.time_us - start_us) * 1e-6 / elapsed


COLUMNS = (
    Column("vehicles", "{vehicles}"),
    Column("real-time factor", "{real_time_factor:.1f}x"),
    Column("vehicle-steps/s", "{vehicle_steps_per_second:.0f}"),
    Column("us/vehicle-step", "{microseconds_per_vehicle_step:.2f}"),
)


def main() -> int:
    """Measure the fleet sizes of the command line and return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--vehicles", type=int, nargs="+", default=[1, 9, 30, 100], help="fleet sizes, 1 to 250")
    parser.add_argument("--seconds", type=float, default=3.0, help="minimum wall time of one measurement, s")
    return run(parser, _cases, COLUMNS)


def _cases(arguments: argparse.Namespace) -> Iterator[Row]:
    for count in arguments.vehicles:
        parse_fleet(f"iris:{count}")
    for count in arguments.vehicles:
        yield measure(count, arguments.seconds)


if __name__ == "__main__":
    sys.exit(main())
