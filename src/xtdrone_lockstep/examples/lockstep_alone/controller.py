#!/usr/bin/env python3
"""The controller: moves the plant to 1 m with a PD controller, 50 Hz."""

from std_msgs.msg import Float64

import xtdrone_lockstep as lockstep

RATE = 50.0  # Hz

lockstep.init_node("controller", rate=RATE)
position, previous = 0.0, 0.0


def on_position(message: Float64) -> None:
    """Store the plant's position."""
    global position
    position = message.data


publisher = lockstep.Publisher("/force", Float64)
lockstep.Subscriber("/position", Float64, on_position)
lockstep.start()


def step() -> None:
    """Publish a force that moves the plant to 1 m."""
    global previous
    velocity, previous = (position - previous) * RATE, position
    publisher.publish(4.0 * (1.0 - position) - 3.0 * velocity)


lockstep.spin(step)
