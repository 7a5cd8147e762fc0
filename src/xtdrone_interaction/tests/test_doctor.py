"""The doctor's findings, texts and screen, without ROS."""

from __future__ import annotations

import contextlib
import os
import socket
from dataclasses import replace
from pathlib import Path

import pytest

from xtdrone_autopilot.events.event_catalogue import CATALOGUE
from xtdrone_interaction.doctor import machine_check
from xtdrone_interaction.doctor.findings import (
    _UNKNOWN_CHECK,
    CHECK_REMEDIES,
    Check,
    Finding,
    Graph,
    Simulator,
    Vehicle,
    examine_graph,
    examine_simulator,
    examine_vehicle,
)
from xtdrone_interaction.doctor.screen import BAD, Line, vehicle_lines, wrapped

RUNNING = Simulator(
    time=20.0, speed=1.0, measured_speed=1.0, paused=False, participants=("/mavros",), waiting_for=(), waiting=0.0,
    reason="",
)  # fmt: skip
STREAM = Check("check_modes_offboard_signal", "No offboard signal", False, True)
POSITION = Check("check_modes_local_pos", "No valid local position estimate", True, True)
COMMUNICATION = "/iris_0_communication"
HEALTHY = Graph(
    publishers={"/iris_0/mavros/state": ("/mavros",), "/iris_0/mavros/setpoint_raw/local": (COMMUNICATION,)},
    subscribers={"/xtdrone/iris_0/cmd": (COMMUNICATION,), "/xtdrone/iris_0/cmd_vel_enu": (COMMUNICATION,)},
)


def vehicle(*checks: Check, **fields: object) -> Vehicle:
    known = {"served": True, "heard": True, "connected": True, "mode": "AUTO.LOITER", "system_status": 3}
    return Vehicle(**{"name": "iris_0", "prefix": "/iris_0/mavros", "checks": checks, **known, **fields})


def found(subject: Vehicle, graph: Graph = HEALTHY, simulator: Simulator | None = RUNNING) -> list[str]:
    return [
        f"{finding.what}: {finding.text} -> {finding.remedy}" for finding in examine_vehicle(subject, graph, simulator)
    ]


def test_a_vehicle_with_a_stream_of_setpoints_has_no_findings() -> None:
    assert found(vehicle()) == []


@pytest.mark.parametrize(
    ("subject", "graph", "words"),
    [
        (vehicle(STREAM), Graph(), "OFFBOARD: no setpoints arrive, and no node publishes any -> rosrun xtdrone_control "
         "multirotor_communication.py iris 0"),
        (vehicle(STREAM), HEALTHY, "OFFBOARD: no setpoints: /iris_0_communication has no velocity or position"),
        (vehicle(STREAM), Graph(silent=(COMMUNICATION,)),
         "OFFBOARD: no setpoints arrive: /iris_0_communication has died"),
        (vehicle(STREAM), Graph(publishers={"/iris_0/mavros/setpoint_raw/local": ("/mine",)}),
         "OFFBOARD: no stream of setpoints, though /mine publishes on /iris_0/mavros/setpoint_raw/local"),
        (vehicle(POSITION), HEALTHY, "arming: No valid local position estimate -> after the start"),
        (vehicle(POSITION, system_status=1), HEALTHY, "arming: the estimator is starting: No valid local position"),
        (vehicle(POSITION, armed=True), HEALTHY, "OFFBOARD: No valid local position estimate -> "),
        (vehicle(Check("", "arming check 0x12, which is not known here", True, False)), HEALTHY, _UNKNOWN_CHECK),
        (vehicle(connected=False, fcu_url="udp://:24540@127.0.0.1:34580"), HEALTHY,
         "link: MAVROS receives no heartbeat from the autopilot (udp://:24540@127.0.0.1:34580)"),
        (vehicle(served=False), Graph(), "MAVROS: no node publishes /iris_0/mavros/state -> start the launch again"),
        (vehicle(served=False), Graph(silent=("/mavros",)), "MAVROS: /mavros has died"),
        (vehicle(), replace(HEALTHY, publishers={"/iris_0/mavros/setpoint_raw/local": ("/a", "/b")}),
         "OFFBOARD: /a, /b all publish setpoints for it"),
        (vehicle(), replace(HEALTHY, publishers={"/xtdrone/iris_0/cmd_pose_enu": ("/keys",)}, subscribers={}),
         "commands: /keys publishes on /xtdrone/iris_0/cmd_pose_enu, which no node subscribes to -> rosrun"),
    ],
)  # fmt: skip
def test_each_problem_is_named_with_its_remedy(subject: Vehicle, graph: Graph, words: str) -> None:
    lines = found(subject, graph)
    assert len(lines) == 1, lines
    assert words in lines[0]


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"system_status": 1}, "arming: the autopilot is starting"),
        ({"missing_estimates": ("horizontal position",)}, "arming: the estimator has no horizontal position"),
        ({"ready_to_arm": False, "texts": ("Compass off",)}, "arming: the autopilot's prearm checks fail: Compass off"),
        ({"setpoint_rate": 0.7}, "OFFBOARD: no setpoints"),
        ({"connected": False, "heard": False}, "link: no message received on /iris_0/mavros/state"),
    ],
)
def test_a_real_mavros_is_read_by_its_topics(fields: dict[str, object], words: str) -> None:
    lines = found(vehicle(**{"checks": None, **fields}), simulator=None)
    assert len(lines) == 1, lines
    assert lines[0].startswith(words)
    assert found(vehicle(checks=None, ready_to_arm=True, setpoint_rate=20.0), simulator=None) == []


def test_every_check_of_the_autopilot_has_a_remedy() -> None:
    checks = {name for name, definition in CATALOGUE.items() if name.startswith("check_")}
    harmless = {"check_battery_low"}  # a mere warning
    assert checks - harmless == CHECK_REMEDIES.keys()


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"paused": True, "reason": "paused"}, "the simulation is paused -> ./xtdrone sim resume"),
        ({"waiting_for": ("/leader",), "waiting": 12.0, "reason": "waiting"}, "/leader has held up the tick for 12 s"),
        ({"reason": "1 of 2 participants have joined"}, "1 of 2 participants have joined; /a has died"),
    ],
)  # fmt: skip
def test_a_standstill_is_explained(changes: dict[str, object], words: str) -> None:
    findings = examine_simulator(replace(RUNNING, **changes), Graph(silent=("/a",)))
    assert words in " -> ".join((findings[0].text, findings[0].remedy))
    assert examine_simulator(RUNNING, Graph()) == []


def test_dead_nodes_are_named() -> None:
    assert "/a, /b do not answer" in examine_graph(Graph(silent=("/a", "/b")))[0].text


def test_vehicles_in_the_same_state_share_an_entry() -> None:
    fleet = [vehicle(STREAM, name=f"iris_{i}", prefix=f"/iris_{i}/mavros") for i in range(9)]
    fleet[4] = replace(fleet[4], mode="OFFBOARD")
    lines = vehicle_lines([(member, examine_vehicle(member, Graph(), RUNNING)) for member in fleet])
    assert [line.text for line in lines if "iris_" in line.text and ": " in line.text] == [
        "iris_0, iris_1, iris_2, iris_3, iris_5, iris_6 and 2 more (8 vehicles; shown for iris_0): AUTO.LOITER, "
        "disarmed",
        "iris_4: OFFBOARD, disarmed",
    ]
    assert sum(line.kind == BAD for line in lines) == 2


def test_long_lines_hang_below_their_text() -> None:
    text = wrapped(Line("  arming    " + "word " * 30), 60)
    assert all(len(line) <= 60 for line in text.splitlines())
    assert all(line.startswith(" " * 12) for line in text.splitlines()[1:])


def _bound(stack: contextlib.ExitStack, port: int) -> bool:
    """Bind a UDP port; return whether it was free."""
    taken = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
    with contextlib.suppress(OSError):
        taken.bind(("127.0.0.1", port))
        return True
    return False


def test_a_listener_on_px4s_stock_port_is_told_the_ports_of_this_simulation() -> None:
    def mine() -> list[Finding]:
        return [f for f in machine_check.examine_stock_ports() if f"(pid {os.getpid()}" in f.text]

    with contextlib.ExitStack() as stack:
        if not (_bound(stack, 14_545) and mine()):
            pytest.skip("port 14545 or 14585 is in use")
        [found] = mine()
        assert "listens on UDP 14545, PX4's stock port; no PX4 is at 14585" in found.text
        assert (
            "ports:=px4 mavros:=false, or connect to vehicle 5 at udpout://127.0.0.1:18575; listen on 14550"
            in found.remedy
        )
        assert "on 24545 in the place of MAVROS" in found.remedy
        assert _bound(stack, 14_585)
        assert mine() == []


def test_a_taken_port_is_named_with_its_holder() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        for port in range(18_574, 18_579):  # of iris_4 to iris_8 in instance 0
            try:
                taken.bind(("127.0.0.1", port))
                break
            except OSError:
                continue
        port = taken.getsockname()[1]
        holders = machine_check.port_holders()
        mine = [f for f in machine_check.examine_ports(holders) if f"(pid {os.getpid()}" in f.text]
    assert len(mine) == 1
    assert f"UDP {port} of instance 0 is taken by " in mine[0].text
    assert "instance:=" in mine[0].remedy
    assert machine_check.examine_ports({0: {18570: machine_check.Holder(1, "simulator.py")}, 1: {}}) == []
    assert (
        machine_check.instance_words({0: {1: machine_check.Holder(0, "")}, 1: {}, 2: {}}) == "0 is taken, 1 2 are free"
    )


def test_missing_python_packages_are_named(tmp_path: Path) -> None:
    file = tmp_path / "requirements.txt"
    file.write_text("# a list\nnumpy==0.0.1\nno-such-package-here==1.0\n")
    missing = machine_check.missing_python(file)
    assert missing[0].startswith("numpy 0.0.1 (there is ")
    assert missing[1] == "no-such-package-here"
