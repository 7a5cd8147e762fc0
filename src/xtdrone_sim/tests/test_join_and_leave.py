"""Vehicles join and leave a flight while the others fly on, the same to the last bit."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest

from xtdrone_autopilot.logger.log_folder import LogFolder
from xtdrone_common import modes
from xtdrone_common.fleet import FleetError, StartPose, parse_fleet
from xtdrone_sim.autopilots.builtin_autopilot import BuiltinAutopilot
from xtdrone_sim.effects import load_effects
from xtdrone_sim.physics.contacts.start_collisions import StartError
from xtdrone_sim.physics.vehicle_dynamics import ABSENT, ASLEEP, TOUCHING
from xtdrone_sim.simulation import Simulation
from xtdrone_worlds.descriptions import ModelError

Script = dict[int, Callable[[Simulation], object]]
"""Changes by simulated second."""


def take_off(simulation: Simulation, index: int) -> None:
    commander = simulation.commanders[index]
    assert commander.request(modes.AUTO_TAKEOFF) == 0
    assert commander.arm_disarm(True) == 0


def state(simulation: Simulation, rows: range) -> bytes:
    autopilot = simulation.autopilot
    records = (simulation.world.plant, autopilot.estimator, autopilot.setpoint, autopilot.control, autopilot.sensors)
    return b"".join(record[rows.start : rows.stop].tobytes() for record in records)


def fly(script: Script, *, reserve: int = 1, effects: Sequence[str] = ()) -> list[bytes]:
    """Fly and land two vehicles while a third stands; return their states at each second."""
    simulation = Simulation(parse_fleet("iris:3"), seed=5, reserve=reserve, effects=load_effects(list(effects)))
    frames = []
    for second in range(1, 19):
        simulation.run_until(second * 1_000_000 + 20_000)  # in the middle of a block of noise
        frames.append(state(simulation, range(3)))
        if second in script:
            script[second](simulation)
        if second == 2:
            take_off(simulation, 0)
            take_off(simulation, 1)
        if second == 10:
            simulation.commanders[0].request(modes.AUTO_LAND)
    simulation.close()
    return frames


@pytest.fixture(scope="module")
def undisturbed() -> list[bytes]:
    return fly({}, reserve=0)


def test_places_in_reserve_change_no_bit(undisturbed: list[bytes]) -> None:
    assert fly({}, reserve=2) == undisturbed


@pytest.mark.parametrize("joining", ["iris_3", "typhoon_h480_0", "iris_opt_flow_0"])
def test_others_fly_on_to_the_last_bit(joining: str, undisturbed: list[bytes]) -> None:
    heights: list[float] = []

    def join(simulation: Simulation) -> None:
        assert simulation.add_vehicle(joining) == 3
        assert [vehicle.name for vehicle in simulation.fleet] == ["iris_0", "iris_1", "iris_2", joining]

    def leave(simulation: Simulation) -> None:
        heights.append(float(simulation.world.plant["position"][3, 2]))
        simulation.remove_vehicle(3)
        assert simulation.names == ["iris_0", "iris_1", "iris_2", ""]

    script: Script = {3: join, 6: lambda simulation: take_off(simulation, 3), 12: leave, 14: join}
    assert fly(script) == undisturbed
    assert heights[0] > 1.0


def test_noise_of_a_vehicle_depends_on_how_many_had_its_place() -> None:
    frames: list[bytes] = []

    def note(simulation: Simulation) -> None:
        frames.append(simulation.autopilot.sensors["gyro"][3].tobytes())

    joining: Script = {
        3: lambda simulation: simulation.add_vehicle("iris_3"),
        5: lambda simulation: (note(simulation), simulation.remove_vehicle(3), simulation.add_vehicle("iris_3")),
        7: note,
    }
    fly(joining)
    fly(joining)
    assert frames[:2] == frames[2:]
    assert frames[0] != frames[1]


def test_effects_do_not_see_an_absent_vehicle() -> None:
    effects = ["dryden", "ground_effect", "body_drag"]
    script: Script = {3: lambda s: s.add_vehicle("iris_3"), 12: lambda s: s.remove_vehicle(3)}
    assert fly(script, effects=effects) == fly({}, effects=effects)


def test_a_vehicle_of_the_start_leaves_in_flight_and_another_takes_its_place() -> None:
    simulation = Simulation(parse_fleet("iris:2"), seed=1)
    simulation.run_until(2_000_000)
    take_off(simulation, 0)
    simulation.run_until(8_000_000)
    simulation.remove_vehicle(0)
    assert simulation.world.plant["contact"][0] == ABSENT
    assert not simulation.autopilot.sensors["time_us"][0]
    simulation.run_until(9_000_000)
    assert simulation.add_vehicle("typhoon_h480_0", pose=StartPose(-4.0, 2.0, 0.0, 0.0, 0.0, 1.0)) == 0
    assert simulation.vehicles[0] is not None
    assert simulation.vehicles[0].id == 0
    assert simulation.autopilot.rotor_count(0) == 6
    simulation.run_until(12_000_000)
    take_off(simulation, 0)
    simulation.run_until(25_000_000)
    assert simulation.world.plant["position"][0] == pytest.approx([-4.0, 2.0, 2.0], abs=0.3)
    assert simulation.world.plant["contact"][1] == ASLEEP
    simulation.close()


def test_a_restart_keeps_those_that_are_there_where_they_joined() -> None:
    simulation = Simulation(parse_fleet("iris:1"), seed=1, reserve=2)
    simulation.run_until(1_000_000)
    simulation.add_vehicle("iris_5", pose=StartPose(4.0, 1.0))
    flights = []
    for _ in range(2):
        simulation.restart()
        assert simulation.names == ["iris_0", "iris_5", ""]
        simulation.run_until(3_000_000)
        flights.append(state(simulation, range(3)))
    assert flights[0] == flights[1]
    assert simulation.world.plant["position"][1, :2] == pytest.approx([4.0, 1.0], abs=0.01)
    simulation.close()


def test_a_vehicle_asleep_beside_one_that_leaves_wakes() -> None:
    poses = [(3.0, 3.0, 0.0), (3.6, 3.0, 0.0), (9.0, 3.0, 0.0)]
    simulation = Simulation(parse_fleet("iris:3"), seed=1, places=poses)
    simulation.run_until(2_000_000)
    contact = simulation.world.plant["contact"]
    assert contact.tolist() == [ASLEEP, ASLEEP, ASLEEP]
    simulation.remove_vehicle(0)
    assert contact.tolist() == [ABSENT, TOUCHING, ASLEEP]
    simulation.run_until(4_000_000)
    assert contact.tolist() == [ABSENT, ASLEEP, ASLEEP]
    simulation.close()


def test_what_is_refused_changes_nothing() -> None:
    simulation = Simulation(parse_fleet("iris:2"), seed=1, reserve=1)
    simulation.run_until(1_000_000)
    before = state(simulation, range(3))
    with pytest.raises(ValueError, match="'iris_1' is already in the simulation"):
        simulation.add_vehicle("iris_1")
    with pytest.raises(FleetError, match="is not allowed, a type of small letters"):
        simulation.add_vehicle("Iris 4")
    with pytest.raises(ModelError, match="saucer"):
        simulation.add_vehicle("saucer_0")
    with pytest.raises(StartError, match="inside iris_0"):
        simulation.add_vehicle("iris_2", pose=StartPose(0.1, 3.0))
    assert state(simulation, range(3)) == before
    assert simulation.names == ["iris_0", "iris_1", ""]
    simulation.add_vehicle("iris_2")
    with pytest.raises(ValueError, match="no place is free: 3 vehicles"):
        simulation.add_vehicle("iris_3")
    simulation.remove_vehicle(2)
    simulation.remove_vehicle(0)
    with pytest.raises(ValueError, match="iris_1 is the only vehicle"):
        simulation.remove_vehicle(1)
    simulation.close()
    with pytest.raises(FleetError, match="reserve: 249 is not allowed, 0 to 248 beside 2 vehicles"):
        Simulation(parse_fleet("iris:2"), reserve=249)


def test_each_vehicle_has_a_complete_log_of_its_own(tmp_path: Path) -> None:
    def autopilots(*arguments: object) -> BuiltinAutopilot:
        return BuiltinAutopilot(*arguments, logs=tmp_path)  # type: ignore[arg-type]

    simulation = Simulation(parse_fleet("iris:1"), seed=1, reserve=1, autopilots=autopilots)
    for name in ("iris_1", "typhoon_h480_0"):
        index = simulation.add_vehicle(name)
        begin = simulation.time_us
        simulation.run_until(begin + 2_000_000)
        take_off(simulation, index)
        simulation.run_until(begin + 5_500_000)
        simulation.remove_vehicle(index)
        (entry,) = LogFolder(tmp_path / name).entries()
        assert entry.size > 100_000
        size = entry.path.stat().st_size
        simulation.run_until(begin + 7_000_000)
        assert entry.path.stat().st_size == size
    assert sorted(path.name for path in tmp_path.iterdir()) == ["iris_0", "iris_1", "typhoon_h480_0"]
    simulation.close()


def test_a_vehicle_that_joins_costs_the_others_no_step_at_once() -> None:
    """A fleet with free slots keeps its compiled steps while no vehicle has a gimbal."""
    simulation = Simulation(parse_fleet("iris:2"), seed=1, reserve=3)
    simulation.run_until(2_000_000)
    take_off(simulation, 0)
    take_off(simulation, 1)
    simulation.run_until(8_000_000)
    assert simulation._fly_free(5)
    assert np.count_nonzero(simulation.world.plant["contact"] == ABSENT) == 3
    simulation.close()
