"""A reset simulation flies like a newly started one, to the last bit."""

from __future__ import annotations

import numpy as np
import pytest

from xtdrone_common import modes
from xtdrone_common.fleet import parse_fleet
from xtdrone_sim.simulation import Simulation

FLEET = parse_fleet("iris:2")


def fly(simulation: Simulation) -> list[bytes]:
    """Take off and return the complete state after each second of eight."""
    begin = simulation.time_us
    frames = []
    for second in range(1, 9):
        simulation.run_until(begin + second * 1_000_000)
        if second == 2:
            for commander in simulation.commanders:
                commander.request(modes.AUTO_TAKEOFF)
                assert commander.arm_disarm(True) == 0
        autopilot = simulation.autopilot
        records = (simulation.world.plant, autopilot.estimator, autopilot.control, autopilot.sensors)
        frames.append(b"".join(record.tobytes() for record in records))
    return frames


@pytest.fixture
def simulation():
    simulation = Simulation(FLEET, seed=3)
    yield simulation
    simulation.close()


def test_from_zero_it_is_the_same_flight(simulation):
    first = fly(simulation)
    assert simulation.world.plant["position"][0, 2] > 0.5
    simulation.restart()
    assert simulation.time_us == simulation.autopilot.time_us == 0
    assert fly(simulation) == first


def test_time_can_continue(simulation):
    start = simulation.world.plant["position"].copy()
    fly(simulation)
    old = simulation.world.plant["position"].copy()
    simulation.restart(simulation.time_us)
    assert simulation.time_us == simulation.autopilot.time_us == 8_000_000
    assert np.array_equal(simulation.world.plant["position"], start)
    assert not any(commander.armed for commander in simulation.commanders)
    assert not simulation.autopilot.estimator["initialised"].any()
    fly(simulation)
    assert simulation.time_us == 16_000_000
    assert simulation.world.plant["position"] == pytest.approx(old, abs=0.3)


def test_parameters_are_kept(simulation):
    simulation.commanders[1].parameters.set("MPC_XY_VEL_MAX", 3.5)
    simulation.restart()
    assert simulation.commanders[1].parameters.get("MPC_XY_VEL_MAX") == 3.5
    assert simulation.autopilot.params["mpc_xy_vel_max"].tolist() == [12.0, 3.5]


@pytest.mark.parametrize("time_us", [-4000, 2000])
def test_other_times_are_rejected(simulation, time_us):
    with pytest.raises(ValueError, match=f"time: {time_us} us"):
        simulation.restart(time_us)
