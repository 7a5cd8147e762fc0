"""Topics of link poses at exact simulated times, published only with subscribers.

=========================  ===========================  =======================================================
/xtdrone/scene             xtdrone_msgs/SceneState      moving links seen by cameras; 50 Hz, simulated time
/gazebo/link_states        gazebo_msgs/LinkStates       links of vehicles and models, with velocities
/VEHICLE/joint_states      sensor_msgs/JointState       of gimbal and landing gear, if any; 50 Hz
=========================  ===========================  =======================================================
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import rospy
from gazebo_msgs.msg import LinkStates
from geometry_msgs.msg import Point, Pose, Quaternion, Twist, Vector3
from sensor_msgs.msg import JointState
from std_msgs.msg import Header
from xtdrone_msgs.msg import SceneState

import xtdrone_lockstep as lockstep
from xtdrone_sim.simulation import Simulation
from xtdrone_sim.vehicles.link_poses import Links

PERIOD_US = 20_000
FRAME = "map"

SceneProvider = Callable[[SceneState], None]
"""Adds further objects at the current time to a scene message: actors, links of other models."""
StatesProvider = Callable[[LinkStates], None]
"""Adds the links of other models at the current time to a message of link states."""


class LinkTopics:
    """Publishes the poses and velocities of a simulation's links.

    Attributes:
        providers: called in this order for every scene message.
        states_providers: called in this order for every message of link states.
    """

    def __init__(self, simulation: Simulation, states_rate: float = 50.0) -> None:
        """Advertise the topics; called in the simulator's thread, after ``lockstep.host()``.

        Args:
            simulation: provides the links.
            states_rate: rate of /gazebo/link_states, Hz.
        """
        self.providers: list[SceneProvider] = []
        self.states_providers: list[StatesProvider] = []
        self._simulation = simulation
        self._states_period_us = round(1e6 / states_rate)
        self._scene = lockstep.Publisher("/xtdrone/scene", SceneState)
        self._states = lockstep.Publisher("/gazebo/link_states", LinkStates)
        self._joints: dict[str, tuple[int, lockstep.Publisher]] = {}
        self.update_vehicles()
        self._published_us = -1
        self._next_states_us = 0

    def update_vehicles(self) -> None:
        """Update the topics after a vehicle has joined or left."""
        simulation = self._simulation
        self._links = Links(simulation.names, simulation.models)
        jointed = {
            name: i
            for i, (name, model) in enumerate(zip(simulation.names, simulation.models, strict=True))
            if name and (model.gimbal is not None or model.landing_gear)
        }
        for name in [name for name in self._joints if name not in jointed]:
            self._joints.pop(name)[1].unregister()
        for name, i in jointed.items():
            if name not in self._joints:
                self._joints[name] = i, lockstep.Publisher(f"/{name}/joint_states", JointState)
        self._regular = [self._scene, *(publisher for _, publisher in self._joints.values())]

    def next_publication_us(self, now_us: int) -> int | None:
        """Return the next publication time, microseconds; None without subscribers."""
        times = []
        if any(publisher.get_num_connections() for publisher in self._regular):
            times.append(now_us - now_us % PERIOD_US + PERIOD_US)
        if self._states.get_num_connections() and self._next_states_us > now_us:
            times.append(self._next_states_us)
        return min(times, default=None)

    def publish(self) -> None:
        """Publish to all topics with subscribers for which the current time is a publication time."""
        now = self._simulation.time_us
        if now == self._published_us:
            return
        self._published_us = now
        states = now >= self._next_states_us and self._states.get_num_connections() > 0
        if now >= self._next_states_us:
            self._next_states_us = now - now % self._states_period_us + self._states_period_us
        scene = not now % PERIOD_US and self._scene.get_num_connections() > 0
        header = Header(stamp=rospy.Time(0, now * 1000), frame_id=FRAME)
        if scene or states:
            self._publish_links(header, scene=scene, states=states)
        if now % PERIOD_US:
            return
        for vehicle, publisher in self._joints.values():
            if publisher.get_num_connections():
                publisher.publish(self._joint_state(vehicle, header))

    def restart(self) -> None:
        """Prepare for a simulated time that may have been set back."""
        self._published_us = -1
        self._next_states_us = 0

    def _place(self) -> np.ndarray:
        simulation = self._simulation
        return self._links.place(simulation.world.plant, simulation.gimbals.records, simulation.landing_gears.records)

    def _publish_links(self, header: Header, *, scene: bool, states: bool) -> None:
        records = self._place()
        poses = [_pose(record) for record in records]
        if scene:
            message = SceneState(header=header, links=list(self._links.names), poses=list(poses))
            for provide in self.providers:
                provide(message)
            self._scene.publish(message)
        if states:
            twists = [_twist(record["velocity"], record["spin"]) for record in records]
            still = Pose(orientation=Quaternion(0.0, 0.0, 0.0, 1.0))
            names = ["ground_plane::link", *self._links.names]
            listed = LinkStates(names, [still, *poses], [Twist(), *twists])
            for add in self.states_providers:
                add(listed)
            self._states.publish(listed)

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


def _pose(state: np.void) -> Pose:
    w, x, y, z = state["q"].tolist()
    return Pose(Point(*state["position"].tolist()), Quaternion(x, y, z, w))


def _twist(velocity: np.ndarray, spin: np.ndarray) -> Twist:
    return Twist(Vector3(*velocity.tolist()), Vector3(*spin.tolist()))
