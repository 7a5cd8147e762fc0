"""Clients send any legal request at any time: no exception, and no effect on the other vehicles.

Requests are MAVLink messages without sockets, so that many simulated minutes fit into a test.
"""

from __future__ import annotations

import logging
import math
import random
from typing import Any

import numpy as np
import pytest
from pymavlink.dialects.v20 import common as mavlink
from xtdrone_native.mavlink_wire import Outbox

from xtdrone_autopilot.mavlink.receiver import Receiver
from xtdrone_autopilot.mavlink.streams.stream_schedule import GCS_RATES, Streams
from xtdrone_autopilot.mavlink.streams.telemetry import Telemetry
from xtdrone_autopilot.navigator import plan
from xtdrone_autopilot.parameters.parameters import INT32, NAMES, describe
from xtdrone_common import modes
from xtdrone_common.fleet import parse_fleet
from xtdrone_sim.simulation import Simulation

CALM, TROUBLED = 0, (1, 2)
HEIGHT = 5.0  # m, height of the undisturbed vehicle
FAR = 5000.0  # m between vehicles
STRANGE = (0.0, 1.0, -1.0, 2.0, 0.5, 10.0, 1e-30, 1e9, 3e38, -3e38, math.nan, math.inf, -math.inf)
COMMANDS = (16, 20, 21, 22, 23, 84, 176, 177, 178, 179, 183, 185, 186, 187, 189, 192, 195, 196, 197, 201, 223, 224,
            241, 245, 246, 300, 310, 400, 401, 410, 420, 500, 509, 510, 511, 512, 519, 520, 521, 525, 528,
            2000, 3000)  # fmt: skip
CHANGEABLE = tuple(name for name in NAMES if name not in ("MAV_SYS_ID", "MAV_COMP_ID"))
LOGIC = tuple(
    name
    for name in CHANGEABLE
    if name.startswith(("COM_", "NAV_", "MPC_", "RTL_", "MIS_", "GF_", "BAT", "FD_", "PLD_", "SIM_", "RC_", "RC1_"))
)
ITEM_COMMANDS = (
    plan.WAYPOINT, plan.LOITER_UNLIM, plan.LOITER_TIME, plan.RETURN, plan.LAND, plan.TAKEOFF, plan.LOITER_TO_ALT,
    plan.DELAY, plan.CONDITION_GATE, plan.JUMP, plan.CHANGE_SPEED, plan.SET_HOME, plan.SET_ACTUATOR, plan.LAND_START,
    plan.SET_ROI_LOCATION, plan.SET_ROI_NEXT, plan.SET_ROI_NONE, plan.SET_ROI, plan.MOUNT_CONTROL,
    plan.TRIGGER_DISTANCE, plan.TRIGGER_INTERVAL, plan.TRIGGER_CONTROL, plan.START_IMAGES, plan.GIMBAL_PITCHYAW,
    plan.DIGICAM_CONTROL, plan.GRIPPER,
)  # fmt: skip
FENCE_COMMANDS = (plan.FENCE_INCLUSION, plan.FENCE_EXCLUSION, plan.FENCE_CIRCLE_INCLUSION, plan.FENCE_CIRCLE_EXCLUSION)


class Pipe:
    """A client's link that counts sent messages, and its own port."""

    def __init__(self, telemetry: Telemetry, system_id: int) -> None:
        self.telemetry = telemetry
        self.streams = Streams(telemetry, GCS_RATES)
        self.sender = (255, 190)
        self.open = True
        self.told = 0
        self._mav = mavlink.MAVLink(None, srcSystem=system_id, srcComponent=1)
        self.client = mavlink.MAVLink(None, srcSystem=255, srcComponent=190)

    def link_of(self, *_: object) -> Pipe:
        return self

    def heard(self, now_us: int, *_: object) -> None:
        self.streams.start(now_us)

    def note_malformed(self, *_: object) -> None:
        raise AssertionError("only well-formed frames are sent")

    def warn(self, *_: object) -> None:
        pass

    def send_message(self, message: Any) -> None:
        message.pack(self._mav)
        self.told += 1

    def send_values(self, *_: object) -> None:
        self.told += 1

    def send_text(self, *_: object) -> None:
        self.told += 1

    def send_payload(self, *_: object) -> None:
        self.told += 1

    def stream(self, now_us: int) -> None:
        """Build and count the telemetry that is due."""
        self.telemetry.refresh(now_us)
        outbox = Outbox("127.0.0.1", 9, 1, 1)
        self.streams.send_due(now_us, {}, outbox, None, lambda _text: None)
        self.told += len(outbox)


class Client:
    """Two clients of one vehicle, one of which sends random requests."""

    def __init__(self, simulation: Simulation, index: int, seed: int) -> None:
        self.rng = random.Random(f"{seed} {index}")
        self.index = index
        self.reboot(simulation)

    @property
    def told(self) -> int:
        """Number of messages sent to the clients since the last reboot."""
        return sum(link.told for link in self.links)

    def reboot(self, simulation: Simulation) -> None:
        """Connect to the autopilots that have booted."""
        self.simulation = simulation
        self.commander = simulation.commanders[self.index]
        self.system = self.commander.vehicle.system_id
        telemetry = Telemetry(self.commander, simulation.autopilot, self.index)
        self.links = [Pipe(telemetry, self.system) for _ in range(2)]
        self.receiver = Receiver(self.commander, simulation.autopilot, self.index, lambda: self.links)
        self.until_us = 0

    def send(self, message: Any, link: Pipe | None = None) -> None:
        link = link or self.rng.choice(self.links)
        self.receiver.handle_datagram(
            link, bytes(message.pack(link.client)), ("127.0.0.1", 14550), self.simulation.time_us
        )

    def update(self) -> None:
        now_us = self.simulation.time_us
        if now_us >= self.until_us:
            self.until_us = now_us + self.rng.choice((4_000, 4_000, 20_000, 100_000, 500_000))
            self.act()
        if self.receiver.next_due_us <= now_us:
            self.receiver.update(now_us)
        if now_us % 100_000 == 0:
            self.links[0].stream(now_us)
        self.commander.texts.clear()

    def act(self) -> None:
        self.rng.choices(
            (self.command, self.parameter, self.mode, self.arm, self.fly, self.upload, self.sticks, self.setpoint,
             self.other, self.fail),
            (6, 8, 3, 3, 3, 4, 3, 3, 3, 1),
        )[0]()  # fmt: skip

    # requests

    def number(self) -> float:
        return self.rng.choice(STRANGE) if self.rng.random() < 0.5 else float(self.rng.randint(-5, 20))

    def numbers(self, count: int) -> list[float]:
        return [self.number() for _ in range(count)]

    def place(self) -> tuple[float, float]:
        """Return a latitude and a longitude, degrees, mostly nearby."""
        if self.rng.random() < 0.03:
            return self.number(), self.number()
        position = self.commander.view.position
        near = all(abs(coordinate) < 1e5 for coordinate in position)
        latitude, longitude, _ = self.commander.view.to_global(position if near else (0.0, 0.0, 0.0))
        return latitude + self.rng.uniform(-2e-4, 2e-4), longitude + self.rng.uniform(-2e-4, 2e-4)

    def run(self, number: int, *params: float) -> None:
        values = [*params, *[0.0] * (7 - len(params))]
        self.send(mavlink.MAVLink_command_long_message(self.system, 1, number, 0, *values))

    def command(self) -> None:
        number = self.rng.choice(COMMANDS)
        p = self.numbers(7)
        if self.rng.random() < 0.5:
            p[4:6] = self.place()
        if self.rng.random() < 0.3:
            self.send(
                mavlink.MAVLink_command_int_message(
                    self.system, 1, self.rng.choice((0, 3, 5, 6, 1, 10)), number, 0, 0, *p[:4],
                    *(round(max(min(v, 200.0), -200.0) * 1e7) if math.isfinite(v) else 0x7FFFFFFF for v in p[4:6]), p[6]
                )
            )  # fmt: skip
        else:
            self.run(number, *p)

    def parameter(self) -> None:
        name = self.rng.choice(LOGIC if self.rng.random() < 0.7 else CHANGEABLE)
        entry = describe(name)
        value = self.rng.choice((0.0, -1.0, 1e9, -1e9, 1e-6, 3e38, entry.minimum, entry.maximum, entry.default))
        if self.rng.random() < 0.5:
            value = self.commander.parameters.default(name)
        if not math.isfinite(value):
            value = 0.0
        raw = value
        if entry.type == INT32:
            raw = np.array([round(max(min(value, 2e9), -2e9))], "<i4").view("<f4")[0]
        self.send(mavlink.MAVLink_param_set_message(self.system, 1, name.encode(), float(raw), entry.type))

    def mode(self) -> None:
        mode = self.rng.choice((*modes.SUPPORTED, modes.AUTO_MISSION, modes.OFFBOARD))
        self.send(mavlink.MAVLink_set_mode_message(self.system, self.rng.choice((1, 1, 1, 4, 8, 16)), mode.custom_mode))

    def arm(self) -> None:
        self.run(400, self.rng.choice((1, 1, 1, 0)), self.rng.choice((0, 0, 21196)))

    def fly(self) -> None:
        """Clear failures, restore parameters, and take off."""
        self.run(420, *(self.rng.choice((0, 1, 3, 4, 101)), 0, 0))
        self.run(185, 0)
        for name in NAMES:
            if name in CHANGEABLE and self.rng.random() < 0.9:
                self.commander.parameters.set(name, self.commander.parameters.default(name))
        self.run(22, 0, 0, 0, math.nan, math.nan, math.nan, 495.0 + self.rng.random() * 10.0)
        self.run(400, 1)

    def upload(self) -> None:
        kind = self.rng.choice((plan.MISSION, plan.MISSION, plan.MISSION, plan.FENCE, plan.RALLY, 255))
        if kind == plan.ALL_KINDS or self.rng.random() < 0.1:
            self.send(mavlink.MAVLink_mission_clear_all_message(self.system, 1, kind))
            return
        if self.rng.random() < 0.2:
            self.send(mavlink.MAVLink_mission_request_list_message(self.system, 1, kind))
            return
        count, link = self.rng.randint(1, 8), self.rng.choice(self.links)
        self.send(mavlink.MAVLink_mission_count_message(self.system, 1, count, kind), link)
        for seq in range(count if self.rng.random() < 0.95 else count - 1):
            self.send(self.item(seq, count, kind), link)
        if self.rng.random() < 0.3:
            self.send(mavlink.MAVLink_mission_set_current_message(self.system, 1, self.rng.randrange(count)))
        if kind == plan.MISSION and self.rng.random() < 0.7:
            self.run(300, 0, 0)

    def item(self, seq: int, count: int, kind: int) -> Any:
        rng = self.rng
        p = self.numbers(4)
        if kind == plan.FENCE:
            command, p[0] = rng.choice(FENCE_COMMANDS), rng.choice((3.0, float(count), 30.0, p[0]))
        elif kind == plan.RALLY:
            command = plan.RALLY_POINT
        else:
            command = plan.TAKEOFF if seq == 0 else rng.choice((plan.WAYPOINT, *ITEM_COMMANDS))
        placed = command in plan.POSITION_COMMANDS or kind != plan.MISSION
        frame = rng.choice((0, 3, 3, 3)) if placed or rng.random() < 0.03 else 2
        x, y = self.place() if frame != 2 else self.numbers(2)
        z = rng.uniform(2.0, 20.0) + (0.0 if frame else 488.0) if rng.random() < 0.95 else self.number()
        return mavlink.MAVLink_mission_item_message(
            self.system, 1, seq, frame, command, 0, rng.random() < 0.9, *p, x, y, z, kind
        )

    def sticks(self) -> None:
        rng = self.rng
        if rng.random() < 0.5:
            x, y, z, yaw = (rng.choice((-1000, 0, 0, 500, 1000, 0x7FFF)) for _ in range(4))
            self.send(mavlink.MAVLink_manual_control_message(self.system, x, y, abs(z), yaw, 0))
        else:
            channels = [rng.choice((0, 1000, 1500, 1500, 2000, 65535)) for _ in range(18)]
            self.send(mavlink.MAVLink_rc_channels_override_message(self.system, 1, *channels))

    def setpoint(self) -> None:
        rng, mask = self.rng, self.rng.getrandbits(12)
        kind = rng.randrange(3)
        for _ in range(2):
            if kind == 0:
                message = mavlink.MAVLink_set_position_target_local_ned_message(
                    0, self.system, 1, rng.choice((1, 8, 9)), mask, *self.numbers(11)
                )
            elif kind == 1:
                latitude, longitude, _ = self.commander.view.origin
                message = mavlink.MAVLink_set_position_target_global_int_message(
                    0, self.system, 1, rng.choice((5, 6)), mask, round(latitude * 1e7), round(longitude * 1e7),
                    *self.numbers(9)
                )  # fmt: skip
            else:
                message = mavlink.MAVLink_set_attitude_target_message(
                    0, self.system, 1, mask & 0xE7, self.numbers(4), *self.numbers(4)
                )
            self.send(message)
        if rng.random() < 0.3:
            self.send(mavlink.MAVLink_set_mode_message(self.system, 1, modes.OFFBOARD.custom_mode))

    def other(self) -> None:
        rng = self.rng
        latitude, longitude = (round(max(min(v, 200.0), -200.0) * 1e7) for v in self.commander.view.origin[:2])
        self.send(
            rng.choice(
                (
                    mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3),
                    mavlink.MAVLink_set_home_position_message(
                        self.system, latitude, longitude, rng.choice((0, 488000, -(1 << 31))), 0, 0, 0, [1, 0, 0, 0],
                        0, 0, 0
                    ),
                    mavlink.MAVLink_landing_target_message(
                        0, 0, rng.choice((1, 8)), *self.numbers(5), *self.numbers(3), [1, 0, 0, 0], 2, rng.randrange(2)
                    ),
                    mavlink.MAVLink_param_request_list_message(self.system, 1),
                    mavlink.MAVLink_log_request_list_message(self.system, 1, 0, 0xFFFF),
                    mavlink.MAVLink_mission_set_current_message(self.system, 1, rng.randrange(10)),
                )
            )
        )  # fmt: skip

    def fail(self) -> None:
        self.run(420, self.rng.choice((0, 1, 2, 3, 4, 100, 101, 104)), self.rng.randrange(6), self.rng.randrange(3))


class Flight:
    """Three vehicles far from each other, two of them disturbed by random clients."""

    def __init__(self, seed: int) -> None:
        places = [(FAR * i, 0.0, 0.0) for i in range(3)]
        self.simulation = Simulation(parse_fleet("iris:3"), places=places, seed=seed)
        self.clients = [Client(self.simulation, index, seed) for index in TROUBLED]
        self.rng = random.Random(seed)

    def start(self) -> None:
        """Take off with the undisturbed vehicle and hold its position."""
        self.run(2.0)
        commander = self.simulation.commanders[CALM]
        commander.parameters.set("MIS_TAKEOFF_ALT", HEIGHT)
        assert commander.request(modes.AUTO_TAKEOFF) == 0
        assert commander.arm_disarm(True) == 0
        self.run(12.0, trouble=False)
        assert commander.mode is modes.AUTO_LOITER

    def restart(self) -> None:
        self.simulation.restart()
        for client in self.clients:
            client.reboot(self.simulation)
        self.start()

    def run(self, seconds: float, *, trouble: bool = True) -> None:
        simulation = self.simulation
        end_us = simulation.time_us + seconds * 1e6
        while simulation.time_us < end_us:
            simulation.step()
            if trouble:
                for client in self.clients:
                    client.update()

    def check(self) -> None:
        """Check that the undisturbed vehicle holds its position."""
        control, plant = self.simulation.autopilot.control[CALM], self.simulation.world.plant[CALM]
        assert self.simulation.commanders[CALM].mode is modes.AUTO_LOITER
        assert np.isfinite(control["actuators"]).all()
        assert np.abs(plant["position"] - (0.0, 0.0, HEIGHT)).max() < 1.5

    def close(self) -> None:
        self.simulation.close()


def rage(seed: int, minutes: int) -> Flight:
    flight = Flight(seed)
    try:
        flight.start()
        for minute in range(minutes):
            if minute and minute % 3 == 0:
                flight.restart()
            flight.run(60.0)
            flight.check()
    finally:
        flight.close()
    return flight


@pytest.mark.parametrize("seed", range(30, 32))
def test_random_commands_raise_nothing_and_leave_the_others_alone(seed, caplog):
    caplog.set_level(logging.CRITICAL)  # values out of range cause thousands of warnings
    flight = rage(seed, minutes=4)
    assert all(client.told > 1000 for client in flight.clients)
