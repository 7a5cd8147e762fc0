"""Additional IMUs: measurements at any position on a moving body, with the noise of a data sheet, and their topics.

=================  ==================  ==============================================================================
/VEHICLE/NAME      sensor_msgs/Imu     of each entry of ``imus:`` in the vehicle's YAML, at its rate in simulated time
=================  ==================  ==============================================================================

A topic is published only with subscribers. The orientation is the true one, of the IMU in ``map`` (ENU); rates and
specific force are in the IMU's frame. The angular acceleration, which matters away from the centre, is that due to
rotors and drag, without contacts.

At the position r, with the angular rate w and the specific force f of the centre, in the body's frame::

    f(r) = f + dw/dt x r + w x (w x r)

White noise of density d has the standard deviation d sqrt(rate) in a sample. The bias is a random walk: it changes by
N(0, walk sqrt(1 s)) in each second, linearly within it. Both depend only on seed, name and time: a sample is the same
whether or not earlier ones had subscribers.
"""

from __future__ import annotations

import math
import zlib

import numpy as np
import rospy
from geometry_msgs.msg import Quaternion, Vector3
from numpy.typing import NDArray
from sensor_msgs.msg import Imu as ImuMessage

import xtdrone_lockstep as lockstep
from xtdrone_common.frames import to_xyzw
from xtdrone_common.rotation import multiply
from xtdrone_common.rotation_kernels import rotate_inverse
from xtdrone_sim.simulation import Simulation
from xtdrone_sim.vehicles.mounts.body_sensors import ImuMount

_WHITE, _WALK = 0, 1  # streams of random numbers


class Imu:
    """One IMU of one vehicle."""

    def __init__(self, vehicle: str, mount: ImuMount) -> None:
        """Draw the first bias.

        Args:
            vehicle: name of the vehicle.
            mount: the IMU.
        """
        self.mount = mount
        self._key = (mount.seed, zlib.crc32(f"{vehicle}/{mount.name}".encode()))
        self._scale = np.repeat([mount.gyro_noise, mount.accel_noise], 3) * math.sqrt(mount.rate)
        self._walk = np.repeat([mount.gyro_walk, mount.accel_walk], 3)
        first = self._normal(_WALK, 0) * np.repeat([mount.gyro_bias, mount.accel_bias], 3)
        self._biases = [first]  # at whole seconds
        self._position = np.array(mount.position)
        self._turn = np.array(mount.pose.orientation)

    def _normal(self, purpose: int, number: int) -> NDArray[np.float64]:
        return np.random.default_rng((*self._key, purpose, number)).standard_normal(6)

    def bias(self, time_us: int) -> NDArray[np.float64]:
        """Return the biases (6,) of gyroscope, rad/s, and accelerometer, m/s^2, at a simulated time."""
        second, rest = divmod(time_us, 1_000_000)
        while len(self._biases) < second + 2:
            self._biases.append(self._biases[-1] + self._walk * self._normal(_WALK, len(self._biases)))
        share = rest * 1e-6
        return (1.0 - share) * self._biases[second] + share * self._biases[second + 1]

    def measure(
        self, time_us: int, rates: NDArray[np.float64], change: NDArray[np.float64], force: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return a sample: angular rate, rad/s, and specific force, m/s^2, in the IMU's frame.

        Args:
            time_us: simulated time, microseconds.
            rates: (3,) rad/s, body FLU.
            change: (3,) their rate of change, rad/s^2.
            force: (3,) specific force of the body's centre, m/s^2, FLU.
        """
        arm = self._position
        there = force + np.cross(change, arm) + np.cross(rates, np.cross(rates, arm))
        true = np.concatenate([rotate_inverse(self._turn, *rates), rotate_inverse(self._turn, *there)])
        white = self._scale * self._normal(_WHITE, time_us) if self._scale.any() else 0.0
        sample: NDArray[np.float64] = true + self.bias(time_us) + white
        return sample[:3], sample[3:]


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
