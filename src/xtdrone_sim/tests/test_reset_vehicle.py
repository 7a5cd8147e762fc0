"""One vehicle of a flight is reset while the others fly on, the same to the last bit."""

from __future__ import annotations

import numpy as np
import pytest

from xtdrone_common import modes
from xtdrone_common.fleet import StartPose, parse_fleet
from xtdrone_sim.physics.contacts.start_collisions import StartError
from xtdrone_sim.simulation import Simulation

OTHERS = [0, 2, 3]


def flight() -> Simulation:
    """Return a simulation of four vehicles: three climb and the last one stands."""
    simulation = Simulation(parse_fleet("iris:4"), seed=5)
    simulation.run_until(2_000_000)
    for commander in simulation.commanders[:3]:
        assert commander.request(modes.AUTO_TAKEOFF) == 0
        assert commander.arm_disarm(True) == 0
    simulation.run_until(8_000_000)
    return simulation


def state(simulation: Simulation, rows: list[int]) -> list[bytes]:
    autopilot = simulation.autopilot
    records = (simulation.world.plant, autopilot.estimator, autopilot.setpoint, autopilot.control, autopilot.sensors)
    return [record[i : i + 1].tobytes() for record in records for i in rows]


def land_again(simulation: Simulation) -> list[list[bytes]]:
    frames = []
    for commander in (simulation.commanders[0], simulation.commanders[2]):
        commander.request(modes.AUTO_LAND)
    for second in range(9, 19):
        simulation.run_until(second * 1_000_000)
        frames.append(state(simulation, OTHERS))
    return frames


@pytest.fixture(scope="module")
def undisturbed() -> list[list[bytes]]:
    simulation = flight()
    frames = land_again(simulation)
    simulation.close()
    return frames


@pytest.mark.parametrize("pose", [None, StartPose(-5.0, 4.0, 0.0, 0.0, 0.0, 2.0)])
def test_the_others_fly_on_to_the_last_bit(pose: StartPose | None, undisturbed: list[list[bytes]]) -> None:
    simulation = flight()
    begin = (3.0, 3.0, 0.055)
    before = simulation.commanders[1]
    assert before.armed
    before.parameters.set("MIS_TAKEOFF_ALT", 3.0)
    assert simulation.world.plant["position"][1, 2] > 1.0
    simulation.reset_vehicle(1, pose)
    commander = simulation.commanders[1]
    truth = simulation.world.plant[1]
    assert truth["position"] == pytest.approx(begin if pose is None else (-5.0, 4.0, 0.056), abs=0.002)
    assert not truth["velocity"].any()
    assert not truth["rotor_speed"].any()
    assert commander is not before
    assert not commander.armed
    assert not simulation.autopilot.estimator["initialised"][1]
    assert commander.parameters.get("MIS_TAKEOFF_ALT") == 3.0
    assert land_again(simulation) == undisturbed
    assert truth["position"] == pytest.approx(begin if pose is None else (-5.0, 4.0, 0.055), abs=0.01)
    assert commander.request(modes.AUTO_TAKEOFF) == 0
    assert commander.arm_disarm(True) == 0
    simulation.run_until(27_000_000)
    assert truth["position"][2] == pytest.approx(3.0, abs=1.0)
    simulation.close()


def test_an_occupied_place_is_refused_and_nothing_changes() -> None:
    simulation = flight()
    before = state(simulation, [0, 1, 2, 3])
    with pytest.raises(StartError, match=r"the start is not free: .* inside iris_3"):
        simulation.reset_vehicle(1, StartPose(0.1, 6.0))
    with pytest.raises(StartError, match="below the ground"):
        simulation.reset_vehicle(1, StartPose(0.0, 0.0, -1.0))
    assert state(simulation, [0, 1, 2, 3]) == before
    assert np.array_equal([c.armed for c in simulation.commanders], [True, True, True, False])
    simulation.close()
