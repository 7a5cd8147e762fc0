"""Conversion of standard messages between the serialisations of ROS 1 and ROS 2 (CDR), by the definitions of both.

Definitions and conversion are those of rosbags: ROS 1 Noetic and ROS 2 Humble. Where the fields of a type differ, those
of the same name, or of the same type in the same order, are copied, and the rest have their defaults.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

from rosbags.convert.converter import is_same_wireformat, migrate_bytes
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

_MISSING = {"tf2_msgs/msg/TFMessage": "geometry_msgs/TransformStamped[] transforms"}
"""Standard types that rosbags does not have, with the definition that is the same in both distributions."""


class ConversionError(ValueError):
    """A type that is not bridged, or bytes that are not a message of it."""


class Converter(NamedTuple):
    """Conversion of one message type in both directions.

    Attributes:
        name: of the type in ROS 2, such as ``std_msgs/msg/String``.
        to_cdr: returns the CDR, with encapsulation, of ROS 1's bytes; raises ``ConversionError``.
        to_ros1: returns ROS 1's bytes of the CDR, little endian; raises ``ConversionError``.
    """

    name: str
    to_cdr: Callable[[bytes], bytes]
    to_ros1: Callable[[bytes], bytes]


@functools.cache
def stores() -> tuple[Any, Any]:
    """Return the definitions of ROS 1 and of ROS 2."""
    found = get_typestore(Stores.ROS1_NOETIC), get_typestore(Stores.ROS2_HUMBLE)
    for store in found:
        for name, text in _MISSING.items():
            store.register(get_types_from_msg(text, name))
    return found


def ros2_name(type_: str) -> str:
    """Return the name in ROS 2 of a type such as ``std_msgs/String``."""
    package, _, name = type_.partition("/")
    return f"{package}/msg/{name}"


@functools.cache
def converter(type_: str, md5sum: str) -> Converter:
    """Return the conversion of a type.

    Args:
        type_: in ROS 1, such as ``std_msgs/String``.
        md5sum: of the definition in use.

    Raises:
        ConversionError: ROS 1 or ROS 2 has no such standard type, or the definition in use differs.
    """
    ros1, ros2 = stores()
    name = ros2_name(type_)
    if name not in ros1.fielddefs or name not in ros2.fielddefs:
        raise ConversionError(f"type: {type_} is not bridged, only standard types of both ROS 1 and ROS 2 are")
    standard = ros1.generate_msgdef(name)[1]
    if md5sum != standard:
        raise ConversionError(f"type: {type_} with md5 sum {md5sum} is not bridged; ROS 1 Noetic's has {standard}")
    if is_same_wireformat(ros1, ros2, name, name):
        return Converter(name, _checked(name, ros2.ros1_to_cdr, name), _checked(name, ros2.cdr_to_ros1, name))
    return Converter(
        name,
        _checked(name, functools.partial(_migrated, ros1, ros2, name, False)),
        _checked(name, functools.partial(_migrated, ros2, ros1, name, True)),
    )


def _migrated(source: Any, target: Any, name: str, from_ros2: bool, data: bytes) -> memoryview:
    return migrate_bytes(source, target, name, name, {}, data, src_is2=from_ros2, dst_is2=not from_ros2)


def _checked(name: str, convert: Callable[..., Any], *arguments: Any) -> Callable[[bytes], bytes]:
    def checked(data: bytes) -> bytes:
        try:
            return bytes(convert(data, *arguments))
        except Exception as error:  # SerdeError, struct and unicode errors, depending on the fault
            raise ConversionError(f"message: its {len(data)} bytes are no {name}: {error}") from error

    return checked
