"""Compile the kernels into their cache, so that the first flight does not wait: ``python -m xtdrone_sim.prepare``."""

from __future__ import annotations

from xtdrone_control.fleet import parse_fleet

from .simplified import NetworkOptions, Swarm
from .simulation import Simulation

_POOR = NetworkOptions(range=50.0, delay=0.05, loss=0.1, burst=0.1, bandwidth=1e6)


def main() -> None:
    """Fly one simulated second of two vehicles that stand on the ground, then simplified ones; every kernel is used."""
    simulation = Simulation(parse_fleet("iris:2"))
    simulation.autopilot.setpoint["armed"][0] = 1
    simulation.run_until(1_000_000)
    simulation.close()
    for network in (None, _POOR):
        swarm = Swarm(9, network=network)
        swarm.choose("cube")
        swarm.run(0.5)
        swarm.close()


if __name__ == "__main__":
    main()
