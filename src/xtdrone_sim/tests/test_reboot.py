"""MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN: one vehicle's autopilot reboots on the ground while the others fly on."""

from __future__ import annotations

import math
import socket
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pymavlink.dialects.v20 import common as mavlink

from xtdrone_autopilot.mavlink.mavlink_server import MavlinkServer
from xtdrone_autopilot.navigator import plan
from xtdrone_autopilot.navigator.plan import PlanItem
from xtdrone_common import modes
from xtdrone_common.fleet import parse_fleet
from xtdrone_sim.autopilots.builtin_autopilot import BuiltinAutopilot
from xtdrone_sim.simulation import Simulation

REBOOT = 246


class Fleet:
    """Two vehicles, and a ground station of the first."""

    def __init__(self, logs: Path | None = None) -> None:
        self.fleet = parse_fleet("iris:2")
        self.simulation = Simulation(self.fleet, autopilots=partial(BuiltinAutopilot, logs=logs))
        self.server = MavlinkServer(self.fleet, self.simulation.autopilot, self.simulation.commanders)
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.setblocking(False)
        self.socket.bind(("127.0.0.1", 0))
        self.mav = mavlink.MAVLink(None, srcSystem=255, srcComponent=190)
        self.parser = mavlink.MAVLink(None)
        self.rows: list[Any] = []

    @property
    def commanders(self) -> list[Any]:
        return self.simulation.commanders

    def run(self, seconds: float, send: Any = None) -> list[Any]:
        """Send ``send`` to the first vehicle and advance time; return the messages to the ground station."""
        heard: list[Any] = []
        for _ in range(round(seconds / 0.02)):
            for message in (mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 0, 3), send):
                if message is not None:
                    self.socket.sendto(message.pack(self.mav), ("127.0.0.1", self.fleet[0].gcs_local_port))
            send = None
            self.server.receive(1.0)
            until = self.simulation.time_us + 20_000
            while self.simulation.time_us < until:
                self.simulation.step()
                self.server.send_streams(self.simulation.time_us)
            self.rows.append(self.simulation.world.plant[1].copy())
            heard += self.hear()
        return heard

    def hear(self) -> list[Any]:
        heard = []
        try:
            while True:
                heard += self.parser.parse_buffer(self.socket.recv(2048)) or []
        except BlockingIOError:
            return heard

    def command(self, number: int, *params: float) -> int:
        values = [*params, *[0.0] * (7 - len(params))]
        heard = self.run(0.2, mavlink.MAVLink_command_long_message(1, 1, number, 0, *values))
        (ack,) = [m for m in heard if m.get_type() == "COMMAND_ACK"]
        return int(ack.result)

    def take_off(self, index: int) -> None:
        assert self.commanders[index].request(modes.AUTO_TAKEOFF) == 0
        assert self.commanders[index].arm_disarm(True) == 0

    def close(self) -> None:
        self.socket.close()
        self.server.close()
        self.simulation.close()


@pytest.fixture
def made(tmp_path):
    fleet = Fleet(tmp_path)
    yield fleet
    fleet.close()


def other_flies(reboot: bool, logs: Path) -> np.ndarray:
    """Return the true motion of the second vehicle in a flight with or without a reboot of the first one."""
    fleet = Fleet(logs)
    try:
        fleet.run(2.0)
        fleet.take_off(1)
        fleet.run(2.0)
        message = mavlink.MAVLink_command_long_message(1, 1, REBOOT if reboot else 520, 0, 1, 0, 0, 0, 0, 0, 0)
        fleet.run(4.0, message)
        return np.array(fleet.rows)
    finally:
        fleet.close()


def test_the_others_continue_bit_identically(tmp_path):
    assert np.array_equal(other_flies(True, tmp_path / "a"), other_flies(False, tmp_path / "b"))


def test_a_rebooted_vehicle_flies_again(made):
    made.run(2.0)
    before = made.commanders[0]
    before.parameters.set("MIS_TAKEOFF_ALT", 3.0)
    before.parameters.set("MPC_THR_HOVER", 0.6)
    before.navigator.set_plan(plan.RALLY, [PlanItem(plan.RALLY_POINT, 3, (0.0,) * 4, 47.0, 8.0, 500.0)])
    before.request(modes.POSCTL)
    made.simulation.autopilot.failures[0]["gps"] = 1
    assert made.command(REBOOT, 1) == 0
    after = made.commanders[0]
    assert after is not before
    assert made.simulation.autopilot.control["hover_thrust"][0] == pytest.approx(0.6)
    assert made.simulation.autopilot.failures[0]["gps"] == 0
    assert after.requested_mode is modes.AUTO_LOITER
    assert len(after.navigator.plans.items[plan.RALLY]) == 1
    heard = made.run(3.0)
    assert [m for m in heard if m.get_type() == "ATTITUDE"]
    made.take_off(0)
    made.run(8.0)
    assert after.armed
    assert made.simulation.world.plant["position"][0][2] > 2.0


def test_its_log_ends_and_another_begins(made, tmp_path):
    made.commanders[0].parameters.set("SDLOG_MODE", 1)
    made.run(1.0)
    assert made.command(REBOOT, 1) == 0
    made.run(2.0)
    assert len(list(tmp_path.rglob("iris_0/**/*.ulg"))) == 2
    assert len(list(tmp_path.rglob("iris_1/**/*.ulg"))) == 1


def test_not_while_armed_and_no_shutdown(made):
    made.run(2.0)
    before = made.commanders[0]
    assert made.command(REBOOT, 0) == 0
    assert made.command(REBOOT, 2) == 2
    assert made.command(REBOOT, 3) == 2
    made.take_off(0)
    made.run(0.2)
    assert made.command(REBOOT, 1) == 2
    assert made.commanders[0] is before
    before.rebooting = True  # requested just before it was armed
    made.run(0.4)
    assert made.commanders[0] is before
    assert not before.rebooting


def test_the_place_is_found_again_where_the_vehicle_is(made):
    """After the reboot, estimates restart at the same origin, which all vehicles share."""
    made.run(2.0)
    before = made.commanders[0].view.position
    assert made.command(REBOOT, 1) == 0
    assert not made.commanders[0].view.position_valid
    made.run(3.0)
    assert made.commanders[0].view.position_valid
    assert math.dist(made.commanders[0].view.position, before) < 1.5
