"""Compiled codecs in place of the Python code that genpy generates for each message class.

``compile_class`` replaces ``serialize``, ``deserialize`` and the construction of objects, of a class and of the classes
of its fields, so that rospy, rosbag and every other user of the class benefits. Bytes and values are equal to genpy's.
genpy's own method is called for an object of another class than the field's, for a value of the wrong type or range (so
that the error is genpy's), and for data that are not ``bytes``.
"""

from __future__ import annotations

import functools
from typing import Any, BinaryIO

import genmsg.msgs
import genpy
import genpy.message
from xtdrone_native.ros_codec import Codec

_TIMES = {"time": genpy.Time, "duration": genpy.Duration}
_VARIABLE, _SINGLE = -1, -2
"""Counts of an array of any length, and of a field that is no array."""

_codecs: dict[type, Codec | None] = {}


def compile_class(message_class: type[Any]) -> Codec | None:
    """Replace a generated class's methods by compiled ones, once.

    Args:
        message_class: A message, request or response class.

    Returns:
        Its codec; None if the class keeps its own methods because genpy has not generated it for an installed type
        (rospy's AnyMsg, a class made from a bag's text, or a class derived from a generated one).
    """
    if message_class not in _codecs:
        _codecs[message_class] = _compile(message_class)
    return _codecs[message_class]


def _compile(message_class: type[Any]) -> Codec | None:
    own = vars(message_class)
    if not {"_type", "_slot_types", "__slots__", "serialize", "deserialize"} <= own.keys():
        return None
    package = own["_type"].partition("/")[0]
    if message_class.__module__.partition(".")[0] != package or len(own["__slots__"]) != len(own["_slot_types"]):
        return None
    codec = Codec(message_class, own["_type"], genpy.DeserializationError)
    default = message_class()
    for slot, slot_type in zip(own["__slots__"], own["_slot_types"], strict=True):
        if not _add_field(codec, slot, slot_type, getattr(default, slot)):
            return None
    _replace_methods(message_class, codec)
    codec.construct_like(default)
    return codec


def _add_field(codec: Codec, slot: str, slot_type: str, default: Any) -> bool:
    base, is_array, length = genmsg.msgs.parse_type(slot_type)
    count = _SINGLE if not is_array else _VARIABLE if length is None else length
    if base in genmsg.msgs.BUILTIN_TYPES:
        codec.add_field(slot, base, count, _TIMES.get(base), None)
        return True
    nested_class = genpy.message.get_message_class(base)
    nested = nested_class and compile_class(nested_class)
    if nested is None or not (is_array or type(default) is nested_class):
        return False
    codec.add_field(slot, "message", count, None, nested)
    return True


def _replace_methods(message_class: Any, codec: Codec) -> None:
    generated_serialize, generated_deserialize = message_class.serialize, message_class.deserialize
    encode, fill = codec.encode, codec.fill

    @functools.wraps(generated_serialize)
    def serialize(self: genpy.Message, buff: BinaryIO) -> None:
        data = encode(self)
        if data is None:
            generated_serialize(self, buff)
        else:
            buff.write(data)

    @functools.wraps(generated_deserialize)
    def deserialize(self: genpy.Message, str: bytes) -> genpy.Message:
        if not fill(self, str):
            generated_deserialize(self, str)
        return self

    message_class.serialize, message_class.deserialize = serialize, deserialize
