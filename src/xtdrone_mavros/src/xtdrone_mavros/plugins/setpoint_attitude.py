"""Attitude or body-rate setpoints, with the thrust from another topic."""

from __future__ import annotations

from math import sqrt
from typing import Any

from geometry_msgs.msg import PoseStamped, TwistStamped
from mavros_msgs.msg import Thrust

from xtdrone_mavros.lib.setpoint_messages import (
    ONLY_ATTITUDE_THRUST,
    ONLY_RATES_THRUST,
    attitude_target,
    vector_fields,
    xyz,
)
from xtdrone_mavros.lib.tf_listener import TfListener
from xtdrone_mavros.link.pairing import Pairing
from xtdrone_mavros.uas import Plugin, Uas

_ATTITUDE, _RATES, _THRUST = "setpoint_attitude/attitude", "setpoint_attitude/cmd_vel", "setpoint_attitude/thrust"
_SETPOINT_SIDE, _THRUST_SIDE = 0, 1
_LEAST_NORM = 1e-6  # of a valid quaternion


class SetpointAttitudePlugin(Plugin):
    """MAVROS's setpoint_attitude: ``cmd_vel``, or ``attitude`` with ``setpoint_attitude/use_quaternion``.

    The angular part of ``cmd_vel`` is body rates (rad/s, FLU). The orientation of ``attitude`` is FLU to ENU with any
    norm; its position is ignored. Each is sent with the ``thrust`` of the closest stamp; without one it is dropped.
    Thrust is 0..1, with ``setpoint_attitude/reverse_thrust`` -1..1. With ``setpoint_attitude/tf/listen`` the attitude
    is that of a frame on /tf and is sent with each thrust; there are no other topics then.
    """

    name = "setpoint_attitude"

    def __init__(self, uas: Uas) -> None:
        """Subscribe."""
        super().__init__(uas)
        self._least_thrust = -1.0 if uas.params.get("setpoint_attitude/reverse_thrust", False) else 0.0
        self._pairing = Pairing()
        self._use_quaternion = uas.params.get("setpoint_attitude/use_quaternion", False)
        self._listener = None
        if uas.params.get("setpoint_attitude/tf/listen", False):
            self._listener = TfListener(uas, self.name, "target_attitude")
        elif self._use_quaternion:
            uas.subscribe(_ATTITUDE, PoseStamped, self._attitude)
        else:
            uas.subscribe(_RATES, TwistStamped, self._rates)
        uas.subscribe(_THRUST, Thrust, self._thrust)

    def connected(self, connected: bool) -> None:
        """Drop unpaired messages after the vehicle was lost or reset."""
        self._pairing.clear()
        if self._listener is not None:
            self._listener.clear()

    def _attitude(self, pose: PoseStamped) -> None:
        q = pose.pose.orientation
        if not self.uas.finite(_ATTITUDE, vector_fields("pose.orientation", q, "xyzw")):
            return
        if _norm(q) < _LEAST_NORM:
            text = "%s: pose.orientation is zero, which is not an attitude; the message is not forwarded"
            self.uas.warn(_ATTITUDE, text, _ATTITUDE)
            return
        self._pair(_SETPOINT_SIDE, pose)

    def _rates(self, twist: TwistStamped) -> None:
        if self.uas.finite(_RATES, vector_fields("twist.angular", twist.twist.angular)):
            self._pair(_SETPOINT_SIDE, twist)

    def _thrust(self, message: Thrust) -> None:
        if not self._least_thrust <= message.thrust <= 1.0:
            text = "%s: thrust is %s; %g to 1 is allowed; the message is not forwarded"
            self.uas.warn(_THRUST, text, _THRUST, message.thrust, self._least_thrust)
        elif self._listener is None:
            self._pair(_THRUST_SIDE, message)
        elif (transform := self._listener.latest()) is not None:
            self._send_attitude(transform.header, transform.transform.rotation, message.thrust)

    def _pair(self, side: int, message: Any) -> None:
        for setpoint, thrust in self._pairing.add(side, message.header.stamp.to_nsec(), message):
            if self._use_quaternion:
                self._send_attitude(setpoint.header, setpoint.pose.orientation, thrust.thrust)
            else:
                self._send_rates(setpoint.header, setpoint.twist.angular, thrust.thrust)

    def _send_attitude(self, header: Any, q: Any, thrust: float) -> None:
        norm = _norm(q)
        attitude = q.w / norm, q.x / norm, q.y / norm, q.z / norm
        time_boot_ms = self.uas.boot_ms(header)
        self.uas.link.send(attitude_target(self.uas, time_boot_ms, ONLY_ATTITUDE_THRUST, thrust, attitude))

    def _send_rates(self, header: Any, rates: Any, thrust: float) -> None:
        time_boot_ms = self.uas.boot_ms(header)
        self.uas.link.send(attitude_target(self.uas, time_boot_ms, ONLY_RATES_THRUST, thrust, rates=xyz(rates)))


def _norm(q: Any) -> float:
    return sqrt(q.w * q.w + q.x * q.x + q.y * q.y + q.z * q.z)
