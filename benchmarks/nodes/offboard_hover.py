#!/usr/bin/env python3
"""Node that holds all vehicles in OFFBOARD through MAVROS's topics and measures the speed of the stack below.

A participant of the lockstep at 30 Hz. Topics of every vehicle T of /xtdrone/fleet:

======================================  ==============================  ===============================================
subscribed
/T/mavros/local_position/pose           PoseStamped
/T/mavros/local_position/velocity_local TwistStamped
/T/mavros/imu/data                      sensor_msgs/Imu
/T/mavros/state                         mavros_msgs/State
/T/TOPIC                                any type                        each of ~topics, counted
published
/T/mavros/setpoint_raw/local            mavros_msgs/PositionTarget      30 Hz, a position above the spawn position
======================================  ==============================  ===============================================

and the services /T/mavros/set_mode and /T/mavros/cmd/arming.

Parameters:
    /xtdrone/fleet (as ``iris:9``): the vehicles.
    ~window (s, default 20.0): minimum simulated time of the measurement, once all vehicles are airborne.
    ~height (m, default 3.0): height held above the ground.
    ~topics (default empty): further topics of each vehicle, comma-separated, e.g. ``scan``.
    ~out (default empty): folder for events.jsonl.

events.jsonl has the formation director's format: one JSON object per line with ``event``, ``time`` (simulated s) and
``wall`` (epoch s). The event ``window`` contains the figures, see :meth:`OffboardClient._measure`.

Exit status: 0 after a measurement, 1 after a failed one, 2 for bad parameters.
"""

from __future__ import annotations

import json
import math
import os
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, TextIO

import rospy
from geometry_msgs.msg import PoseStamped, TwistStamped
from mavros_msgs.msg import PositionTarget, State
from mavros_msgs.srv import CommandBool, SetMode
from sensor_msgs.msg import Imu

import xtdrone_lockstep as lockstep
from benchmarks.process_use import CpuSample, memory, process_tree
from xtdrone_common.fleet import FleetError, parse_fleet

RATE = 30.0  # Hz
_POSITION_ONLY = (
    PositionTarget.IGNORE_VX | PositionTarget.IGNORE_VY | PositionTarget.IGNORE_VZ
    | PositionTarget.IGNORE_AFX | PositionTarget.IGNORE_AFY | PositionTarget.IGNORE_AFZ
    | PositionTarget.IGNORE_YAW | PositionTarget.IGNORE_YAW_RATE
)  # fmt: skip
_STREAM_TIME = 1.0  # s of setpoints before OFFBOARD is requested
_REPEAT = 1.0  # s between repeated requests; no shorter than PX4 waits for its estimator to align
_NEAR = 0.3  # m from the setpoint within which a vehicle has arrived
_LOST = 1.0  # m from the setpoint beyond which a vehicle is no longer held
_CALM_TIME = 2.0  # s between the arrival of the last vehicle and the measurement
_LEAST_ELAPSED = 2.0  # s, minimum wall time of the measurement: CPU times have a resolution of 10 ms
_LIMIT = 60.0  # s of simulated time for each step before the measurement


class ClientError(RuntimeError):
    """The vehicles cannot be held in OFFBOARD; the message names them and the reason."""


class _Vehicle:
    """State of one vehicle, from its topics.

    Attributes:
        name: as ``iris_0``.
        connected: whether MAVROS receives the autopilot's heartbeats.
        armed: as reported by the autopilot.
        mode: PX4's mode under MAVROS's name.
        position: m, ENU; None before the first message.
    """

    def __init__(self, name: str, height: float, received: Counter[str], topics: Sequence[str]) -> None:
        """Declare the topics.

        Args:
            name: as ``iris_0``.
            height: of the position to hold, m above the arming position.
            received: message counters by topic.
            topics: further ones below its name.
        """
        self.name = name
        self.connected = False
        self.armed = False
        self.mode = ""
        self.position: tuple[float, float, float] | None = None
        self._height = height
        self._accepted = False  # to be armed
        self._target = PositionTarget(coordinate_frame=PositionTarget.FRAME_LOCAL_NED, type_mask=_POSITION_ONLY)
        self._received = received
        base = f"/{name}/mavros"
        self._output = lockstep.Publisher(f"{base}/setpoint_raw/local", PositionTarget)
        self._subscriptions = [
            lockstep.Subscriber(f"{base}/local_position/pose", PoseStamped, self._on_pose),
            lockstep.Subscriber(f"{base}/local_position/velocity_local", TwistStamped, self._count, "velocity_local"),
            lockstep.Subscriber(f"{base}/imu/data", Imu, self._count, "imu/data"),
            lockstep.Subscriber(f"{base}/state", State, self._on_state),
            *(lockstep.Subscriber(f"/{name}/{topic}", rospy.AnyMsg, self._count, topic) for topic in topics),
        ]
        self._set_mode = rospy.ServiceProxy(f"{base}/set_mode", SetMode)
        self._arm = rospy.ServiceProxy(f"{base}/cmd/arming", CommandBool)

    def _count(self, _: Any, topic: str) -> None:
        self._received[topic] += 1

    def _on_pose(self, message: PoseStamped) -> None:
        self._received["pose"] += 1
        place = message.pose.position
        self.position = (place.x, place.y, place.z)

    def _on_state(self, message: State) -> None:
        self._received["state"] += 1
        self.connected, self.armed, self.mode = message.connected, message.armed, message.mode

    def publish(self, now: rospy.Time) -> None:
        """Publish the setpoint, if the position is known."""
        if self.position is None:
            return
        target = self._target
        if not self._accepted:  # positions are invalid until the estimator has aligned
            target.position.x, target.position.y, target.position.z = self.position
            target.position.z += self._height
        target.header.stamp = now
        self._output.publish(target)

    def distance(self) -> float:
        """Return the distance from the setpoint, m; infinite before the position is known."""
        if self.position is None:
            return math.inf
        goal = self._target.position
        return math.dist(self.position, (goal.x, goal.y, goal.z))

    def offboard(self) -> bool:
        """Request OFFBOARD and return whether the autopilot accepts."""
        return bool(self._set_mode(0, "OFFBOARD").mode_sent)

    def arm(self) -> bool:
        """Request arming and return whether the autopilot accepts."""
        self._accepted = bool(self._arm(True).success)
        return self._accepted

    def describe(self) -> str:
        """Return the state as text."""
        armed = "armed" if self.armed else "disarmed"
        return f"{self.name} ({armed}, mode {self.mode or 'unknown'!r}, {self.distance():.2f} m from its place)"


class OffboardClient:
    """Flies all vehicles to their positions, holds them there, and measures.

    Create it between ``lockstep.init_node`` and ``lockstep.start``, then call :meth:`run`.
    """

    def __init__(
        self, names: Sequence[str], window: float, height: float, events: TextIO | None, topics: Sequence[str] = ()
    ) -> None:
        """Declare the topics.

        Args:
            names: vehicles.
            window: minimum length of the measurement, simulated s.
            height: to hold, m above the ground.
            events: receives the events as JSON lines.
            topics: further ones of each vehicle.
        """
        self._received: Counter[str] = Counter()
        self._vehicles = [_Vehicle(name, height, self._received, topics) for name in names]
        self._window = window
        self._events = events

    def run(self) -> int:
        """Measure and return the exit status of the program: 0, or 1 if it failed."""
        rate = lockstep.Rate()
        try:
            for _ in self._flight():
                now = rospy.Time.now()
                for vehicle in self._vehicles:
                    vehicle.publish(now)
                rate.sleep()
                if rospy.is_shutdown():
                    return 1
        except (ClientError, rospy.ServiceException) as error:
            rospy.logerr("bench: %s", error)
            self._event("failed", reason=str(error))
            return 1
        return 0

    def _flight(self) -> Iterator[None]:
        """Advance once per tick.

        Raises:
            ClientError: a vehicle did not follow a request.
        """
        self._event("start", vehicles=[v.name for v in self._vehicles])
        yield from self._until("connect and report a position", lambda v: v.connected and v.position is not None)
        yield from self._wait(_STREAM_TIME)
        yield from self._request("accept OFFBOARD", _Vehicle.offboard)
        yield from self._request("arm", _Vehicle.arm)
        self._event("armed")
        yield from self._until("reach its height", lambda v: v.distance() < _NEAR)
        yield from self._until("show OFFBOARD and armed", lambda v: v.armed and v.mode == "OFFBOARD")
        self._event("airborne")
        yield from self._wait(_CALM_TIME)
        yield from self._measure()
        self._event("done")

    def _measure(self) -> Iterator[None]:
        """Measure for the window, longer if it takes too little wall time, and write the event ``window``.

        Its values: ``simulated`` and ``elapsed`` (s of simulated and of wall time), ``received`` (messages by topic,
        all vehicles together), ``cpu`` (CPU s by program), ``others`` (CPU s used by other programs or taken by the
        hypervisor), ``memory`` (bytes) and ``processes``, both of the whole launch.

        Raises:
            ClientError: a vehicle was not held.
        """
        root = os.getppid()  # roslaunch
        self._received.clear()
        start, start_wall, before = rospy.get_time(), time.perf_counter(), CpuSample.take(root)
        while rospy.get_time() - start < self._window or time.perf_counter() - start_wall < _LEAST_ELAPSED:
            yield
        simulated, elapsed = rospy.get_time() - start, time.perf_counter() - start_wall
        received = dict(self._received)
        cpu = CpuSample.take(root).since(before)
        lost = [v for v in self._vehicles if not v.armed or v.mode != "OFFBOARD" or v.distance() > _LOST]
        if lost:
            raise ClientError(f"{', '.join(v.describe() for v in lost)}: not held in OFFBOARD at its place")
        pids = process_tree(root)
        self._event(
            "window",
            simulated=simulated,
            elapsed=elapsed,
            received=received,
            cpu=cpu.programs,
            others=cpu.others,
            memory=memory(pids),
            processes=len(pids),
        )

    def _until(self, what: str, reached: Callable[[_Vehicle], bool]) -> Iterator[None]:
        """Wait until all vehicles have ``reached`` the state.

        Raises:
            ClientError: some have not reached it in time.
        """
        start = rospy.get_time()
        while missing := [v for v in self._vehicles if not reached(v)]:
            self._check(start, what, missing)
            yield

    def _request(self, what: str, ask: Callable[[_Vehicle], bool]) -> Iterator[None]:
        """Send a request to each vehicle, and repeat it to those that refused.

        Raises:
            ClientError: some still refuse after the limit.
        """
        start, refused = rospy.get_time(), self._vehicles
        while refused := [v for v in refused if not ask(v)]:
            self._check(start, what, refused)
            yield from self._wait(_REPEAT)

    def _check(self, start: float, what: str, missing: Sequence[_Vehicle]) -> None:
        if rospy.get_time() - start > _LIMIT:
            raise ClientError(f"{', '.join(v.describe() for v in missing)}: did not {what} within {_LIMIT:.0f} s")

    def _wait(self, duration: float) -> Iterator[None]:
        end = rospy.get_time() + duration
        while rospy.get_time() < end:
            yield

    def _event(self, event: str, **values: Any) -> None:
        if self._events is not None:
            values = {"event": event, "time": rospy.get_time(), "wall": time.monotonic(), **values}
            self._events.write(json.dumps(values) + "\n")
            self._events.flush()


def main() -> int:
    """Run the node and return its exit status."""
    lockstep.init_node("offboard_hover", rate=RATE)
    try:
        fleet = parse_fleet(str(rospy.get_param("/xtdrone/fleet")))
        window, height = (_positive(name, default) for name, default in (("window", 20.0), ("height", 3.0)))
    except KeyError:
        rospy.logfatal("bench: parameter /xtdrone/fleet is not set; launch/multi_vehicle.launch sets it")
        return 2
    except (FleetError, ValueError) as error:
        rospy.logfatal("bench: %s", error)
        return 2
    out = str(rospy.get_param("~out", ""))
    if not out:
        return _run([v.name for v in fleet], window, height, None)
    Path(out).mkdir(parents=True, exist_ok=True)
    with (Path(out) / "events.jsonl").open("w", encoding="utf-8") as events:
        return _run([v.name for v in fleet], window, height, events)


def _run(names: Sequence[str], window: float, height: float, events: TextIO | None) -> int:
    topics = [topic for topic in str(rospy.get_param("~topics", "")).split(",") if topic]
    client = OffboardClient(names, window, height, events, topics)
    lockstep.start()
    return client.run()


def _positive(name: str, default: float) -> float:
    """Return a private parameter.

    Raises:
        ValueError: it is not a number above 0.
    """
    value = rospy.get_param(f"~{name}", default)
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0.0 < value < float("inf"):
        raise ValueError(f"~{name}: {value!r} is not allowed, a number above 0")
    return float(value)


if __name__ == "__main__":
    try:
        sys.exit(main())
    except rospy.ROSInterruptException:
        sys.exit(1)
    except rospy.ROSInitException as error:
        sys.exit(f"offboard_hover: {error}")
