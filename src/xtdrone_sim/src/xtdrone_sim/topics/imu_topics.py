"""Topics of additional IMUs, published only with subscribers.

=================  ==================  ==============================================================================
/VEHICLE/NAME      sensor_msgs/Imu     of each entry of ``imus:`` in the vehicle's YAML, at its rate in simulated time
=================  ==================  ==============================================================================

The orientation is the true one, of the IMU in ``map`` (ENU); rates and specific force are in the IMU's frame. The
angular acceleration, which matters away from the centre, is that due to rotors and drag, without contacts.
"""

from __future__ import annotations

import math

import numpy as np
import rospy
from geometry_msgs.msg import Quaternion, Vector3
from sensor_msgs.msg import Imu as ImuMessage

from xtdrone_control import lockstep
from xtdrone_control.frames import to_xyzw
from xtdrone_control.rotation import multiply
from xtdrone_control.rotation_kernels import rotate_inverse
from xtdrone_sim.sensors.additional_imus import Imu
from xtdrone_sim.simulation import Simulation


class _Topic:
    """An IMU of a vehicle, its topic, and the body's rates one step ago."""

    def __init__(self, index: int, name: str, imu: Imu) -> None:
        self.index = index
        self.imu = imu
        self.publisher = lockstep.Publisher(f"/{name}/{imu.mount.name}", ImuMessage)
        self.period_us = 1e6 / imu.mount.rate
        self.message = ImuMessage()
        self.message.header.frame_id = f"{name}/{imu.mount.frame}"
        for field, deviation in (
            ("angular_velocity", imu.mount.gyro_noise),
            ("linear_acceleration", imu.mount.accel_noise),
        ):
            variance = deviation * deviation * imu.mount.rate
            setattr(self.message, f"{field}_covariance", [variance, 0.0, 0.0, 0.0, variance, 0.0, 0.0, 0.0, variance])

    def due_us(self, now_us: int) -> int:
        """Return the first time after ``now_us`` at which a sample is due."""
        return math.ceil((math.floor(now_us / self.period_us + 1e-9) + 1) * self.period_us - 1e-6)


class ImuTopics:
    """Publishes the samples of a simulation's additional IMUs."""

    def __init__(self, simulation: Simulation) -> None:
        """Advertise the topics."""
        self._simulation = simulation
        self._topics: dict[str, list[_Topic]] = {}
        self._published_us = -1
        self.update_vehicles()

    def update_vehicles(self) -> None:
        """Update the topics after a vehicle has joined or left."""
        simulation = self._simulation
        names = simulation.names
        for name in [name for name in self._topics if name not in names]:
            for topic in self._topics.pop(name):
                topic.publisher.unregister()
        for index, (name, model) in enumerate(zip(names, simulation.models, strict=True)):
            if name and name not in self._topics:
                self._topics[name] = [_Topic(index, name, Imu(name, mount)) for mount in model.imus]

    def _heard(self) -> list[_Topic]:
        return [topic for topics in self._topics.values() for topic in topics if topic.publisher.get_num_connections()]

    def next_publication_us(self, now_us: int) -> int | None:
        """Return the next time at which a sample is due, microseconds, at a step; None without subscribers."""
        step = self._simulation.step_us
        return min((-(-topic.due_us(now_us) // step) * step for topic in self._heard()), default=None)

    def publish(self) -> None:
        """Publish the samples that are due at the current time."""
        now = self._simulation.time_us
        if now == self._published_us:
            return
        self._published_us = now
        for topic in self._heard():
            if topic.due_us(now - self._simulation.step_us) <= now:
                self._publish(topic, now)

    def restart(self) -> None:
        """Prepare for a simulated time that may have been set back."""
        self._published_us = -1

    def _publish(self, topic: _Topic, now_us: int) -> None:
        world = self._simulation.world
        v, m = world.plant[topic.index], world.models[topic.index]
        rates = v["rates"].astype(float)
        moments = m["inertia"]
        change = (v["torque"] - np.cross(rates, moments * rates)) / moments  # Euler's equations
        gravity = world.model.gravity
        x, y, z = v["acceleration"].tolist()
        force = np.array(rotate_inverse(v["q"], x, y, z + gravity))
        gyro, accel = topic.imu.measure(now_us, rates, change, force)
        message = topic.message
        message.header.stamp = rospy.Time(0, now_us * 1000)
        attitude = multiply(tuple(v["q"].tolist()), topic.imu.mount.pose.orientation)
        message.orientation = Quaternion(*to_xyzw(attitude))
        message.angular_velocity, message.linear_acceleration = Vector3(*gyro), Vector3(*accel)
        topic.publisher.publish(message)
