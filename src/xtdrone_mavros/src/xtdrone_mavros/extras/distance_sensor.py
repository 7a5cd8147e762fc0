"""Range finders: measurements from the autopilot, and measurements sent to it."""

from __future__ import annotations

import math
import re
from collections import deque
from collections.abc import Mapping
from typing import Any

from geometry_msgs.msg import TransformStamped
from pymavlink.dialects.v20 import common as mavlink
from sensor_msgs.msg import Range
from tf2_msgs.msg import TFMessage

from xtdrone_common import frames
from xtdrone_mavros.feeds import Feed
from xtdrone_mavros.lib.plugin_settings import Params
from xtdrone_mavros.link.ros_values_to_mavlink import FLOAT32_MAX, whole
from xtdrone_mavros.relayed_messages import In
from xtdrone_mavros.uas import Plugin, Uas

_CENTIMETRES = 100.0  # per metre
_SAMPLES = 50  # used for a variance
_LARGEST_VARIANCE = 255
_LASER, _ULTRASOUND, _INFRARED, _RADAR, _UNKNOWN = range(5)  # MAV_DISTANCE_SENSOR
_RADIATION = {
    _LASER: Range.INFRARED,
    _RADAR: Range.INFRARED,
    _UNKNOWN: Range.INFRARED,
    _ULTRASOUND: Range.ULTRASOUND,
}
_PREFIX = "MAV_SENSOR_ROTATION_"
_ORIENTATIONS = {
    entry.name.removeprefix(_PREFIX): number
    for number, entry in mavlink.enums["MAV_SENSOR_ORIENTATION"].items()
    if entry.name.startswith(_PREFIX)
}
_CUSTOM = mavlink.MAV_SENSOR_ROTATION_CUSTOM


class DistanceSensorPlugin(Plugin):
    """MAVROS's distance_sensor: one topic for each sensor in the parameter ``distance_sensor``, by its name.

    Sensors with ``subscriber: true`` are forwarded to the autopilot, others are received from it. An invalid setting is
    an error, whereas MAVROS skips the sensor.
    """

    name = "distance_sensor"

    def __init__(self, uas: Uas) -> None:
        """Advertise and subscribe.

        Raises:
            ValueError: a setting is missing or not allowed, or two sensors have the same id.
        """
        super().__init__(uas)
        settings = uas.params.get("distance_sensor", {})
        base = uas.params.get("distance_sensor/base_frame_id", "base_link")
        self._sensors: dict[int, _Received] = {}
        subscribed: set[int] = set()
        for name, tree in settings.items():
            if not isinstance(tree, Mapping):
                continue
            own = _Settings(name, tree)
            if own.number in subscribed or own.number in self._sensors:
                raise ValueError(f"distance_sensor/{name}/id: {own.number} is already used by another sensor")
            if own.params.get("subscriber", False):
                subscribed.add(own.number)
                _forward(uas, own)
            else:
                self._sensors[own.number] = _Received(uas, own, base)
        topics = [topic for sensor in self._sensors.values() for topic in sensor.topics]
        if topics:
            self.messages = {"DISTANCE_SENSOR": Feed(self._on_distance, *topics)}

    def _on_distance(self, m: Any) -> None:
        sensor = self._sensors.get(m.id)
        if sensor is None:
            self.uas.warn(f"distance {m.id}", "distance_sensor: no sensor has id %d of DISTANCE_SENSOR", m.id)
        else:
            sensor.publish(m)


class _Settings:
    """One sensor's settings."""

    def __init__(self, name: str, tree: Mapping[str, Any]) -> None:
        self.path = f"distance_sensor/{name}"
        self.params = Params(tree)
        self.number = self.required("id", -1)
        orientation = str(tree.get("orientation", ""))
        self.orientation = _orientation(self.path, orientation) if orientation else None

    def required(self, name: str, kind: Any) -> Any:
        """Return a setting with the type of ``kind``.

        Raises:
            ValueError: the setting is missing.
        """
        value = self.params.get(name, kind)
        if value == kind:
            raise ValueError(f"{self.path}/{name}: it is not set")
        return value


def _orientation(path: str, name: str) -> int:
    number = int(name) if name.isdecimal() else _ORIENTATIONS.get(name)
    if number is None or number not in _ORIENTATIONS.values():
        raise ValueError(f"{path}/orientation: {name!r} is not allowed; {', '.join(_ORIENTATIONS)} are")
    return number


def turn(orientation: int) -> frames.Quaternion:
    """Return the rotation of a MAV_SENSOR_ORIENTATION, from the roll, pitch and yaw in MAVLink's description."""
    found = mavlink.enums["MAV_SENSOR_ORIENTATION"].get(orientation)
    angles = dict(re.findall(r"(Roll|Pitch|Yaw): (\d+)", found.description)) if found else {}
    return _quaternion(*(float(angles.get(axis, 0)) for axis in ("Roll", "Pitch", "Yaw")))


def _quaternion(roll: float, pitch: float, yaw: float) -> frames.Quaternion:
    """Return the attitude quaternion for angles in degrees."""
    return frames.quaternion_from_rpy(*(math.radians(angle) for angle in (roll, pitch, yaw)))


class _Received:
    """A sensor of the autopilot."""

    def __init__(self, uas: Uas, own: _Settings, base_frame: str) -> None:
        get = own.params.get
        self._uas = uas
        self._path = own.path
        self._orientation = own.orientation
        frame = own.required("frame_id", "")
        self._range = uas.topic(own.path, Range(field_of_view=own.required("field_of_view", float("inf"))))
        self._range.message.header.frame_id = frame
        self._tf = None
        if get("send_tf", False):
            transform = TransformStamped(child_frame_id=frame)
            transform.header.frame_id = base_frame
            place = transform.transform.translation
            place.x, place.y, place.z = (get(f"sensor_position/{axis}", 0.0) for axis in "xyz")
            self._tf = uas.topic("/tf", TFMessage([transform]))
        self.topics = [self._range]

    def publish(self, m: Any) -> None:
        """Publish a DISTANCE_SENSOR message."""
        radiation = _RADIATION.get(m.type)
        expected = self._orientation
        if radiation is None or expected not in (None, m.orientation):
            text = "%s: DISTANCE_SENSOR of type %d and orientation %d is not published; %s is configured"
            self._uas.warn(self._path, text, self._path, m.type, m.orientation, expected)
            return
        message = self._range.message
        self._uas.stamp(message.header, m.time_boot_ms)
        message.radiation_type = radiation
        message.min_range, message.max_range = m.min_distance / _CENTIMETRES, m.max_distance / _CENTIMETRES
        message.range = m.current_distance / _CENTIMETRES
        self._range.publish(message)
        if self._tf is not None and self._tf.needed:
            [transform] = self._tf.message.transforms
            self._uas.stamp(transform.header, m.time_boot_ms)
            q = transform.transform.rotation
            q.w, q.x, q.y, q.z = turn(m.orientation)
            self._tf.publish(self._tf.message)


def _forward(uas: Uas, own: _Settings) -> None:
    """Subscribe to a sensor's topic and forward it to the autopilot.

    Raises:
        ValueError: the orientation is not set.
    """
    if own.orientation is None:
        raise ValueError(f"{own.path}/orientation: it is not set")
    get = own.params.get
    covariance = get("covariance", 0)
    ratios = get("horizontal_fov_ratio", 1.0), get("vertical_fov_ratio", 1.0)
    q = [0.0] * 4
    if own.orientation == _CUSTOM:
        q = list(_quaternion(*(get(f"custom_orientation/{angle}", 0.0) for angle in ("roll", "pitch", "yaw"))))
    recent: deque[float] = deque(maxlen=_SAMPLES)

    def convert(m: Any) -> dict[str, Any]:
        return {
            "min_distance": whole(m.min_range * _CENTIMETRES),
            "max_distance": whole(m.max_range * _CENTIMETRES),
            "current_distance": whole(m.range * _CENTIMETRES),
            "type": _ULTRASOUND if m.radiation_type == Range.ULTRASOUND else _LASER,
            "id": own.number,
            "orientation": own.orientation,
            "covariance": covariance if covariance > 0 else _variance(recent, m.range),
            "horizontal_fov": m.field_of_view * ratios[0],
            "vertical_fov": m.field_of_view * ratios[1],
            "quaternion": q,
        }

    row = In(own.path, Range, "DISTANCE_SENSOR", convert)
    uas.subscribe(row.topic, row.kind, lambda m: row.forward(uas, m))


def _variance(recent: deque[float], distance: float) -> int:
    """Return the variance of the last ranges (m^2) times 100, as in MAVROS, limited to the field's range."""
    if abs(distance) <= FLOAT32_MAX:
        recent.append(distance)
    if not recent:
        return 0
    mean = sum(recent) / len(recent)
    variance = sum((value - mean) * (value - mean) for value in recent) / len(recent)
    return int(min(variance * 100.0, _LARGEST_VARIANCE))
