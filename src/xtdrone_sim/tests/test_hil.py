"""PX4s in our autopilot's place: the simulator link against a stand-in written from PX4's side."""

from __future__ import annotations

import contextlib
import logging
import math
import socket
import time
from collections import Counter
from functools import partial
from itertools import pairwise

import numpy as np
import pytest
from px4_stand_in import ACCEL, BARO, GYRO, MAG, WALL_LIMIT, StandIn

from xtdrone_autopilot.mavlink.streams.vehicle_state import EPOCH_US
from xtdrone_common.fleet import Vehicle
from xtdrone_common.geodesy.projection import project
from xtdrone_sim.autopilots import px4_hil_fleet as hil_module
from xtdrone_sim.autopilots.px4_hil_fleet import Hil
from xtdrone_sim.autopilots.px4_hil_link import RELOCK_STEPS, STALE_US, HilError
from xtdrone_sim.simulation import Simulation

FLEET = (Vehicle("iris", 0, 71), Vehicle("iris", 1, 72))  # ports that no other test uses
TAKE_OFF_US = 3_000_000
STEP = 4000


class World:
    """A simulation whose vehicles are flown by PX4s, and the messages of its links."""

    def __init__(self, count: int = 1, **options: object) -> None:
        self.log: list[tuple[int, str]] = []
        self.simulation = Simulation(
            FLEET[:count],
            seed=5,
            autopilots=partial(Hil, log=lambda level, text: self.log.append((level, text)), **options),
        )
        self.hil = self.simulation.autopilots
        self.px4s: list[StandIn] = []

    def start(self, index: int = 0, script=None, **options) -> StandIn:
        """Start a PX4 and wait for its link."""
        px4 = StandIn(FLEET[index], script, **options)
        self.px4s.append(px4)
        end = time.monotonic() + WALL_LIMIT
        while f":{px4.port}" not in " ".join(text for _, text in self.log):
            assert time.monotonic() < end, self.log
            self.hil.serve()
        return px4

    def run(self, seconds: float) -> None:
        until = self.simulation.time_us + round(seconds * 1e6)
        while self.simulation.time_us < until:
            self.simulation.step()
            for px4 in self.px4s:
                px4.check()

    def said(self, text: str) -> int:
        """Return the level of the first message with ``text``."""
        found = [level for level, said in self.log if text in said]
        assert found, (text, self.log)
        return found[0]

    def height(self, index: int = 0) -> float:
        return float(self.simulation.world.plant["position"][index, 2])


@contextlib.contextmanager
def world(count: int = 1, **options):
    made = World(count, **options)
    try:
        yield made
    finally:
        made.simulation.close()


def take_off(px4: StandIn) -> None:
    px4.take_off()


@pytest.fixture(scope="module", autouse=True)
def patience():
    """Extend the limit of silence, so that a stand-in delayed by a busy machine does not count as silent."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(hil_module, "DISARMED_LIMIT", WALL_LIMIT)
        yield


@pytest.fixture(scope="module")
def flight():
    """One PX4's flight: three seconds on the ground, then a takeoff."""
    with world() as made:
        px4 = made.start(script={TAKE_OFF_US: take_off}, keep=2000)
        states = []
        for _ in range(16 * 250):
            made.simulation.step()
            states.append(made.simulation.world.plant[0].copy())
        px4.check()
    return made, px4, states


def test_it_takes_off_and_hovers(flight):
    made, _, states = flight
    late = np.array([state["position"] for state in states[-250:]])
    assert np.ptp(late[:, 2]) < 0.3
    assert late[:, 2].mean() == pytest.approx(1.7, abs=0.3)  # MIS_TAKEOFF_ALT, less the acceptance radius
    spawn = states[0]["position"]
    assert np.linalg.norm(late[:, :2] - spawn[:2], axis=1).max() < 0.3
    assert made.said("in lockstep") == logging.INFO
    # on a slow machine the simulation waits, which is logged
    assert all(level < logging.WARNING for level, text in made.log if "the world has waited" not in text)


def test_every_step_is_answered_and_used_in_the_next(flight):
    made, px4, states = flight
    assert [time_us for time_us, _ in px4.sent] == [STEP * (k + 1) for k in range(len(states))]
    actuators = made.simulation.autopilot.control["actuators"][0]
    assert actuators.tolist() == pytest.approx(px4.sent[-1][1], abs=1e-7)
    assert actuators[:4].min() > 0.3


def test_messages_have_px4s_rates(flight):
    _, px4, _ = flight
    counts = Counter(message.get_type() for message in px4.received)
    fields = Counter()
    for message in px4.received:
        if message.get_type() == "HIL_SENSOR":
            for name, bits in (("imu", ACCEL | GYRO), ("mag", MAG), ("baro", BARO)):
                fields[name] += message.fields_updated & bits == bits
    assert counts["HIL_SENSOR"] == pytest.approx(2000, abs=1)  # 8 s
    assert fields == {"imu": counts["HIL_SENSOR"], "mag": 400, "baro": 200}
    assert counts["HIL_GPS"] == 79
    assert counts["HIL_STATE_QUATERNION"] == pytest.approx(1600, abs=10)  # PX4 requests 5 ms
    assert counts["HEARTBEAT"] == 8


def test_messages_are_in_order_and_in_px4s_time(flight):
    _, px4, _ = flight
    sequence = [message.get_header().seq for message in px4.received]
    assert all((b - a) % 256 == 1 for a, b in pairwise(sequence[10:]))
    sensors = [message for message in px4.received if message.get_type() == "HIL_SENSOR"]
    assert [message.time_usec for message in sensors] == [STEP * (k + 1) for k in range(len(sensors))]
    assert px4.received[0].get_type() == "HIL_SENSOR"  # PX4's clock has no time before it
    now = 0
    for message in reversed(px4.received):  # the messages of a step precede its HIL_SENSOR
        if message.get_type() == "HIL_SENSOR":
            now = message.time_usec
        elif message.get_type() == "HIL_GPS":
            assert message.time_usec == EPOCH_US + now
        elif message.get_type() == "HIL_STATE_QUATERNION":
            assert message.time_usec == now


def test_samples_are_px4s_units_and_frames(flight):
    made, px4, _ = flight
    on_ground = px4.received[:500]
    sensors = [message for message in on_ground if message.get_type() == "HIL_SENSOR"]
    accel = np.mean([(m.xacc, m.yacc, m.zacc) for m in sensors], axis=0)
    assert accel[2] == pytest.approx(-9.8, abs=0.3)  # FRD: gravity's reaction points up
    assert np.abs(accel[:2]).max() < 0.3
    baro = next(m for m in sensors if m.fields_updated & BARO == BARO)
    assert baro.abs_pressure == pytest.approx(955.9, abs=2.0)  # hPa at 488 m
    assert baro.pressure_alt == pytest.approx(488.0, abs=3.0)
    assert baro.temperature == pytest.approx(11.8, abs=0.5)
    mag = np.mean([(m.xmag, m.ymag, m.zmag) for m in sensors if m.fields_updated & MAG], axis=0)
    heading = math.atan2(-mag[1], mag[0]) + math.radians(3.0)  # spawned facing east: magnetic north is on the left
    assert heading == pytest.approx(math.pi / 2, abs=0.1)
    gps = next(m for m in on_ground if m.get_type() == "HIL_GPS")
    datum = made.simulation.world.model.datum
    north, east = project(gps.lat * 1e-7, gps.lon * 1e-7, datum.latitude, datum.longitude)
    x, y, _ = made.simulation.world.plant["position"][0]
    assert (east, north) == (pytest.approx(x, abs=0.3), pytest.approx(y, abs=0.3))
    assert gps.alt * 1e-3 == pytest.approx(datum.altitude, abs=0.5)
    assert (gps.fix_type, gps.satellites_visible, gps.id) == (3, 14, 0)
    assert 1 <= gps.eph < 100


def test_ground_truth_is_the_worlds(flight):
    made, px4, states = flight
    datum = made.simulation.world.model.datum
    truths = [message for message in px4.received if message.get_type() == "HIL_STATE_QUATERNION"]
    for message in truths[::100] + truths[-20:]:
        state = states[message.time_usec // STEP - 1]
        north, east = project(message.lat * 1e-7, message.lon * 1e-7, datum.latitude, datum.longitude)
        x, y, z = state["position"]
        assert (east, north) == (pytest.approx(x, abs=0.02), pytest.approx(y, abs=0.02))
        assert message.alt * 1e-3 - datum.altitude == pytest.approx(z, abs=0.002)
        vx, vy, vz = state["velocity"]
        assert (message.vy * 1e-2, message.vx * 1e-2, -message.vz * 1e-2) == pytest.approx((vx, vy, vz), abs=0.01)
        assert message.rollspeed == pytest.approx(state["rates"][0], abs=1e-5)
        assert message.yawspeed == pytest.approx(-state["rates"][2], abs=1e-5)
        w, qx, qy, qz = message.attitude_quaternion
        heading = math.atan2(2.0 * (w * qz + qx * qy), 1.0 - 2.0 * (qy * qy + qz * qz))
        assert heading == pytest.approx(math.pi / 2, abs=0.2)  # faces east
        assert 1.0 - 2.0 * (qx * qx + qy * qy) > 0.98  # upright


def test_the_same_run_twice_is_the_same_to_the_bit():
    finals = []
    for _ in range(2):
        with world(2) as made:
            for index in range(2):
                made.start(index, {TAKE_OFF_US: take_off})
            made.run(6.0)
            finals.append(made.simulation.world.plant.tobytes())
            assert min(made.height(0), made.height(1)) > 0.5
    assert finals[0] == finals[1]


def test_one_that_dies_stops_its_motors_and_the_other_flies_on():
    with world(2) as made:
        first, _ = (made.start(index, {TAKE_OFF_US: take_off}) for index in range(2))
        made.run(7.0)
        assert made.height(0) > 1.0
        first.kill()
        made.run(1.5)
        assert made.said("iris_0's PX4 has closed its link, armed: its motors stop") == logging.WARNING
        assert not made.simulation.autopilot.setpoint["armed"][0]
        assert made.height(0) < 0.5
        assert made.height(1) > 1.5
        # a new PX4 takes the vehicle over, in its own time
        again = made.start(0, {TAKE_OFF_US: take_off})
        made.run(7.0)
        assert again.sent[0][0] > 8_000_000
        assert made.height(0) > 1.0
        assert made.height(1) > 1.5


def test_a_disarmed_ones_silence_does_not_stop_the_world(monkeypatch):
    """The world advances although PX4 sends no controls while disarmed in OFFBOARD without setpoints."""
    monkeypatch.setattr(hil_module, "DISARMED_LIMIT", 0.2)

    def be_silent(px4: StandIn) -> None:
        px4.silent = True

    def speak(px4: StandIn) -> None:
        px4.silent = False

    with world() as made:
        px4 = made.start(script={1_000_000: be_silent, 1_200_000: speak, TAKE_OFF_US: take_off})
        made.run(1.1)
        assert made.said("disarmed and silent") == logging.INFO
        assert not made.hil.links[0].locked
        while not made.hil.links[0].locked:  # its replies lag behind the world, which does not wait for them
            assert made.simulation.time_us < TAKE_OFF_US
            made.run(STEP * 1e-6)
        assert made.simulation.time_us >= 1_200_000 + RELOCK_STEPS * STEP
        made.run(5.0)
        assert made.height() > 0.5
        assert [time_us for time_us, _ in px4.sent] == list(range(STEP, px4.sent[-1][0] + 1, STEP))
        assert made.simulation.autopilot.control["actuators"][0].tolist() == pytest.approx(px4.sent[-1][1], abs=1e-7)


def test_an_armed_one_is_waited_for_and_then_has_its_motors_stopped():
    def hang(px4: StandIn) -> None:
        px4.silent = True

    idled = []
    with world(hang_limit=1.5, idle=idled.append) as made:
        made.start(script={TAKE_OFF_US: take_off, 6_000_000: hang})
        made.run(5.9)
        began = time.monotonic()
        made.run(0.12)
        assert time.monotonic() - began >= 1.5
        assert idled
        assert made.said("armed and does not respond") == logging.WARNING
        assert made.simulation.autopilot.control["actuators"][0].max() > 0.0  # the last ones hold for a while
        made.run((STALE_US + 2 * STEP) * 1e-6)
        assert made.said("has sent no controls for 0.2 s: its motors stop") == logging.WARNING
        assert made.simulation.autopilot.control["actuators"][0].max() == 0.0


def test_one_without_lockstep_is_not_waited_for():
    with world() as made:
        made.start(lockstep=False)
        while not any("without lockstep" in text for _, text in made.log):
            made.run(0.004)
        assert made.said("without lockstep") == logging.INFO
        assert not made.hil.links[0].awaited


def test_time_waits_for_every_px4():
    with world(2) as made:
        assert made.hil.missing() == "no PX4 has connected for iris_0 (TCP port 4631), iris_1 (TCP port 4632)"
        made.start(1)
        assert made.hil.missing() == "no PX4 has connected for iris_0 (TCP port 4631)"
        made.start(0)
        assert made.hil.missing() == ""


def test_its_time_never_goes_back():
    with world() as made:
        px4 = made.start()
        made.run(1.0)
        made.simulation.restart(0)
        made.run(1.0)
        assert made.simulation.time_us == made.simulation.autopilot.time_us == 1_000_000
        assert [time_us for time_us, _ in px4.sent] == [STEP * (k + 1) for k in range(500)]


def test_strange_bytes_are_passed_over_or_end_the_link(monkeypatch):
    monkeypatch.setattr(hil_module, "DISARMED_LIMIT", 0.5)  # a reply is lost among the invalid bytes
    with world() as made:
        with socket.create_connection(("127.0.0.1", FLEET[0].simulator_tcp_port)) as stranger:
            stranger.sendall(b"GET / HTTP/1.1\r\n\r\n" * 300)
            end = time.monotonic() + WALL_LIMIT
            while not any("does not speak MAVLink" in text for _, text in made.log):
                assert time.monotonic() < end
                made.run(0.02)
        px4 = made.start(script={1_000_000: lambda px4: px4._socket.sendall(b"\xfd\xff\x00\x00\xfe\xfd" * 10)})
        made.run(2.0)
        px4.check()
        assert made.said("bytes that are not MAVLink") == logging.WARNING
        assert len(px4.sent) == 500
        assert made.hil.links[0].connection is not None


def test_a_second_px4_is_rejected_while_the_first_one_answers():
    with world() as made:
        first = made.start()
        made.run(0.5)
        with socket.create_connection(("127.0.0.1", FLEET[0].simulator_tcp_port), timeout=WALL_LIMIT) as second:
            while not any("a second one" in text for _, text in made.log):
                made.run(0.02)
            assert second.recv(10) == b""
        made.run(0.5)
        assert len(first.sent) >= 250


def test_an_occupied_port_is_reported_and_no_port_stays_bound():
    with world(), pytest.raises(HilError, match=r"iris_0: TCP port 4631 of PX4's simulator link cannot be bound"):
        World()
    with world():
        pass


@pytest.mark.parametrize("outputs", [[math.nan] * 16, [7.0, -3.0] + [0.0] * 14])
def test_outputs_out_of_range_are_held_in_it(outputs):
    with world() as made:
        px4 = made.start(script={TAKE_OFF_US: take_off})
        made.run(3.5)
        px4.firmware.step = lambda message, time_us: (outputs[:8], True)
        made.run(0.1)
        actuators = made.simulation.autopilot.control["actuators"][0]
        assert ((actuators >= 0.0) & (actuators <= 1.0)).all()
