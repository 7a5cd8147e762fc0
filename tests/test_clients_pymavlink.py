"""Scripts over pymavlink's mavutil: one for nine vehicles, and four clients of three kinds at one vehicle."""

from __future__ import annotations

import itertools
import math
import os
import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest

os.environ.setdefault("MAVLINK20", "1")
from client_world import CLIENT_LIMIT, Core
from pymavlink import mavutil
from pymavlink.dialects.v20 import common as mavlink

FIRST = 160
COUNT = 9


class Station:
    """One mavutil connection to several vehicles.

    Attributes:
        connection: pymavlink's.
        last: newest message by system id and type.
    """

    def __init__(self, core: Core) -> None:
        self.connection = mavutil.mavlink_connection("udpin:127.0.0.1:0", source_system=250, dialect="common")
        self.last: dict[tuple[int, str], Any] = {}
        self._beat = 0.0
        for vehicle in core.vehicles:
            self.connection.clients.add(("127.0.0.1", vehicle.gcs_local_port))
        self._ends = [("127.0.0.1", vehicle.gcs_local_port) for vehicle in core.vehicles]
        self.connection.write = self._write  # to every vehicle, also before its first message

    def _write(self, buffer: bytes) -> None:
        for end in self._ends:
            self.connection.port.sendto(buffer, end)

    def listen(self) -> Any:
        """Receive one message; send a heartbeat each second."""
        if time.monotonic() >= self._beat:
            self._beat = time.monotonic() + 1.0
            self.connection.mav.heartbeat_send(6, 8, 0, 0, 4)
        message = self.connection.recv_match(blocking=True, timeout=0.2)
        if message is not None:
            self.last[message.get_srcSystem(), message.get_type()] = message
        return message

    def until(self, condition: Callable[[], bool], what: str) -> None:
        """Listen until ``condition`` holds."""
        end = time.monotonic() + CLIENT_LIMIT
        while not condition():
            assert time.monotonic() < end, what
            self.listen()

    def command(self, system: int, command: int, *params: float) -> int:
        """Send a command, repeat it each second as MAVLink clients do, and return its result.

        A busy client's socket may have no room for the acknowledgement.
        """
        key = system, "COMMAND_ACK"
        self.last.pop(key, None)
        values = [*params, *[0.0] * (7 - len(params))]
        attempts = itertools.count()
        sent = -math.inf

        def is_acknowledged() -> bool:
            nonlocal sent
            if time.monotonic() - sent > 1.0:
                sent = time.monotonic()
                self.connection.mav.command_long_send(system, 1, command, min(next(attempts), 255), *values)
            return key in self.last and self.last[key].command == command

        self.until(is_acknowledged, f"ack of {command} by {system}")
        return int(self.last[key].result)

    def height(self, system: int) -> float:
        """Return the last received height above home, m."""
        message = self.last.get((system, "GLOBAL_POSITION_INT"))
        return message.relative_alt * 1e-3 if message else math.nan

    def close(self) -> None:
        self.connection.close()


@pytest.fixture(autouse=True)
def short_reads(monkeypatch: pytest.MonkeyPatch) -> None:
    """Limit pymavlink's reads of a datagram to the size that real MAVROS reads."""
    monkeypatch.setattr(mavutil, "UDP_MAX_PACKET_LEN", 296)


@pytest.fixture(scope="module")
def core(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Core]:
    core = Core(FIRST, tmp_path_factory.mktemp("pymavlink"), count=COUNT, speed=4.0)
    yield core
    core.close()


@pytest.fixture
def station(core: Core) -> Iterator[Station]:
    station = Station(core)
    yield station
    station.close()


def test_one_script_flies_nine_vehicles(core, station):
    systems = [vehicle.system_id for vehicle in core.vehicles]
    station.until(lambda: all((s, "HEARTBEAT") in station.last for s in systems), "nine heartbeats")
    assert {station.last[s, "HEARTBEAT"].autopilot for s in systems} == {mavlink.MAV_AUTOPILOT_PX4}
    station.until(lambda: all((s, "HOME_POSITION") in station.last for s in systems), "nine homes")
    for system in systems:
        assert station.command(system, mavlink.MAV_CMD_DO_SET_MODE, 1, 4, 2) == 0  # AUTO.TAKEOFF
        assert station.command(system, mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1) == 0
    station.until(lambda: all(station.height(s) > 1.2 for s in systems), "nine are up")
    for system in systems:
        assert station.command(system, mavlink.MAV_CMD_NAV_LAND) == 0
    station.until(
        lambda: not any(station.last[s, "HEARTBEAT"].base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED for s in systems),
        "nine are disarmed",
    )
    assert core.alive


def test_a_parameter_list_is_complete_at_each(core, station):
    """Messages without room in a busy client's socket are requested again, as every ground station does."""
    for vehicle in core.vehicles[:3]:
        names: dict[int, str] = {}
        total = 0
        station.connection.mav.param_request_list_send(vehicle.system_id, 1)
        end, heard = time.monotonic() + CLIENT_LIMIT, time.monotonic()
        while not total or len(names) < total:
            now = time.monotonic()
            assert now < end, (len(names), total)
            if total and now - heard > 1.0:
                heard = now
                for index in [index for index in range(total) if index not in names][:20]:
                    station.connection.mav.param_request_read_send(vehicle.system_id, 1, b"", index)
            message = station.listen()
            if message is not None and message.get_type() == "PARAM_VALUE" and message.param_index != 65535:
                assert message.get_srcSystem() == vehicle.system_id
                names[message.param_index] = message.param_id
                total, heard = message.param_count, now
        assert "MPC_XY_VEL_MAX" in names.values()
