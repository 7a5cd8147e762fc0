"""``./xtdrone doctor`` beside a running simulation: its findings. test_watched_flight.py: it has no effect."""

from __future__ import annotations

import os
import re
import signal
import socket
import subprocess
import sys
from pathlib import Path

import pytest
from conftest import WALL_LIMIT, Graph, Stack, poll, wait_for_ports

pytest.importorskip("rospy")

import genpy
import rosgraph
from mavros_msgs.msg import ParamValue
from mavros_msgs.srv import CommandLong, ParamSet
from std_msgs.msg import String
from std_srvs.srv import Trigger
from xtdrone_msgs.srv import Step

FLEET = "iris:2"
INJECT_FAILURE, GPS, OFF = 420, 4.0, 1.0  # MAV_CMD_INJECT_FAILURE, FAILURE_UNIT_SENSOR_GPS, FAILURE_TYPE_OFF


def doctor(graph: Graph) -> tuple[int, str]:
    """Return status and report, with each run of white space as one blank."""
    command = [sys.executable, "-m", "xtdrone_interaction", "doctor", "--master", graph.uri]
    done = subprocess.run(command, capture_output=True, text=True, timeout=WALL_LIMIT, check=False)
    assert not done.stderr, done.stderr
    return done.returncode, re.sub(r"\s+", " ", done.stdout)


def section(report: str, vehicle: str) -> str:
    """Return the part of a report about one vehicle."""
    return re.split(r" (?=iris_\d: |machine )", report.partition(f"{vehicle}: ")[2])[0]


def test_the_doctor_names_what_is_wrong_and_what_to_do(graph: Graph, tmp_path: Path) -> None:
    wait_for_ports(FLEET)
    # nodes killed by earlier tests
    subprocess.run(["rosnode", "cleanup"], input="y\n", env={**os.environ, **graph.environment}, text=True, check=True)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 18_570))
        status, report = doctor(graph)
    assert status == 1
    assert "UDP 18570 of instance 0 is taken by " in report
    assert f"(pid {os.getpid()}" in report
    assert "no vehicle and no MAVROS is on this ROS master -> ./xtdrone launch multi_vehicle" in report

    stack = Stack(graph, tmp_path, FLEET)
    try:
        stack.launch("multi_vehicle.launch", f"vehicles:={FLEET}", "speed:=5", "participants:=2")
        poll(lambda: rosgraph.Master("/system_tests").hasParam("/xtdrone/fleet"), "roslaunch sets the fleet")
        communication = stack.run("communication", "xtdrone_control", "multirotor_communication.py", "iris", "all")
        stack.wait(lambda: all(stack.state(i) and stack.state(i).system_status >= 3 for i in (0, 1)), "they start")
        for index in (0, 1):
            graph.say(f"/xtdrone/iris_{index}/cmd", String("HOVER"))
        stack.pass_time(3.0)
        status, report = doctor(graph)
        assert status == 0, report
        assert "running iris:2; world empty; ROS master " in report
        assert (
            "iris_0, iris_1 (2 vehicles; shown for iris_0): AUTO.LOITER, disarmed ok link, arming, OFFBOARD" in report
        )
        assert report.endswith("all is well ")

        enable = ParamValue(integer=1)
        assert graph.call("/iris_0/mavros/param/set", ParamSet, param_id="SYS_FAILURE_EN", value=enable).success
        off = {"command": INJECT_FAILURE, "param1": GPS, "param2": OFF}
        assert graph.call("/iris_0/mavros/cmd/command", CommandLong, **off).success
        stack.pass_time(20.0)
        status, report = doctor(graph)
        assert status == 1
        assert "arming No valid local position estimate -> " in section(report, "iris_0")
        assert "check GPS (an injected failure, " in section(report, "iris_0")
        assert section(report, "iris_1").endswith("ok link, arming, OFFBOARD")

        communication.process.send_signal(signal.SIGKILL)
        communication.process.wait()
        assert graph.call("/simulator/step", Step, duration=genpy.Duration(3)).success  # paused after it
        status, report = doctor(graph)
        assert status == 1
        assert "the simulation is paused -> ./xtdrone sim resume" in report
        assert "/communication does not answer: dead, or hanging" in report
        for index in (0, 1):
            part = section(report, f"iris_{index}")
            assert "OFFBOARD no setpoints arrive: /communication has died" in part
            assert f"publishes on /xtdrone/iris_{index}/cmd, which no node subscribes to" in part
        assert graph.call("/simulator/resume", Trigger).success
    finally:
        stack.stop()
