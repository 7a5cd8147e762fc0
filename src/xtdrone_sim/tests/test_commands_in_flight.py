"""Commands as MAVSDK sends them to PX4, to several vehicles of one simulation, in PX4 v1.14's phases and frames."""

from __future__ import annotations

import math

import numpy as np
import pytest
from pymavlink.dialects.v20 import common as mavlink

from xtdrone_autopilot.mavlink.commands.command_execution import CommandHandler, from_command_int, from_command_long
from xtdrone_autopilot.mavlink.service_base import Vehicle
from xtdrone_common import frames, modes
from xtdrone_common.fleet import parse_fleet
from xtdrone_sim.simulation import Simulation

NAN = math.nan
GOTO_AFTER = (0.2, 1.0, 1.6)  # s after takeoff and arming, before "Takeoff detected" or soon after it
HOLDS = range(len(GOTO_AFTER))  # vehicles of MAVSDK's goto, which selects HOLD first
DIRECT = len(GOTO_AFTER)  # repositions without HOLD in its takeoff
FROM_HOLD, STAYS, ORBITS, LANDS = (DIRECT + i for i in range(1, 5))
COUNT = LANDS + 1


class Fleet:
    """Vehicles that are told by MAVLink commands."""

    def __init__(self) -> None:
        self.simulation = Simulation(parse_fleet(f"iris:{COUNT}"), seed=4)
        autopilot, self.commanders = self.simulation.autopilot, self.simulation.commanders
        self.handlers = [CommandHandler(Vehicle(c, autopilot, i)) for i, c in enumerate(self.commanders)]

    def position(self, index: int) -> np.ndarray:
        """Return the true position, m, NED."""
        return np.array(frames.enu_to_ned(*self.simulation.world.plant["position"][index]))

    def run(self, until: float) -> None:
        self.simulation.run_until(round(until * 1e6))

    def command(self, index: int, number: int, *params: float) -> None:
        given = (*params, *(NAN,) * (7 - len(params)))
        assert self.handlers[index].run(from_command_long(number, given), None) == 0

    def go(self, index: int, number: int, params: tuple[float, ...], offset: tuple[float, float, float]) -> None:
        """Send a COMMAND_INT with a place at an offset (m, NED) from home, its altitude AMSL, in a relative frame."""
        commander = self.commanders[index]
        latitude, longitude, altitude = commander.view.to_global(np.add(commander.home.position, offset))
        place = round(latitude * 1e7), round(longitude * 1e7), altitude
        message = mavlink.MAVLink_command_int_message(1, 1, 3, number, 0, 0, *params, *place)
        command = from_command_int(number, params, message.x, message.y, message.z)
        assert self.handlers[index].run(command, None) == 0


@pytest.fixture(scope="module")
def fleet():
    """Fly all vehicles; return the fleet, each one's start, and its track over 24 s after the takeoffs."""
    fleet = Fleet()
    fleet.run(2.0)
    starts = [fleet.position(i) for i in range(COUNT)]
    for i in range(COUNT):
        if i not in (FROM_HOLD, STAYS):
            fleet.command(i, mavlink.MAV_CMD_NAV_TAKEOFF)
        fleet.command(i, mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1.0)
    to = (-1.0, 1.0, NAN, 0.5)  # default speed, change of mode, heading
    for delay, i in zip(GOTO_AFTER, HOLDS, strict=True):
        fleet.run(2.0 + delay)
        fleet.command(i, mavlink.MAV_CMD_DO_SET_MODE, 1.0, 4.0, 3.0)
        fleet.go(i, mavlink.MAV_CMD_DO_REPOSITION, to, (12.0, 0.0, -6.0))
        if i == 0:
            fleet.go(DIRECT, mavlink.MAV_CMD_DO_REPOSITION, to, (12.0, 0.0, -6.0))
            fleet.go(FROM_HOLD, mavlink.MAV_CMD_DO_REPOSITION, to, (12.0, 0.0, -6.0))
            fleet.go(STAYS, mavlink.MAV_CMD_DO_REPOSITION, to, (12.0, 0.0, 0.0))
    fleet.run(9.0)
    fleet.go(ORBITS, mavlink.MAV_CMD_DO_ORBIT, (5.0, 2.0, 0.0, NAN), (8.0, 0.0, -6.0))
    fleet.go(LANDS, mavlink.MAV_CMD_DO_REPOSITION, (-1.0, 1.0, NAN, NAN), (5.0, 0.0, -2.5))
    fleet.run(14.0)
    fleet.command(LANDS, mavlink.MAV_CMD_NAV_LAND)
    track = []
    for step in range(60):
        fleet.run(14.0 + 0.2 * step)
        track.append([fleet.position(i) for i in range(COUNT)])
    yield fleet, starts, np.array(track)
    fleet.simulation.close()


@pytest.mark.parametrize("index", [*HOLDS, DIRECT, FROM_HOLD])
def test_goto_between_arming_and_the_end_of_the_takeoff(fleet, index):
    """The vehicle flies there from the ground, as PX4's flight task takes off to any setpoint above it."""
    fleet, starts, track = fleet
    np.testing.assert_allclose(track[-1, index] - starts[index], (12.0, 0.0, -6.0), atol=0.5)
    assert fleet.commanders[index].mode is modes.AUTO_LOITER
    assert fleet.commanders[index].view.yaw == pytest.approx(0.5, abs=0.1)


def test_goto_at_the_ground_does_not_lead_off_it(fleet):
    fleet, starts, track = fleet
    assert np.abs(track[:, STAYS] - starts[STAYS]).max() < 0.1
    assert not fleet.commanders[STAYS].armed, "disarmed by COM_DISARM_PRFLT"


def test_an_orbit_is_flown_at_its_altitude_above_sea_level(fleet):
    """MAVSDK's do_orbit sends it with the frame GLOBAL_RELATIVE_ALT; PX4 v1.14 looks at no frame."""
    fleet, starts, track = fleet
    arm = track[25:, ORBITS] - starts[ORBITS] - (8.0, 0.0, 0.0)
    assert np.hypot(arm[:, 0], arm[:, 1]) == pytest.approx(5.0, abs=0.4)
    assert arm[:, 2] == pytest.approx(-6.0, abs=0.5)
    assert fleet.commanders[ORBITS].mode is modes.ORBIT


def test_home_follows_a_vehicle_that_has_landed_elsewhere(fleet):
    fleet, starts, track = fleet
    commander = fleet.commanders[LANDS]
    assert not commander.armed
    moved = track[-1, LANDS] - starts[LANDS]
    assert np.hypot(*moved[:2]) == pytest.approx(5.0, abs=0.5)
    np.testing.assert_allclose(commander.home.position, commander.view.position, atol=0.3)
    assert commander.view.to_global(commander.home.position)[0] == pytest.approx(commander.home.latitude)
