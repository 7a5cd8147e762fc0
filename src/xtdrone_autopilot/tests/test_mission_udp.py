"""A mission through real UDP sockets: two ground stations with pymavlink on one vehicle."""

from __future__ import annotations

import pytest
from autopilot_fakes import FIRST_ID, Flight
from pymavlink import mavwp
from pymavlink.dialects.v20 import common as mavlink
from test_mavlink_server import Client, heartbeat

from xtdrone_autopilot.mavlink.mavlink_server import MavlinkServer
from xtdrone_common import modes
from xtdrone_common.fleet import Vehicle

_SYSTEM = FIRST_ID + 1


class Field:
    """A vehicle that reaches a commanded position at once, its server, and two stations."""

    def __init__(self) -> None:
        self.flight = Flight(MAV_SYS_ID=_SYSTEM)
        vehicle = Vehicle("iris", 0, FIRST_ID)
        self.server = MavlinkServer([vehicle], self.flight.autopilot, [self.flight.commander])
        self.stations = [Client(0, vehicle.gcs_local_port, system) for system in (255, 254)]
        for station in self.stations:
            self.ask(station, heartbeat(6))

    def ask(self, station, message):
        """Send a message; return the replies without telemetry."""
        station.send(message)
        self.server.receive(1.0)
        return self.mission_messages(station)

    def mission_messages(self, station):
        return [m for m in station.receive() if m.get_type().startswith("MISSION")]

    def run(self, seconds, station):
        """Advance time, and return the mission messages that the station receives."""
        found = []
        for _ in range(round(seconds * 10)):
            self.flight.autopilot.time_us += 100_000
            self.flight.follow()
            self.flight.commander.update()
            self.server.send_streams(self.flight.autopilot.time_us)
            found += self.mission_messages(station)
        return found

    def close(self):
        self.server.close()
        for station in self.stations:
            station.socket.close()


@pytest.fixture
def field():
    field = Field()
    yield field
    field.close()


def survey():
    """Return a mission as pymavlink's loader holds it, with integer coordinates."""
    loader = mavwp.MAVWPLoader(target_system=_SYSTEM, target_component=1)
    for command, north in ((22, 0), (16, 2000), (206, 0), (16, 4000)):
        frame = 2 if command == 206 else 6
        place = (0, 0, 0.0) if command == 206 else (473977420 + north, 85455940, 10.0)
        param = 25.0 if command == 206 else 0.0
        loader.add(
            mavlink.MAVLink_mission_item_int_message(
                _SYSTEM, 1, loader.count(), frame, command, 0, 1, param, 0.0, 0.0, float("nan"), *place
            )
        )
    return loader


def upload(field, station, loader):
    (answer,) = field.ask(station, mavlink.MAVLink_mission_count_message(_SYSTEM, 1, loader.count()))
    while answer.get_type() != "MISSION_ACK":
        (answer,) = field.ask(station, loader.item(answer.seq))
    return answer.type


def test_one_uploads_and_the_other_downloads(field):
    first, second = field.stations
    loader = survey()
    assert upload(field, first, loader) == 0
    (total,) = field.ask(second, mavlink.MAVLink_mission_request_list_message(_SYSTEM, 1))
    assert (total.count, total.target_system) == (4, 254)
    for seq in range(4):
        (item,) = field.ask(second, mavlink.MAVLink_mission_request_int_message(_SYSTEM, 1, seq))
        sent = loader.item(seq)
        assert (item.seq, item.command, item.frame) == (seq, sent.command, sent.frame)
        assert (item.x, item.y, item.z) == (sent.x, sent.y, sent.z)
        assert item.param1 == sent.param1
    field.ask(second, mavlink.MAVLink_mission_ack_message(_SYSTEM, 1, 0))


def test_one_uploads_at_a_time(field):
    first, second = field.stations
    loader = survey()
    field.ask(first, mavlink.MAVLink_mission_count_message(_SYSTEM, 1, 4))
    (refusal,) = field.ask(second, mavlink.MAVLink_mission_count_message(_SYSTEM, 1, 4))
    assert (refusal.type, refusal.target_system) == (1, 0)
    for seq in range(4):
        (answer,) = field.ask(first, loader.item(seq))
    assert answer.type == 0


def test_both_hear_of_the_progress(field):
    first, second = field.stations
    upload(field, first, survey())
    flight = field.flight
    assert flight.commander.set_mode(1, modes.AUTO_MISSION.custom_mode) == 0
    assert flight.commander.arm_disarm(True) == 0
    told = field.run(2.0, second)
    reached = [m.seq for m in told if m.get_type() == "MISSION_ITEM_REACHED"]
    current = [m.seq for m in told if m.get_type() == "MISSION_CURRENT"]
    assert list(dict.fromkeys(reached)) == [0, 1, 2, 3]
    assert list(dict.fromkeys(current)) == [0, 1, 2, 3]
    assert {m.get_type() for m in field.mission_messages(first)} == {"MISSION_CURRENT", "MISSION_ITEM_REACHED"}
    assert flight.commander.mode is modes.AUTO_LOITER
