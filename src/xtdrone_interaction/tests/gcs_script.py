"""Exchanges of the ground station with scripted vehicles, without sockets."""

from __future__ import annotations

from collections import deque

from pymavlink.dialects.v20 import common as mavlink

from xtdrone_autopilot.mavlink.wire.codec import decoder
from xtdrone_interaction.gcs.exchanges.exchange import Heartbeat

PX4, COPTER = mavlink.MAV_AUTOPILOT_PX4, mavlink.MAV_TYPE_QUADROTOR
_MAV = mavlink.MAVLink(None, srcSystem=7, srcComponent=1)


def beat():
    return Heartbeat(7, PX4, COPTER, 1, 0)


def told(message):
    """Return a message as decoded from the wire."""
    return decoder(message.msgname)(bytes(message.pack(_MAV)))


def ack(number, result=mavlink.MAV_RESULT_ACCEPTED):
    return told(mavlink.MAVLink_command_ack_message(number, result))


def talk(exchange, vehicle, limit=10_000):
    """Run an exchange with ``vehicle``, a function from a message to its replies; return the exchange's result."""
    arriving = deque()
    try:
        outgoing = next(exchange)
        for _ in range(limit):
            for message in outgoing:
                arriving.extend(vehicle(message))
            outgoing = exchange.send(arriving.popleft() if arriving else None)
    except StopIteration as end:
        return end.value
    raise AssertionError("the exchange does not end")
