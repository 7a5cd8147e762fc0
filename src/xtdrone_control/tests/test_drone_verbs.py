"""Verbs of a scripted vehicle against a fake autopilot, without ROS."""

from __future__ import annotations

import math
import subprocess
import sys

import numpy as np
import pytest

from xtdrone_control.communication.commands import CommandRequest, MultirotorCore
from xtdrone_control.drone.drones import Drone, DroneGroup
from xtdrone_control.drone.verbs import BRAKE_LIMIT, DroneError, FaultError, RejectedError, TimedOutError, Verbs

TURN = 0.1  # s
SPEED = 2.0  # m/s of the fake vehicle
READY = 1 << 28


class Silent:
    def info(self, text: str) -> None:
        pass

    warning = stream_warning = info


class Autopilot:
    """Accepts every request at once by default, and flies straight to position setpoints in OFFBOARD."""

    def __init__(self, name: str = "iris_0") -> None:
        self.time, self.position, self.mode, self.armed = 0.0, np.zeros(3), "AUTO.LOITER", False
        self.rejections: dict[str, tuple[str, str]] = {}
        self.deaf = False
        self.receives_setpoints = True
        self.requests: list[str] = []
        self._waiting: list[CommandRequest] = []
        self._texts: list[str] = []
        self.core = MultirotorCore(name, Silent(), hover_speed=0.0)
        self.verbs = Verbs(name, self.core, self._waiting.append, lambda: self.time)
        self.verbs.telemetry.connected = True
        self.verbs.telemetry.sensors_present = self.verbs.telemetry.sensors_health = READY
        self.report()

    def report(self) -> None:
        self.core.on_pose(tuple(self.position.tolist()), (0.0, 0.0, math.sin(0.25), math.cos(0.25)))
        self.core.on_state(self.mode, self.armed)
        self.verbs.telemetry.velocity = (0.0, 0.0, 0.0)

    def turn(self) -> None:
        for request in self._waiting if not self.deaf else []:
            self.requests.append(request.command)
            rejection, text = self.rejections.get(request.command, ("", ""))
            self.verbs.on_result(request, not rejection, rejection)
            if text:
                self._texts.append(text)
            elif not rejection:
                self._obey(request)
        self._waiting.clear()
        if self.receives_setpoints:
            self.verbs.on_setpoint()
        self.time += TURN
        while self._texts:
            self.verbs.on_text(2, self._texts.pop())
        setpoint = self.core.setpoint
        if self.mode == "OFFBOARD" and self.armed and setpoint.type_mask & 7 == 0:
            way = np.array(setpoint.position) - self.position
            self.position += way * min(1.0, SPEED * TURN / max(float(np.linalg.norm(way)), 1e-9))
        if self.mode == "AUTO.LAND":
            self.position[2] = max(0.0, self.position[2] - SPEED * TURN)
            self.armed = self.armed and self.position[2] > 0.0
        self.report()

    def _obey(self, request: CommandRequest) -> None:
        if request.arm is None:
            self.mode = request.command
        else:
            self.armed = request.arm


class Runner:
    """Runs verbs on fake autopilots."""

    def __init__(self, *autopilots: Autopilot) -> None:
        self.autopilots = {autopilot.verbs.name: autopilot for autopilot in autopilots}
        self.released: list[str] = []

    def run(self, verb: str, steps: dict) -> None:
        while steps:
            steps = {name: step for name, step in steps.items() if next(step, "end") != "end"}
            if steps:
                for autopilot in self.autopilots.values():
                    autopilot.turn()

    def watch(self) -> None:
        pass

    def release(self, names: list[str]) -> None:
        self.released += names


@pytest.fixture
def autopilot() -> Autopilot:
    return Autopilot()


@pytest.fixture
def drone(autopilot: Autopilot) -> Drone:
    return Drone(Runner(autopilot), autopilot.verbs)


def test_a_flight(autopilot: Autopilot, drone: Drone) -> None:
    drone.arm()
    drone.takeoff(3.0)
    assert drone.mode == "OFFBOARD"
    np.testing.assert_allclose(drone.position, (0.0, 0.0, 3.0), atol=0.3)
    assert drone.heading == pytest.approx(0.5)
    drone.go_to(5.0, -1.0, 4.0, heading=1.0)
    np.testing.assert_allclose(drone.position, (5.0, -1.0, 4.0), atol=0.3)
    assert autopilot.core.setpoint.yaw == pytest.approx(1.0)
    drone.set_velocity(1.0, 0.0, -0.5, 0.2, body=True)
    assert (autopilot.core.setpoint.velocity, autopilot.core.setpoint.frame) == ((1.0, 0.0, -0.5), 8)
    drone.hold()
    assert autopilot.core.setpoint.position == tuple(drone.position)
    drone.land()
    assert not drone.armed
    assert autopilot.requests == ["ARM", "OFFBOARD", "AUTO.LAND"]


def test_arming_again_does_not_resume_the_last_velocity(autopilot: Autopilot, drone: Drone) -> None:
    drone.arm()
    drone.set_velocity(1.0, 0.0, 0.0)
    drone.land()
    autopilot.mode = "OFFBOARD"
    drone.arm()
    assert autopilot.core.setpoint.position == tuple(drone.position)
    assert not any(autopilot.core.setpoint.velocity)


def test_a_rejection_carries_the_autopilots_text(autopilot: Autopilot, drone: Drone) -> None:
    autopilot.rejections["ARM"] = ("MAV_RESULT 1", "Preflight Fail: no GPS")
    with pytest.raises(
        RejectedError, match=r"^iris_0: arm: rejected \(MAV_RESULT 1\): Preflight Fail: no GPS$"
    ) as found:
        drone.arm()
    assert (found.value.vehicle, found.value.verb) == ("iris_0", "arm")


def test_a_missing_mode_change_is_a_rejection(autopilot: Autopilot, drone: Drone) -> None:
    drone.arm()
    autopilot.rejections["OFFBOARD"] = ("", "No offboard signal")
    with pytest.raises(RejectedError, match=r"takeoff: the mode stays AUTO.LOITER, not OFFBOARD: No offboard signal"):
        drone.takeoff(2.0)


def test_a_timeout_reports_the_remaining_distance(autopilot: Autopilot, drone: Drone) -> None:
    drone.arm()
    began = autopilot.time
    with pytest.raises(TimedOutError, match=r"go_to: 1[0-9]\.\d m from the goal after 4 s"):
        drone.go_to(20.0, 0.0, 0.0, timeout=4.0)
    assert autopilot.time - began == pytest.approx(4.0, abs=2 * TURN)


def test_a_missing_answer_times_out(autopilot: Autopilot, drone: Drone) -> None:
    autopilot.deaf = True
    with pytest.raises(TimedOutError, match="arm: no answer from MAVROS within 15 s"):
        drone.arm()


def test_offboard_needs_setpoints_that_arrive(autopilot: Autopilot, drone: Drone) -> None:
    autopilot.receives_setpoints = False
    autopilot.armed = True
    autopilot.report()
    with pytest.raises(TimedOutError, match="nothing receives /iris_0/mavros/setpoint_raw/local within 5 s"):
        drone.takeoff(3.0)
    assert "OFFBOARD" not in autopilot.requests


def test_arming_waits_for_the_prearm_checks(autopilot: Autopilot, drone: Drone) -> None:
    autopilot.verbs.telemetry.sensors_health = 0
    drone.arm(timeout=3.0)
    assert autopilot.time == pytest.approx(3.0, abs=3 * TURN)


@pytest.mark.parametrize("verb", ["go_to", "wait"])
def test_leaving_offboard_ends_a_verb_with_the_reason(autopilot: Autopilot, drone: Drone, verb: str) -> None:
    drone.arm()
    drone.takeoff(1.0)
    plain = autopilot.turn

    def failsafe() -> None:
        plain()
        if autopilot.mode == "OFFBOARD":
            autopilot.mode = "AUTO.RTL"
            autopilot.verbs.on_text(4, "Failsafe activated")

    autopilot.turn = failsafe
    with pytest.raises(DroneError, match=f"{verb}: mode changed from OFFBOARD to AUTO.RTL: Failsafe activated"):
        drone.go_to(50.0, 0.0, 1.0) if verb == "go_to" else drone.wait(60.0)


def test_a_watched_component_that_fails_ends_a_verb_and_the_vehicle_brakes(autopilot: Autopilot, drone: Drone) -> None:
    drone.watch("lidar_odometry", patience=0.5)
    autopilot.verbs.on_diagnostic("iris_0: lidar_odometry", 1, "waiting for the first scan")
    autopilot.verbs.on_diagnostic("iris_0: planner", 2, "is not watched")
    autopilot.verbs.on_diagnostic("iris_1: lidar_odometry", 2, "is another vehicle's")
    drone.arm()
    drone.takeoff(1.0)
    drone.set_velocity(3.0, 0.0, 0.0)
    plain = autopilot.turn

    def turn() -> None:
        plain()
        autopilot.verbs.telemetry.velocity = (max(0.0, 3.0 - autopilot.time + braked), 0.0, 0.0)
        if autopilot.time > failed:
            autopilot.verbs.on_diagnostic("iris_0: lidar_odometry", 2, "no scans arrive")

    autopilot.turn, failed, braked = turn, autopilot.time + 1.0, math.inf
    with pytest.raises(FaultError, match=r"^iris_0: wait: lidar_odometry: no scans arrive$"):
        drone.wait(60.0)
    assert autopilot.time == pytest.approx(failed + 0.5, abs=2 * TURN)
    braked = autopilot.time
    drone.brake()
    setpoint = autopilot.core.setpoint
    assert setpoint.velocity == (0.0, 0.0, 0.0)
    assert setpoint.type_mask & 7 == 7  # not the position
    assert autopilot.time - braked == pytest.approx(2.5, abs=2 * TURN)
    with pytest.raises(FaultError):
        drone.go_to(9.0, 0.0, 1.0)
    braked, autopilot.verbs.telemetry.velocity = math.inf, (3.0, 0.0, 0.0)  # it never stops
    began = autopilot.time
    drone.brake()
    assert autopilot.time - began == pytest.approx(BRAKE_LIMIT, abs=2 * TURN)
    drone.land()
    assert not drone.armed
    with pytest.raises(FaultError, match="iris_0: arm: lidar_odometry: no scans arrive"):
        drone.arm(timeout=2.0)
    autopilot.turn, autopilot.mode = plain, "OFFBOARD"
    autopilot.verbs.on_diagnostic("iris_0: lidar_odometry", 0, "good")
    drone.arm()
    assert drone.armed


def test_flying_verbs_need_an_armed_vehicle(drone: Drone) -> None:
    for call in (lambda: drone.takeoff(1.0), lambda: drone.go_to(0, 0, 1), lambda: drone.set_velocity(1, 0, 0)):
        with pytest.raises(DroneError, match=r"the vehicle is not armed; call arm\(\) first"):
            call()


@pytest.mark.parametrize(
    ("call", "text"),
    [
        (lambda d: d.go_to(math.nan, 0, 0), "go_to: x = nan is not allowed"),
        (lambda d: d.set_velocity(0, 1e9, 0), "set_velocity: vy = 1000000000.0 is not allowed"),
        (lambda d: d.takeoff(-1.0), "takeoff: height = -1.0 is not allowed, more than 0"),
        (lambda d: d.wait(0.0), "wait: seconds = 0.0 is not allowed"),
    ],
)
def test_wrong_numbers_are_rejected(drone: Drone, call, text: str) -> None:
    with pytest.raises(ValueError, match=text):
        call(drone)


def test_a_group_flies_together() -> None:
    autopilots = [Autopilot(f"iris_{i}") for i in range(3)]
    runner = Runner(*autopilots)
    group = DroneGroup([Drone(runner, autopilot.verbs) for autopilot in autopilots])
    group.arm()
    assert group.armed.all()
    group.takeoff(2.0)
    goals = [(0.0, 0.0, 2.0), (4.0, 0.0, 2.0), (8.0, 1.0, 3.0)]
    with group:
        group.go_to(goals, headings=0.0)
        np.testing.assert_allclose(group.position, goals, atol=0.3)
        group.set_velocity((1.0, 0.0, 0.0))
        assert [a.core.setpoint.velocity for a in autopilots] == [(1.0, 0.0, 0.0)] * 3
        for shape in ((2, 3), (3,), (3, 2)):
            with pytest.raises(ValueError, match=r"go_to: positions of shape .* is not allowed, \(3, 3\)"):
                group.go_to(np.zeros(shape))
        with pytest.raises(ValueError, match=r"yaw_rates of shape \(2,\) is not allowed, \(3,\) or one number"):
            group.set_velocity((0, 0, 1), (0.1, 0.2))
    assert (len(group), group.names, runner.released) == (3, ["iris_0", "iris_1", "iris_2"], group.names)


def test_verbs_need_no_ros() -> None:
    code = "import sys, xtdrone_control.drone.drones, xtdrone_control.drone as d; sys.exit('rospy' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
