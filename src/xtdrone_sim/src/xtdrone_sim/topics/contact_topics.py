"""Bumpers: the contacts of each vehicle, published only with subscribers.

===============================  ============================  ===================================================
/VEHICLE/benchmarker/collision   gazebo_msgs/ContactsState     one state for each body touched; 50 Hz, simulated time
===============================  ============================  ===================================================

A message without states means that the vehicle touches nothing. Forces and torques act on the vehicle, in the world's
frame; torques are about its centre of mass.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import groupby

import numpy as np
import rospy
from gazebo_msgs.msg import ContactsState, ContactState
from geometry_msgs.msg import Vector3, Wrench

import xtdrone_lockstep as lockstep
from xtdrone_sim.physics.contacts.bullet_contacts import GROUND, Contact
from xtdrone_sim.simulation import Simulation

PERIOD_US = 20_000


class ContactTopics:
    """Publishes the contacts of a simulation's vehicles."""

    def __init__(self, simulation: Simulation, models: Callable[[], Sequence[str]]) -> None:
        """Advertise the topics.

        Args:
            simulation: provides the contacts.
            models: returns the names of the models, by number; see ``World.collisions``.
        """
        self._simulation = simulation
        self._models = models
        self._publishers: dict[str, lockstep.Publisher] = {}
        self._published_us = -1
        self.update_vehicles()

    def update_vehicles(self) -> None:
        """Update the topics after a vehicle has joined or left."""
        names = [name for name in self._simulation.names if name]
        for name in [name for name in self._publishers if name not in names]:
            self._publishers.pop(name).unregister()
        for name in names:
            if name not in self._publishers:
                self._publishers[name] = lockstep.Publisher(f"/{name}/benchmarker/collision", ContactsState)

    def next_publication_us(self, now_us: int) -> int | None:
        """Return the next publication time, microseconds; None without subscribers."""
        if not any(publisher.get_num_connections() for publisher in self._publishers.values()):
            return None
        return now_us - now_us % PERIOD_US + PERIOD_US

    def publish(self) -> None:
        """Publish to the topics with subscribers if the current time is a publication time."""
        now = self._simulation.time_us
        if now == self._published_us or now % PERIOD_US:
            return
        self._published_us = now
        for index, name in enumerate(self._simulation.names):
            publisher = self._publishers.get(name)
            if publisher is not None and publisher.get_num_connections():
                publisher.publish(self._message(index, now))

    def restart(self) -> None:
        """Prepare for a simulated time that may have been set back."""
        self._published_us = -1

    def _message(self, index: int, now_us: int) -> ContactsState:
        simulation = self._simulation
        contacts = sorted(simulation.world.contacts(index), key=lambda one: one.other)
        centre = simulation.world.plant["position"][index]
        message = ContactsState()
        message.header.stamp = rospy.Time(0, now_us * 1000)
        message.header.frame_id = "map"
        own = f"{simulation.names[index]}::{simulation.models[index].urdf.root}::collision"
        for other, points in groupby(contacts, key=lambda one: one.other):
            message.states.append(_state(own, self._name(other), list(points), centre))
        return message

    def _name(self, other: int) -> str:
        names = self._simulation.names
        if other == GROUND:
            return "ground_plane::link::collision"
        if other < len(names):
            return f"{names[other]}::{self._simulation.models[other].urdf.root}::collision"
        return f"{self._models()[other - len(names)]}::link::collision"


def _state(own: str, other: str, points: Sequence[Contact], centre: np.ndarray) -> ContactState:
    forces = [point.force for point in points]
    torques = [np.cross(point.position - centre, point.force) for point in points]
    wrenches = [Wrench(Vector3(*force), Vector3(*torque)) for force, torque in zip(forces, torques, strict=True)]
    return ContactState(
        info=f"{own} touches {other}",
        collision1_name=own,
        collision2_name=other,
        wrenches=wrenches,
        total_wrench=Wrench(Vector3(*np.sum(forces, axis=0)), Vector3(*np.sum(torques, axis=0))),
        contact_positions=[Vector3(*point.position) for point in points],
        contact_normals=[Vector3(*point.normal) for point in points],
        depths=[point.depth for point in points],
    )
