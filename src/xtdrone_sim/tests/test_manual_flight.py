"""Flight by stick through the whole core in PX4's manual modes: ALTCTL, POSCTL, STABILIZED, ACRO; a lost rotor."""

from __future__ import annotations

import math

import numpy as np
import pytest

from xtdrone_autopilot.flight_tasks.obstacle_map import ObstacleMap
from xtdrone_autopilot.state import FAILURE_OFF
from xtdrone_common import modes
from xtdrone_common.fleet import parse_fleet
from xtdrone_common.rotation_kernels import rotate
from xtdrone_sim.simulation import Simulation

SAMPLE_US = 20_000


class Pilot:
    """Holds the sticks of one vehicle (forward, right, up, clockwise)."""

    def __init__(self, vehicle: str = "px4_reference") -> None:
        self.simulation = Simulation(parse_fleet(vehicle), places=[(0.0, 0.0, 0.0)])
        self.commander = self.simulation.commanders[0]
        self.commander.parameters.set("MPC_THR_HOVER", 0.69)
        self.view = self.commander.view
        self.sticks = (0.0, 0.0, 0.0, 0.0)

    def run(self, seconds: float, throttle=None) -> np.ndarray:
        """Return (n, 3) estimated positions, NED, at 50 Hz; ``throttle()``, if given, moves the throttle stick."""
        rows = []
        for _ in range(round(seconds * 1e6 / SAMPLE_US)):
            forward, right, up, yaw = self.sticks
            self.commander.manual_control(forward, right, throttle() if throttle else up, yaw)
            self.simulation.run_until(self.simulation.time_us + SAMPLE_US)
            rows.append(self.view.position)
        return np.array(rows)

    def start(self, mode: modes.Mode) -> None:
        self.sticks = (0.0, 0.0, -1.0, 0.0)
        self.run(8.0)
        assert self.commander.request(mode) == 0
        assert self.commander.arm_disarm(True) == 0
        self.run(1.5)
        assert self.view.landed

    def hover(self) -> float:
        """Return a throttle stick that holds 5 m, as a pilot does by eye."""
        error = -5.0 - self.view.position[2]
        return min(max(-0.3 * error + 0.3 * self.view.velocity[2], -0.6), 0.6)

    @property
    def tilt(self) -> float:
        return math.degrees(math.acos(rotate(self.view.estimator["q"], 0.0, 0.0, 1.0)[2]))


def test_altitude_mode_climbs_holds_tilts_and_lands():
    pilot = Pilot()
    pilot.start(modes.ALTCTL)
    pilot.sticks = (0.0, 0.0, 1.0, 0.0)
    path = pilot.run(12.0)  # near the ground it climbs more slowly
    assert not pilot.view.landed
    climb = -np.diff(path[:, 2])[-50:].mean() / (SAMPLE_US * 1e-6)
    assert climb == pytest.approx(3.0, abs=0.3)
    pilot.sticks = (0.0, 0.0, 0.0, 0.0)
    pilot.run(4.0)
    held = pilot.run(4.0)[:, 2]
    assert np.ptp(held) < 0.1
    pilot.sticks = (0.5, 0.0, 0.0, 0.0)
    path = pilot.run(2.0)
    # PX4: the stick is a share of the largest horizontal acceleration
    assert pilot.tilt == pytest.approx(math.degrees(math.atan(0.5 * math.tan(math.radians(35.0)))), abs=2.0)
    assert abs(path[-1, 2] - held[-1]) < 0.4
    assert path[-1, 1] - path[0, 1] > 5.0  # spawned facing east
    pilot.sticks = (0.0, 0.0, -1.0, 0.0)
    for _ in range(60):
        pilot.run(1.0)
        if not pilot.commander.armed:
            break
    assert not pilot.commander.armed
    assert any("Disarmed by landing" in text for _, text in pilot.commander.texts)


def test_position_mode_brakes_and_holds_its_place():
    pilot = Pilot()
    pilot.start(modes.POSCTL)
    pilot.sticks = (0.0, 0.0, 0.8, 0.0)
    pilot.run(6.0)
    pilot.sticks = (1.0, 0.0, 0.0, 0.0)
    path = pilot.run(6.0)
    speed = np.diff(path[:, 1])[-20:].mean() / (SAMPLE_US * 1e-6)
    # drag against 2 MPC_ACC_HOR: 1 - exp(-2 a t / v) of MPC_VEL_MANUAL
    assert speed == pytest.approx(10.0 * (1.0 - math.exp(-2.0 * 3.0 * 6.0 / 10.0)), rel=0.1)
    pilot.sticks = (0.0, 0.0, 0.0, 0.0)
    pilot.run(6.0)
    held = pilot.run(4.0)
    assert np.ptp(held[:, :2], axis=0).max() < 0.25
    assert np.ptp(held[:, 2]) < 0.15


def test_stabilised_mode_lifts_by_thrust_and_lands_on_low_throttle():
    pilot = Pilot()
    pilot.start(modes.STABILIZED)
    pilot.run(8.0, pilot.hover)
    assert -pilot.view.position[2] == pytest.approx(5.0, abs=1.0)
    pilot.sticks = (0.0, -0.5, 0.0, 0.0)
    pilot.run(1.0, pilot.hover)
    assert pilot.tilt == pytest.approx(17.5, abs=1.5)
    pilot.sticks = (0.0, 0.0, 0.0, 1.0)
    yaw = pilot.view.yaw
    pilot.run(1.0, pilot.hover)
    turned = math.degrees((pilot.view.yaw - yaw) % (2.0 * math.pi))
    assert turned == pytest.approx(150.0, abs=25.0)
    pilot.sticks = (0.0, 0.0, -0.2, 0.0)
    while -pilot.view.position[2] > 0.3:
        pilot.run(0.1)
    pilot.sticks = (0.0, 0.0, -1.0, 0.0)
    pilot.run(5.0)
    assert pilot.view.landed
    assert not pilot.commander.armed


def test_acro_mode_turns_at_the_rate_of_the_stick():
    pilot = Pilot()
    pilot.start(modes.STABILIZED)
    pilot.run(8.0, pilot.hover)
    assert pilot.commander.request(modes.ACRO) == 0
    pilot.commander.parameters.set("MC_ACRO_Y_MAX", 100.0)
    pilot.sticks = (0.0, 0.0, 0.4, 1.0)
    pilot.run(1.5)
    assert math.degrees(pilot.view.estimator["rates"][2]) == pytest.approx(100.0, abs=5.0)
    assert pilot.commander.mode is modes.ACRO


@pytest.mark.parametrize("failure_mode", [0, 1])
def test_a_stopped_rotor_is_excluded_if_configured(failure_mode):
    pilot = Pilot("iris")
    pilot.commander.parameters.set("MPC_THR_HOVER", 0.56)
    pilot.commander.parameters.set("CA_FAILURE_MODE", failure_mode)
    pilot.commander.parameters.set("FD_ACT_EN", 1)
    pilot.start(modes.STABILIZED)
    pilot.run(8.0, pilot.hover)
    pilot.simulation.autopilot.failures["motor"][0, 1] = FAILURE_OFF
    pilot.run(0.4, pilot.hover)
    actuators = pilot.view.control["actuators"]
    assert pilot.view.setpoint["failed_rotors"] == (0b0010 if failure_mode else 0)
    assert (actuators[1] == 0.0) == bool(failure_mode)
    assert actuators[[0, 2, 3]].max() > 0.1


def obstacle_distances(view, wall: float) -> list[int]:
    """Return OBSTACLE_DISTANCE's distances (cm, every 5 degrees from north) to a wall east of ``wall`` m."""
    found = []
    for k in range(72):
        east = math.sin(math.radians(5.0 * k))
        metres = (wall - view.position[1]) / east if east > 1e-6 else math.inf
        found.append(round(100.0 * metres) if metres < 20.0 else 2001)
    return found


@pytest.mark.parametrize("mode", [0, 3, 4])
def test_position_mode_stops_before_a_wall(mode):
    """CP_DIST: at full stick towards a wall; PX4's algorithm acts with MPC_POS_MODE 0 and 3, here also with 4."""
    pilot = Pilot()
    parameters = pilot.commander.parameters
    parameters.set("MPC_POS_MODE", mode)
    pilot.start(modes.POSCTL)
    pilot.sticks = (0.0, 0.0, 0.8, 0.0)
    pilot.run(5.0)
    parameters.set("CP_DIST", 3.0)
    obstacles = ObstacleMap(pilot.view, parameters.get)
    wall = pilot.view.position[1] + 15.0
    pilot.sticks = (1.0, 0.0, 0.0, 0.0)
    path = []
    for _ in range(100):
        obstacles.add_directions(obstacle_distances(pilot.view, wall), 5.0, 0.0, (20.0, 2000.0), north=True)
        path.append(pilot.run(0.1))
    east = np.concatenate(path)[:, 1]
    assert wall - east.max() > 2.7
    assert wall - east[-1] == pytest.approx(3.0, abs=0.4)
    pilot.run(7.0)  # no data any more
    assert pilot.commander.mode is modes.AUTO_LOITER
    assert wall - pilot.view.position[1] > 2.6
