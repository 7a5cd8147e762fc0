"""Optical flow from the autopilot and to it."""

from __future__ import annotations

from typing import Any

from mavros_msgs.msg import OpticalFlowRad
from sensor_msgs.msg import Range, Temperature

from xtdrone_mavros.extras.relayed import FLOW_GYRO, convert_flow
from xtdrone_mavros.feeds import Feed
from xtdrone_mavros.relayed_messages import In, Relay
from xtdrone_mavros.uas import Uas


def _fields(m: Any) -> dict[str, Any]:
    return {**convert_flow(m), "temperature": m.temperature * 100}


class Px4FlowPlugin(Relay):
    """MAVROS's px4flow: angles in FLU; the distance is also published as a range finder's."""

    name = "px4flow"
    ins = (In("px4flow/raw/send", OpticalFlowRad, "OPTICAL_FLOW_RAD", _fields, free=FLOW_GYRO),)

    def __init__(self, uas: Uas) -> None:
        """Advertise and subscribe."""
        super().__init__(uas)
        get = uas.params.get
        self._flow = uas.topic("px4flow/raw/optical_flow_rad", OpticalFlowRad())
        self._temperature = uas.topic("px4flow/temperature", Temperature())
        self._range = uas.topic("px4flow/ground_distance", Range(radiation_type=Range.ULTRASOUND))
        limits = self._range.message
        limits.field_of_view = get("px4flow/ranger_fov", 0.119428926)
        limits.min_range = get("px4flow/ranger_min_range", 0.3)
        limits.max_range = get("px4flow/ranger_max_range", 5.0)
        topics = (self._flow, self._temperature, self._range)
        for topic in topics:
            topic.message.header.frame_id = get("px4flow/frame_id", "px4flow")
        self.messages = {"OPTICAL_FLOW_RAD": Feed(self._on_flow, *topics)}

    def _on_flow(self, m: Any) -> None:
        celsius = m.temperature / 100.0
        flow = self._flow.message
        for name in ("integration_time_us", "quality", "time_delta_distance_us", "distance"):
            setattr(flow, name, getattr(m, name))
        flow.integrated_x, flow.integrated_xgyro = m.integrated_x, m.integrated_xgyro
        for name, value in convert_flow(m).items():
            setattr(flow, name, value)
        flow.temperature = int(celsius)
        self._temperature.message.temperature = celsius
        self._range.message.range = m.distance
        for topic in (self._flow, self._temperature, self._range):
            if topic.needed:
                self.uas.stamp_us(topic.message.header, m.time_usec)
                topic.publish(topic.message)
