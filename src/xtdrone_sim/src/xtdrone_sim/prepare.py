"""Compile the kernels into their cache, so that the first flight does not wait: ``python -m xtdrone_sim.prepare``."""

from __future__ import annotations

from xtdrone_control.fleet import parse_fleet

from .simulation import Simulation


def main() -> None:
    """Fly one simulated second of two vehicles that stand on the ground; every kernel is used in it."""
    simulation = Simulation(parse_fleet("iris:2"))
    simulation.autopilot.setpoint["armed"][0] = 1
    simulation.run_until(1_000_000)
    simulation.close()


if __name__ == "__main__":
    main()
