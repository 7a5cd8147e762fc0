"""MAVProxy at its prompt, against the autopilot, alone and then beside other clients: tests in file order.

Its ``mode`` command is not used: with PX4's mode numbers MAVProxy and pymavlink do not agree on the arguments.
"""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
from client_world import CLIENT_LIMIT, Core

pytest.importorskip("MAVProxy")

FIRST = 150
MISSION = """QGC WPL 110
0\t1\t3\t22\t0\t0\t0\t0\t47.397800\t8.545594\t6\t1
1\t0\t3\t16\t1\t0\t0\t0\t47.397900\t8.545594\t8\t1
2\t0\t3\t16\t1\t0\t0\t0\t47.397900\t8.545750\t8\t1
3\t0\t3\t21\t0\t0\t0\t0\t47.397800\t8.545750\t0\t1
"""  # counted from the takeoff: MAVProxy's waypoint 0 is PX4's first


class Prompt:
    """A MAVProxy process and its output."""

    def __init__(self, port: int, folder: Path) -> None:
        program = Path(sys.executable).with_name("mavproxy.py")
        self._process = subprocess.Popen(
            [sys.executable, "-u", str(program), f"--master=udpout:127.0.0.1:{port}", f"--state-basedir={folder}"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            cwd=folder,
            env={**os.environ, "HOME": str(folder), "PYTHONUNBUFFERED": "1"},
        )
        self._text = ""
        self._changed = threading.Condition()
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        assert self._process.stdout is not None
        while piece := os.read(self._process.stdout.fileno(), 4096):
            with self._changed:
                self._text += piece.decode(errors="replace")
                self._changed.notify_all()

    @property
    def length(self) -> int:
        """Number of characters written so far."""
        with self._changed:
            return len(self._text)

    def say(self, line: str, *answers: str) -> str:
        """Type a line, wait until all ``answers`` follow it, and return the output since then."""
        assert self._process.stdin is not None
        start = self.length
        self._process.stdin.write(line + "\n")
        self._process.stdin.flush()
        return self.wait(*answers, start=start)

    def wait(self, *texts: str, start: int = 0) -> str:
        """Wait until all ``texts`` are in the output from ``start`` on; return that output."""
        with self._changed:
            found = self._changed.wait_for(lambda: all(text in self._text[start:] for text in texts), CLIENT_LIMIT)
            assert found, f"MAVProxy does not write {texts}, but {self._text[start:][-2000:]!r}"
            return self._text[start:]

    def close(self) -> None:
        self._process.kill()  # it does not always end on request
        self._process.wait()
        self._reader.join(CLIENT_LIMIT)


@pytest.fixture(scope="module")
def core(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Core]:
    # PX4 forgets a mission transfer after 5 s of simulated time, and MAVProxy never asks for its start again.
    core = Core(FIRST, tmp_path_factory.mktemp("mavproxy_core"), speed=2.0)
    yield core
    core.close()


@pytest.fixture(scope="module")
def prompt(core: Core, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Prompt]:
    prompt = Prompt(core.vehicles[0].gcs_local_port, tmp_path_factory.mktemp("mavproxy"))
    yield prompt
    prompt.close()


def test_it_finds_a_vehicle_and_its_parameters(prompt):
    prompt.wait(f"Detected vehicle {FIRST + 1}:1", "Received ", "parameters")


def test_parameters(prompt):
    prompt.say("param show MPC_XY_VEL_MAX", "MPC_XY_VEL_MAX   12.0")
    prompt.say("param set MIS_TAKEOFF_ALT 6")
    for _ in range(100):  # MAVProxy sends the setting later, and does not report when
        if "= 6.0" in prompt.say("param fetch MIS_TAKEOFF_ALT", "MIS_TAKEOFF_ALT = "):
            return
    pytest.fail("the parameter is not set")


def test_a_mission_is_loaded_listed_and_saved(prompt, tmp_path):
    (tmp_path / "mission.txt").write_text(MISSION)
    prompt.say(f"wp load {tmp_path}/mission.txt", "Loaded 4 waypoints", "Sent all 4 waypoints")
    prompt.say("wp list", "Saved 4 waypoints")
    prompt.say(f"wp save {tmp_path}/back.txt", "Saved 4 waypoints")
    assert len((tmp_path / "back.txt").read_text().splitlines()) == 5


def test_it_arms_takes_off_and_flies_the_mission(prompt):
    prompt.say("arm throttle", "COMPONENT_ARM_DISARM: ACCEPTED")
    prompt.wait("ARMED")
    prompt.say("long MISSION_START 0 0", "MISSION_START: ACCEPTED")
    prompt.wait("MISSION>")
    prompt.wait("waypoint 1", "waypoint 2", "Mission finished, landed")
    prompt.wait("DISARMED")


def test_modes_by_command(prompt):
    prompt.say("long DO_SET_MODE 1 4 5", "Mode RTL")
    prompt.say("long DO_SET_MODE 1 4 3", "Mode LOITER")


def test_four_clients_at_one_vehicle(core, prompt):
    """Each works while the others do; one disconnects in flight, and another one connects."""
    pytest.importorskip("mavsdk")
    from pymavlink.dialects.v20 import common as mavlink
    from test_clients_mavsdk import Client
    from test_clients_pymavlink import Station

    vehicle = core.vehicles[0]
    system = vehicle.system_id
    onboard = Client(f"udpin://127.0.0.1:{vehicle.offboard_remote_port}")
    ground = Client(f"udpout://127.0.0.1:{vehicle.gcs_local_port}")
    script = Station(core)
    start = prompt.length
    try:
        script.until(lambda: (system, "HEARTBEAT") in script.last, "a heartbeat")
        # one sets, all receive it
        script.connection.mav.param_set_send(system, 1, b"MIS_TAKEOFF_ALT", 4.0, 9)
        script.until(
            lambda: getattr(script.last.get((system, "PARAM_VALUE")), "param_id", "") == "MIS_TAKEOFF_ALT", "its answer"
        )
        for client in (onboard, ground):
            assert client.run(client.drone.param.get_param_float("MIS_TAKEOFF_ALT")) == 4.0
        # one arms, another one takes off, all receive it
        ground.until(ground.drone.telemetry.health(), lambda health: health.is_armable)
        prompt.say("arm throttle", "COMPONENT_ARM_DISARM: ACCEPTED")
        onboard.until(onboard.drone.telemetry.armed(), lambda armed: armed)
        onboard.run(onboard.drone.action.takeoff())
        ground.until(ground.drone.telemetry.position(), lambda position: position.relative_altitude_m > 3.0)
        script.until(lambda: script.height(system) > 3.0, "the script sees it")
        prompt.wait("Takeoff detected", start=start)
        # one disconnects, the others stay
        onboard.close()
        assert script.command(system, mavlink.MAV_CMD_NAV_LAND) == 0
        ground.until(ground.drone.telemetry.armed(), lambda armed: not armed)
        prompt.wait("DISARMED", start=start)
        # another one connects in its place
        onboard = Client(f"udpin://127.0.0.1:{vehicle.offboard_remote_port}")
        assert not onboard.until(onboard.drone.telemetry.in_air(), lambda in_air: not in_air)
    finally:
        script.close()
        for client in (onboard, ground):
            client.close()


def test_the_core_lives(core):
    assert core.alive
