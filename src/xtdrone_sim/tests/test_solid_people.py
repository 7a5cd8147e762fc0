"""People as bodies: positions, contacts with other bodies, and no effect where there are none."""

from __future__ import annotations

import numpy as np
import pytest

from xtdrone_common.fleet import parse_fleet
from xtdrone_common.poses import Pose
from xtdrone_common.rotation import from_euler
from xtdrone_sim.physics.bodies.solid_people import RADIUS
from xtdrone_sim.physics.contacts.start_collisions import StartError
from xtdrone_sim.robots.wheel_drives import drive_of
from xtdrone_sim.simulation import Simulation
from xtdrone_worlds.worlds.robots.robot_model import load_robot

WORLD = """<sdf version="1.6"><world name="w">
<actor name="walker"><pose>0 0 0 0 0 0</pose><skin><filename>adam</filename></skin>
<script><loop>false</loop><delay_start>0.5</delay_start><auto_start>true</auto_start>
<trajectory id="0" type="walking"><waypoint><time>0</time><pose>0 0 0 0 0 0</pose></waypoint>
<waypoint><time>4</time><pose>6 0 0 0 0 0</pose></waypoint></trajectory></script></actor>
<actor name="stander"><pose>0 9 0 0 0 0</pose><skin><filename>adam</filename></skin></actor>
</world></sdf>"""
WALKER, STANDER = 0, 1


@pytest.fixture
def world(tmp_path):
    path = tmp_path / "w.world"
    path.write_text(WORLD)
    return str(path)


def simulated(world: str, places, **options) -> Simulation:
    return Simulation(parse_fleet(f"iris:{len(places)}"), world=world, places=places, **options)


def walker_at(simulation: Simulation, number: int = WALKER):
    return simulation.actors.states(simulation.time_us)[number].position


def test_a_walker_pushes_a_vehicle_that_stands_in_its_way_and_is_where_its_script_says(world):
    simulation = simulated(world, [(3.0, 0.05, 0.0), (0.0, -5.0, 0.0)], solid_people=True)
    plant, body = simulation.world.plant, simulation.world.bodies.by_number[WALKER]
    half = 0.5 * simulation.world.models["box"][0][:2]
    while simulation.time_us < 5_000_000:
        simulation.step()
        assert body.pose.position == pytest.approx(walker_at(simulation), abs=1e-9)
        apart = float(np.hypot(*(plant["position"][0][:2] - body.pose.position[:2])))
        assert apart > RADIUS + half.min() - 0.05
    assert body.pose.position == pytest.approx((6.0, 0.0, 0.0))
    assert plant["position"][0][0] > 4.0  # it has been pushed along, or aside
    assert simulation.world.collisions == {(0, 2 + WALKER)}
    assert plant["position"][1][:2] == pytest.approx([0.0, -5.0], abs=1e-3)
    assert not simulation.world.is_busy  # a standing person costs no steps
    simulation.close()


def test_commands_wake_move_and_remove_bodies(world):
    simulation = simulated(world, [(0.0, -5.0, 0.0)], solid_people=True)
    simulation.run_until(6_000_000)
    bodies = simulation.world.bodies
    assert not bodies.awake
    simulation.actors.send(STANDER, 2.0, 9.0, 1.0, simulation.time_us)
    simulation.run_until(7_000_000)
    assert bodies.by_number[STANDER].pose.position == pytest.approx((1.0, 9.0, 0.0))
    assert bodies.by_number[STANDER].velocity == pytest.approx((1.0, 0.0, 0.0))
    simulation.actors.place(STANDER, (4.0, 4.0, 0.0), 1.0)
    assert bodies.by_number[STANDER].pose.position == (4.0, 4.0, 0.0)
    simulation.actors.remove(WALKER)
    assert list(bodies.by_number) == [STANDER]
    simulation.restart()
    assert list(simulation.world.bodies.by_number) == [WALKER, STANDER]
    simulation.close()


def test_a_robot_stops_before_a_person(world):
    simulation = simulated(world, [(0.0, -5.0, 0.0)], solid_people=True)
    robot = load_robot("ugv")
    start = Pose((-4.0, 9.0, 0.0), from_euler(0.0, 0.0, 0.0))
    drive = drive_of(robot, start)
    simulation.world.add_model(9, robot.model("ugv_0", start), start, drive)
    for _ in range(1000):
        drive.command(1.0, 0.0)
        simulation.world.bodies.wake(9)
        simulation.step()
    assert drive.state.x == pytest.approx(-0.7 - RADIUS, abs=0.02)  # the platform reaches 0.7 m ahead
    assert simulation.world.bodies.by_number[STANDER].pose.position == (0.0, 9.0, 0.0)
    simulation.close()


def test_without_the_option_a_flight_has_the_bits_of_the_empty_world(world):
    def flown(name: str) -> bytes:
        simulation = simulated(name, [(3.0, 0.05, 0.0)])
        simulation.run_until(5_000_000)
        state = simulation.world.plant.tobytes() + simulation.autopilot.sensors.tobytes()
        simulation.close()
        return state

    assert flown(world) == flown("empty")


def test_a_start_inside_a_person_is_refused(world):
    with pytest.raises(StartError, match=r"iris_0: the start is not free: it is 0\.\d\d m inside 'stander'"):
        simulated(world, [(0.0, 9.1, 0.0)], solid_people=True)
    simulated(world, [(0.0, 9.1, 0.0)]).close()
