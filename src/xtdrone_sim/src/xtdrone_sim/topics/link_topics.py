"""Topics and services of link poses at exact simulated times; topics are published only with subscribers.

=========================  ===========================  =================================================
/xtdrone/scene             xtdrone_msgs/SceneState      moving links seen by cameras; 50 Hz, simulated time
/gazebo/link_states        gazebo_msgs/LinkStates       the same links, with velocities; 50 Hz
/VEHICLE/joint_states      sensor_msgs/JointState       of gimbal and landing gear, if any; 50 Hz
/gazebo/get_link_state     gazebo_msgs/GetLinkState     one link, relative to another or to the world
=========================  ===========================  =================================================
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future
from typing import Any

import numpy as np
import rospy
from gazebo_msgs.msg import LinkState, LinkStates
from gazebo_msgs.srv import GetLinkState, GetLinkStateResponse
from geometry_msgs.msg import Point, Pose, Quaternion, Twist, Vector3
from sensor_msgs.msg import JointState
from std_msgs.msg import Header
from xtdrone_msgs.msg import SceneState

from xtdrone_control import lockstep
from xtdrone_control.rotation_kernels import conjugate_multiply, rotate_inverse
from xtdrone_sim.runtime.mailbox import ClosedError, Mailbox
from xtdrone_sim.simulation import Simulation
from xtdrone_sim.vehicles.link_poses import LINK, Links

PERIOD_US = 20_000
FRAME = "map"
_WORLD = ("", "world", "map", "ground_plane", "ground_plane::link")

SceneProvider = Callable[[SceneState], None]
"""Adds to a scene message further objects at the current time: actors, links of other models."""


class LinkTopics:
    """Publishes the poses and velocities of a simulation's links.

    Attributes:
        providers: called in this order for every scene message.
    """

    def __init__(self, simulation: Simulation, mailbox: Mailbox) -> None:
        """Advertise topics and services; called in the simulator's thread, after ``lockstep.host()``.

        Args:
            simulation: provides the links.
            mailbox: passes requests to the simulator's thread.
        """
        self.providers: list[SceneProvider] = []
        self._simulation = simulation
        self._mailbox = mailbox
        names = [vehicle.name for vehicle in simulation.fleet]
        self._links = Links(names, simulation.models)
        self._scene = lockstep.Publisher("/xtdrone/scene", SceneState)
        self._states = lockstep.Publisher("/gazebo/link_states", LinkStates)
        self._joints = [
            (i, lockstep.Publisher(f"/{name}/joint_states", JointState))
            for i, (name, model) in enumerate(zip(names, simulation.models, strict=True))
            if model.gimbal is not None or model.landing_gear
        ]
        self._publishers = [self._scene, self._states, *(publisher for _, publisher in self._joints)]
        self._published_us = -1
        rospy.Service("/gazebo/get_link_state", GetLinkState, self._get_link_state)

    def next_publication_us(self, now_us: int) -> int | None:
        """Return the next publication time, microseconds; None without subscribers."""
        if not any(publisher.get_num_connections() for publisher in self._publishers):
            return None
        return now_us - now_us % PERIOD_US + PERIOD_US

    def publish(self) -> None:
        """Publish to all topics with subscribers, if the current time is a publication time."""
        now = self._simulation.time_us
        if now % PERIOD_US or now == self._published_us:
            return
        self._published_us = now
        header = Header(stamp=rospy.Time(0, now * 1000), frame_id=FRAME)
        if self._scene.get_num_connections() or self._states.get_num_connections():
            self._publish_links(header)
        for vehicle, publisher in self._joints:
            if publisher.get_num_connections():
                publisher.publish(self._joint_state(vehicle, header))

    def restart(self) -> None:
        """Prepare for a simulated time that may have been set back."""
        self._published_us = -1

    def _place(self) -> np.ndarray:
        simulation = self._simulation
        return self._links.place(simulation.world.plant, simulation.gimbals.records, simulation.landing_gears.records)

    def _publish_links(self, header: Header) -> None:
        states = self._place()
        poses = [_pose(state) for state in states]
        if self._scene.get_num_connections():
            scene = SceneState(header=header, links=list(self._links.names), poses=list(poses))
            for provide in self.providers:
                provide(scene)
            self._scene.publish(scene)
        if self._states.get_num_connections():
            twists = [_twist(state["velocity"], state["spin"]) for state in states]
            still = Pose(orientation=Quaternion(0.0, 0.0, 0.0, 1.0))
            names = ["ground_plane::link", *self._links.names]
            self._states.publish(LinkStates(names, [still, *poses], [Twist(), *twists]))

    def _joint_state(self, vehicle: int, header: Header) -> JointState:
        simulation, model = self._simulation, self._simulation.models[vehicle]
        names: list[str] = []
        angles: list[float] = []
        rates: list[float] = []
        if model.gimbal is not None:
            record = simulation.gimbals.records[vehicle]
            signs = np.array(model.gimbal.signs)
            names += [joint.name for joint in model.gimbal.joints]
            angles += (signs * record["joint"]).tolist()
            rates += (signs * record["joint_rate"]).tolist()
        gear = simulation.landing_gears.records[vehicle]
        names += [joint.name for joint in model.landing_gear]
        angles += [joint.upper * float(gear["raised"]) for joint in model.landing_gear]
        rates += [joint.upper * float(gear["rate"]) for joint in model.landing_gear]
        return JointState(Header(stamp=header.stamp), names, angles, rates, [])

    def _get_link_state(self, request: Any) -> GetLinkStateResponse:
        """Handle the service call, in rospy's thread."""

        def answer(future: Future[Any]) -> None:
            future.set_result(self._answer(request.link_name, request.reference_frame))

        try:
            response: GetLinkStateResponse = self._mailbox.put(answer).result()
        except ClosedError as error:
            raise rospy.ServiceException(str(error)) from error
        return response

    def _answer(self, name: str, frame: str) -> GetLinkStateResponse:
        states = self._place()
        found = []
        for what, wanted in (("link_name", name), ("reference_frame", frame)):
            number = self._links.find(wanted)
            if number is None and wanted not in (_WORLD if what == "reference_frame" else _WORLD[-2:]):
                known = ", ".join(self._links.names)
                return GetLinkStateResponse(LinkState(), False, f"{what}: {wanted!r} is not there; there are {known}")
            found.append(_standing() if number is None else states[number])
        return GetLinkStateResponse(_seen_from(found[0], found[1], name, frame), True, "")


def _standing() -> np.void:
    """Return the record of a static link at the world's origin."""
    record = np.zeros(1, LINK)[0]
    record["q"][0] = 1.0
    return record


def _seen_from(state: np.void, frame: np.void, name: str, frame_name: str) -> LinkState:
    """Return the pose and twist of a link relative to a frame, in its axes, as Gazebo does."""
    position = rotate_inverse(frame["q"], *(state["position"] - frame["position"]).tolist())
    velocity = rotate_inverse(frame["q"], *(state["velocity"] - frame["velocity"]).tolist())
    spin = rotate_inverse(frame["q"], *(state["spin"] - frame["spin"]).tolist())
    w, x, y, z = conjugate_multiply(frame["q"], state["q"])
    pose = Pose(Point(*position), Quaternion(x, y, z, w))
    return LinkState(name, pose, Twist(Vector3(*velocity), Vector3(*spin)), frame_name)


def _pose(state: np.void) -> Pose:
    w, x, y, z = state["q"].tolist()
    return Pose(Point(*state["position"].tolist()), Quaternion(x, y, z, w))


def _twist(velocity: np.ndarray, spin: np.ndarray) -> Twist:
    return Twist(Vector3(*velocity.tolist()), Vector3(*spin.tolist()))
