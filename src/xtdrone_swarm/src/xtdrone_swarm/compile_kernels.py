"""Compile the kernels into their cache for a prompt first flight: ``python -m xtdrone_swarm.compile_kernels``."""

from __future__ import annotations

from xtdrone_autopilot.state import FAILURE_SLOW
from xtdrone_common.fleet import parse_fleet
from xtdrone_sim.simulation import Simulation
from xtdrone_sim.vehicles.link_poses import Links
from xtdrone_swarm import NetworkOptions, Swarm

_POOR = NetworkOptions(range=50.0, delay=0.05, loss=0.1, burst=0.1, bandwidth=1e6)


def _no_effect(*_: object) -> None:
    """Apply no force: an effect makes the simulation use the kernels for effects."""


def main() -> None:
    """Simulate two vehicles on the ground for a moment, then simplified ones, so that every kernel is compiled.

    Print each step, because the installation script shows them as progress.
    """
    for world, seconds in (("empty", 1.0), ("outdoor", 0.1)):
        print(f"autopilots and physics, world {world}", flush=True)
        simulation = Simulation(parse_fleet("iris:1,typhoon_h480:1"), world=world)
        simulation.autopilot.setpoint["armed"][0] = 1
        simulation.autopilot.failures["motor"][0, 0] = FAILURE_SLOW
        simulation.run_until(round(seconds * 1e6))
        links = Links([vehicle.name for vehicle in simulation.fleet], simulation.models)
        links.place(simulation.world.plant, simulation.gimbals.records, simulation.landing_gears.records)
        simulation.close()
    simulation = Simulation(parse_fleet("iris:1"), places=[(0.0, 0.0, 10.0)])
    simulation.run_until(simulation.step_us)  # free flight
    simulation.close()
    print("effects", flush=True)
    simulation = Simulation(parse_fleet("iris:1"), effects=[_no_effect])
    simulation.step()
    simulation.close()
    for network in (None, _POOR):
        print("simplified vehicles" if network is None else "simplified vehicles, poor radio", flush=True)
        swarm = Swarm(9, network=network)
        swarm.choose("cube")
        swarm.run(0.5)
        swarm.close()


if __name__ == "__main__":
    main()
