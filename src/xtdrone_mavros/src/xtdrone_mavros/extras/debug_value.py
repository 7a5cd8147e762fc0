"""Debug values from programs or from the autopilot."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from mavros_msgs.msg import DebugValue

from xtdrone_mavros.link.ros_values_to_mavlink import FieldError
from xtdrone_mavros.relayed_messages import In, Out, Relay, text
from xtdrone_mavros.uas import Uas

_NONE = -1  # index or array_id for messages without one
_NAME = 10  # bytes
_FLOATS = 58  # of a DEBUG_FLOAT_ARRAY


def _debug(m: Any) -> Mapping[str, Any]:
    return {"type": DebugValue.TYPE_DEBUG, "index": m.ind, "array_id": _NONE, "value_float": m.value}


def _named_value(kind: int, m: Any) -> dict[str, Any]:
    return {"type": kind, "index": _NONE, "array_id": _NONE, "name": m.name.rstrip("\0")}


def _vector(m: Any) -> Mapping[str, Any]:
    return {**_named_value(DebugValue.TYPE_DEBUG_VECT, m), "data": [m.x, m.y, m.z]}


def _array(m: Any) -> Mapping[str, Any]:
    return {**_named_value(DebugValue.TYPE_DEBUG_FLOAT_ARRAY, m), "array_id": m.array_id, "data": list(m.data)}


def _float(m: Any) -> Mapping[str, Any]:
    return {**_named_value(DebugValue.TYPE_NAMED_VALUE_FLOAT, m), "value_float": m.value}


def _int(m: Any) -> Mapping[str, Any]:
    return {**_named_value(DebugValue.TYPE_NAMED_VALUE_INT, m), "value_int": m.value}


def _send_debug(m: Any) -> Mapping[str, Any]:
    return {"ind": m.index, "value": m.value_float}


def _send_vector(m: Any) -> Mapping[str, Any]:
    """Return the first three numbers.

    Raises:
        FieldError: fewer than three are given.
    """
    if len(m.data) < 3:
        raise FieldError("data", f"{len(m.data)} numbers", "3 of them")
    return {"name": text(m.name, _NAME), **dict(zip("xyz", m.data, strict=False))}


def _send_array(m: Any) -> Mapping[str, Any]:
    """Return the array, truncated to the field as in MAVROS, which also leaves the array's id 0."""
    data = [*m.data, *[0.0] * _FLOATS][:_FLOATS]
    return {"name": text(m.name, _NAME), "array_id": max(m.array_id, 0), "data": data}


def _send_float(m: Any) -> Mapping[str, Any]:
    return {"name": text(m.name, _NAME), "value": m.value_float}


def _send_int(m: Any) -> Mapping[str, Any]:
    return {"name": text(m.name, _NAME), "value": m.value_int}


_TOPIC = "debug_value/send"
_FREE = ("value", "x", "y", "z", "data")  # NaN is published too: a debug value need not be finite
_SENT = {
    DebugValue.TYPE_DEBUG: In(_TOPIC, DebugValue, "DEBUG", _send_debug, free=_FREE),
    DebugValue.TYPE_DEBUG_VECT: In(_TOPIC, DebugValue, "DEBUG_VECT", _send_vector, free=_FREE),
    DebugValue.TYPE_DEBUG_FLOAT_ARRAY: In(_TOPIC, DebugValue, "DEBUG_FLOAT_ARRAY", _send_array, free=_FREE),
    DebugValue.TYPE_NAMED_VALUE_FLOAT: In(_TOPIC, DebugValue, "NAMED_VALUE_FLOAT", _send_float, free=_FREE),
    DebugValue.TYPE_NAMED_VALUE_INT: In(_TOPIC, DebugValue, "NAMED_VALUE_INT", _send_int),
}


class DebugValuePlugin(Relay):
    """MAVROS's debug_value."""

    name = "debug_value"
    outs = (
        Out("DEBUG", "debug_value/debug", DebugValue, _debug, any_sender=True),
        Out("DEBUG_VECT", "debug_value/debug_vector", DebugValue, _vector, any_sender=True),
        Out("DEBUG_FLOAT_ARRAY", "debug_value/debug_float_array", DebugValue, _array, any_sender=True),
        Out("NAMED_VALUE_FLOAT", "debug_value/named_value_float", DebugValue, _float, any_sender=True),
        Out("NAMED_VALUE_INT", "debug_value/named_value_int", DebugValue, _int, any_sender=True),
    )

    def __init__(self, uas: Uas) -> None:
        """Advertise and subscribe."""
        super().__init__(uas)
        uas.subscribe(_TOPIC, DebugValue, self._send)

    def _send(self, value: Any) -> None:
        """Send a value as the message for its type.

        Raises:
            FieldError: the type is unknown, or a value does not fit.
        """
        if value.type not in _SENT:
            raise FieldError("type", value.type, f"{min(_SENT)} to {max(_SENT)}")
        _SENT[value.type].forward(self.uas, value)
