#!/usr/bin/env python3
"""The plant: a mass of 1 kg on a rail, 100 Hz. It publishes its position, m, and receives a force, N."""

import rospy
from std_msgs.msg import Float64

import xtdrone_lockstep as lockstep

RATE = 100.0  # Hz

lockstep.init_node("plant", rate=RATE)
position, velocity, force = 0.0, 0.0, 0.0


def on_force(message: Float64) -> None:
    """Store the force of the controller."""
    global force
    force = message.data


publisher = lockstep.Publisher("/position", Float64)
lockstep.Subscriber("/force", Float64, on_force)
lockstep.start()


def step() -> None:
    """Integrate one step, and publish the position; print it once a second."""
    global position, velocity
    velocity += force / RATE
    position += velocity / RATE
    publisher.publish(position)
    if rospy.Time.now().to_nsec() % 1_000_000_000 == 0:
        print(f"{rospy.get_time():.0f} s: {position!r} m", flush=True)


lockstep.spin(step)
