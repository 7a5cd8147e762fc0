"""The node on a real master: with a scripted autopilot, in lockstep, and when it cannot run."""

from __future__ import annotations

import json
import math
import os
import socket
import subprocess
import sys
import threading
import time
import xmlrpc.client
from pathlib import Path

import pytest
from mavros_fakes import free_udp_port, udp_socket
from pymavlink.dialects.v20 import common as mavlink

from xtdrone_autopilot.mavlink.wire.dialect import MESSAGE_ID
from xtdrone_common import frames
from xtdrone_lockstep.server import LockstepServer
from xtdrone_mavros.mavros_node import system_state

HERE = Path(__file__).parent
NODE = HERE.parent / "nodes" / "mavros_node.py"
LIMIT = 120.0  # s, for any action of another process

HEARTBEAT = mavlink.MAVLink_heartbeat_message(2, 12, 0x1D, 0x03040000, 3, 3)


def free_tcp_port() -> int:
    with socket.socket() as sock:
        sock.bind(("127.0.0.1", 0))
        return sock.getsockname()[1]


@pytest.fixture
def master(running_master):
    """Return the running master without the parameters of the last node."""
    proxy, _ = running_master
    if proxy.hasParam("/test", "/iris_0")[2]:
        proxy.deleteParam("/test", "/iris_0")
    return running_master


@pytest.fixture(scope="module")
def running_master():
    """Start a master; yield its proxy, and the environment that names it."""
    port = free_tcp_port()
    uri = f"http://127.0.0.1:{port}"
    process = subprocess.Popen(
        [sys.executable, "-c", "import rosmaster; rosmaster.rosmaster_main()", "--core", "-p", str(port)],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    proxy = xmlrpc.client.ServerProxy(uri)
    deadline = time.monotonic() + LIMIT
    while True:
        try:
            proxy.getPid("/test")
            break
        except OSError:
            assert process.poll() is None, "rosmaster ended"
            assert time.monotonic() < deadline, "rosmaster does not answer"
            time.sleep(0.05)
    yield proxy, {**os.environ, "ROS_MASTER_URI": uri, "ROS_HOSTNAME": "127.0.0.1"}
    process.terminate()
    process.wait()


def start_node(environment, *arguments):
    return subprocess.Popen(
        [sys.executable, str(NODE), *arguments],
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


def end(process) -> tuple[int, str]:
    process.terminate()
    output, _ = process.communicate(timeout=LIMIT)
    return process.returncode, output


class ScriptedFcu(threading.Thread):
    """An autopilot that sends telemetry at 50 Hz, accepts arming, rejects disarming, and keeps received messages.

    Attributes:
        setpoints: SET_POSITION_TARGET_LOCAL_NED messages.
        modes: custom modes of SET_MODE.
        intervals: message id to the last requested interval.
    """

    q = frames.quaternion_from_rpy(0.1, -0.2, 0.7)

    def __init__(self, remote_port: int) -> None:
        super().__init__(daemon=True)
        self.socket = udp_socket()
        self.socket.settimeout(0.02)
        self.port = self.socket.getsockname()[1]
        self.setpoints: list = []
        self.modes: list[int] = []
        self.intervals: dict[int, int] = {}
        self.arrived = threading.Condition()
        self._remote = ("127.0.0.1", remote_port)
        self._packer = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
        self._parser = mavlink.MAVLink(None)
        self._ending = threading.Event()
        self._boot_ns = time.monotonic_ns()

    def run(self) -> None:
        while not self._ending.is_set():
            self._telemetry((time.monotonic_ns() - self._boot_ns) // 1_000_000)
            try:
                datagram = self.socket.recv(65535)
            except TimeoutError:
                continue
            for message in self._parser.parse_buffer(datagram) or []:
                with self.arrived:
                    self._answer(message)
                    self.arrived.notify_all()

    def end(self) -> None:
        self._ending.set()
        self.join()
        self.socket.close()

    def wait(self, predicate) -> None:
        with self.arrived:
            assert self.arrived.wait_for(predicate, LIMIT)

    def _telemetry(self, boot_ms: int) -> None:
        self._send(HEARTBEAT)
        telemetry = [
            mavlink.MAVLink_highres_imu_message(boot_ms * 1000, 0.1, 0.2, -9.8, *[0.0] * 10, 0x3F),
            mavlink.MAVLink_attitude_quaternion_message(boot_ms, *self.q, 0.0, 0.0, 0.0),
            mavlink.MAVLink_local_position_ned_message(boot_ms, 1.0, 2.0, -3.0, 0.0, 0.0, 0.0),
            mavlink.MAVLink_vfr_hud_message(0.0, 0.0, 0, 0, 0.0, 0.0),
        ]
        for message in telemetry:
            if self.intervals.get(message.get_msgId(), 0) >= 0:
                self._send(message)

    def _answer(self, message) -> None:
        kind = message.get_type()
        if kind == "TIMESYNC" and message.tc1 == 0:
            self._send(mavlink.MAVLink_timesync_message(time.monotonic_ns() - self._boot_ns, message.ts1))
        elif kind == "SET_MODE":
            self.modes.append(message.custom_mode)
            self._send(mavlink.MAVLink_command_ack_message(mavlink.MAV_CMD_DO_SET_MODE, 0))
        elif kind == "SET_POSITION_TARGET_LOCAL_NED":
            self.setpoints.append(message)
        elif kind == "COMMAND_LONG":
            if message.command == mavlink.MAV_CMD_SET_MESSAGE_INTERVAL:
                self.intervals[int(message.param1)] = int(message.param2)
            refused = message.command == mavlink.MAV_CMD_COMPONENT_ARM_DISARM and message.param1 == 0.0
            self._send(mavlink.MAVLink_command_ack_message(message.command, 1 if refused else 0))

    def _send(self, message) -> None:
        self.socket.sendto(message.pack(self._packer), self._remote)


def test_topics_and_services_of_one_vehicle(master):
    _, environment = master
    port = free_udp_port()
    fcu = ScriptedFcu(port)
    url = f"udp://127.0.0.1:{port}@127.0.0.1:{fcu.port}"
    node = start_node(environment, "__ns:=/iris_0", f"_fcu_url:={url}")
    fcu.start()
    client = subprocess.Popen(
        [sys.executable, str(HERE / "mavros_client.py")],
        env=environment,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    try:
        seen = json.loads(client.stdout.readline())
        fcu.wait(lambda: len(fcu.setpoints) == 3)
        # The client subscribed to pose and imu and has left; vfr_hud never had a subscriber.
        vfr_hud, position = MESSAGE_ID["VFR_HUD"], MESSAGE_ID["LOCAL_POSITION_NED"]
        fcu.wait(lambda: fcu.intervals.get(vfr_hud) == -1 and fcu.intervals.get(position) == -1)
    finally:
        client.communicate()
        code, output = end(node)
        fcu.end()
    assert code == 0, output
    assert client.returncode == 0
    assert seen["state"] == [True, False, "AUTO.LOITER"]
    assert seen["position"] == [2.0, 1.0, 3.0]
    assert abs(seen["pose_age"]) < LIMIT
    expected = frames.attitude_ned_to_enu(*fcu.q)
    assert abs(sum(a * b for a, b in zip(seen["orientation"], expected, strict=True))) == pytest.approx(1.0, abs=1e-6)
    assert seen["acceleration"] == pytest.approx([0.1, -0.2, 9.8], abs=1e-6)
    assert seen["arming"] == [[True, 0], [False, 1]]
    assert seen["modes"] == [True, True, False]
    assert fcu.modes == [6 << 16, 65536]
    assert "OFFBORD" in output

    world, body_velocity, body_offset = fcu.setpoints
    assert (world.coordinate_frame, world.type_mask) == (1, 0b1001_1111_1000)
    assert (world.x, world.y, world.z) == (2.0, 1.0, -3.0)
    assert world.yaw == pytest.approx(math.pi / 2 - 0.3, abs=1e-6)
    assert (body_velocity.coordinate_frame, body_velocity.type_mask) == (8, 0b0101_1100_0111)
    assert (body_velocity.vx, body_velocity.vy, body_velocity.vz) == (4.0, -5.0, -6.0)
    assert body_velocity.yaw_rate == pytest.approx(-0.4, abs=1e-6)
    assert (body_offset.coordinate_frame, body_offset.x, body_offset.y, body_offset.z) == (9, 1.0, -2.0, -3.0)
    assert body_offset.yaw == pytest.approx(-0.3, abs=1e-6)


def test_lockstep_reads_the_counted_messages_and_counts_its_own(master):
    """The test plays the simulator: each tick it sends a datagram before TICK, and DONE counts the replies."""
    proxy, environment = master
    server = LockstepServer("127.0.0.1", hang_limit=LIMIT)
    proxy.setParam("/test", "/lockstep/uri", server.uri)
    fcu = udp_socket()
    port, fcu_port = free_udp_port(), fcu.getsockname()[1]
    server.open_datagram_ports([fcu_port])
    packer = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
    node = start_node(environment, "__ns:=/iris_0", f"_fcu_url:=udp://127.0.0.1:{port}@127.0.0.1:{fcu_port}")
    try:
        assert server.wait_for(1, timeout=LIMIT)
        beats, received, now_us = 0, 0, 0
        for sent in range(1, 101):
            now_us = server.next_due_us(now_us)
            fcu.sendto(HEARTBEAT.pack(packer), ("127.0.0.1", port))
            server.tick(now_us, {port: sent})
            while received < server.datagrams_expected.get(fcu_port, 0):
                [message] = mavlink.MAVLink(None).parse_buffer(fcu.recv(65535))
                received += 1
                beats += message.get_type() == "HEARTBEAT"
        assert now_us == 2_000_000  # 100 turns at 50 Hz
        assert beats == 2  # one per simulated second, at any speed
        with pytest.raises(BlockingIOError):
            fcu.recv(65535)  # no uncounted datagram
    finally:
        proxy.deleteParam("/test", "/lockstep/uri")
        _, output = end(node)
        server.close()
        fcu.close()
    assert "did not arrive" not in output
    assert "connected to autopilot 1.1" in output


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["_fleet:=iris:0"], "iris"),
        (["_fleet:=iris:10000"], "10000 of type 'iris'"),
        (["_fleet:=Iris 3"], "'Iris 3'"),
        ([], "set /xtdrone/fleet"),
        (["_fcu_url:=serial:///dev/ttyACM0:57600"], "fcu_url"),
        (["_fcu_url:=udp://:1@", "_conn/timeout:=soon"], "conn/timeout"),
    ],
)
def test_startup_errors_are_reported(master, arguments, said):
    _, environment = master
    if "_conn/timeout:=soon" in arguments:
        arguments[0] = f"_fcu_url:=udp://:{free_udp_port()}@"
    node = start_node(environment, "__ns:=/iris_0", *arguments)
    output, _ = node.communicate(timeout=LIMIT)
    assert node.returncode == 1
    assert said in output


def test_occupied_port_is_reported(master):
    _, environment = master
    taken = udp_socket()
    port = taken.getsockname()[1]
    node = start_node(environment, "__ns:=/iris_0", f"_fcu_url:=udp://127.0.0.1:{port}@127.0.0.1:9")
    output, _ = node.communicate(timeout=LIMIT)
    taken.close()
    assert node.returncode == 1
    assert f"iris_0: UDP port {port} cannot be bound" in output


def test_publishers_are_looked_up_at_the_master(master, monkeypatch):
    proxy, environment = master
    monkeypatch.setenv("ROS_MASTER_URI", environment["ROS_MASTER_URI"])
    leader = "/leader", "/iris_0/mavros/wheel/send"
    proxy.registerPublisher(*leader, "std_msgs/Empty", "http://127.0.0.1:1")
    publishers, subscribers = system_state()
    proxy.unregisterPublisher(*leader, "http://127.0.0.1:1")
    assert publishers["/iris_0/mavros/wheel/send"] == ["/leader"]
    assert "/iris_0/mavros/wheel/send" not in subscribers
    monkeypatch.setenv("ROS_MASTER_URI", f"http://127.0.0.1:{free_tcp_port()}")
    with pytest.raises(OSError, match=r"."):
        system_state()


def test_missing_master_is_reported():
    uri = f"http://127.0.0.1:{free_tcp_port()}"
    node = start_node({**os.environ, "ROS_MASTER_URI": uri})
    output, _ = node.communicate(timeout=LIMIT)
    assert node.returncode == 1
    assert f"no ROS master answers at {uri}" in output
